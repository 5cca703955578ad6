/* Ray casting for the LiDAR model: where the rays of a planar fan meet walls, which are given as line segments. */
#ifndef RACELOOP_LIDAR_H
#define RACELOOP_LIDAR_H

#include <stdint.h>

/* A fan of rays with equal angles between them. */
typedef struct lidar_fan {
    double first;       /* rad, angle of the first ray to the fan's axis, positive to the left */
    double step;        /* rad, above 0, between neighbours; all rays together span less than half a turn */
    double range_max;   /* m */
    const double *rays; /* count unit vectors: ahead and to the left */
    uint32_t count;
} lidar_fan;

/* Where a fan is: its place in m, and the unit vector of its axis. */
typedef struct lidar_pose {
    double x;
    double y;
    double axis_x;
    double axis_y;
} lidar_pose;

/* Cast a fan.
 * segments: segment_count rows of x, y of one end and x, y of the other, m; none longer than `longest`. One that begins
 * where its predecessor ends costs less.
 * ranges: fan->count values; out: m to the nearest wall on each ray, INFINITY without one within range_max.
 * incidence: fan->count values; out: sine of the angle between ray and wall, 0..1; 0 without a wall. */
void lidar_cast(const lidar_fan *fan, const lidar_pose *pose, const double *segments, uint32_t segment_count,
                double longest, float *ranges, float *incidence);

#endif
