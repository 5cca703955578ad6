/* Motion of the car within a scan taken out of its points. */
#ifndef AUTONOMY_MOTION_COMPENSATION_H
#define AUTONOMY_MOTION_COMPENSATION_H

#include <stdbool.h>
#include <stdint.h>

#include "autonomy/native/point_cloud.h"

/* As a row of a float32 array of shape (n, 4): a point in the axes that the vehicle had when it was taken, m, and its
 * age at the end of the scan, s. */
typedef struct aged_point {
    float x;
    float y;
    float z;
    float age;
} aged_point;

/* Motion of the vehicle frame during the scan, along its own axes. */
typedef struct planar_twist {
    double vx; /* m/s */
    double vy;
    double yaw_rate; /* rad/s */
} planar_twist;

/* Bring points to the axes of the end of the scan, where what stands still keeps its shape and place.
 *
 * points: count of them; those of one column share an age and follow each other, which saves most of the work.
 * moved: receives as many.
 * Returns whether every age is finite; a point whose age is not keeps its place. */
bool motion_compensate(const aged_point *points, uint32_t count, const planar_twist *twist, cloud_point *moved);

#endif
