#include "bridge/native/lidar.h"

#include <math.h>
#include <stdbool.h>

#define HALF_TURN 3.141592653589793

/* A place as the fan sees it. */
typedef struct sight {
    double x; /* m, along the axis */
    double y;
    double angle; /* rad, to the axis */
} sight;

static sight look(const lidar_pose *pose, const double *end)
{
    const double dx = end[0] - pose->x;
    const double dy = end[1] - pose->y;
    sight seen = {.x = dx * pose->axis_x + dy * pose->axis_y, .y = dy * pose->axis_x - dx * pose->axis_y};
    seen.angle = atan2(seen.y, seen.x);
    return seen;
}

/* Meet the rays between two angles to the axis with a segment from `one` to `other`. */
static void meet(const lidar_fan *fan, double low, double high, const sight *one, const sight *other, float *ranges,
                 float *incidence)
{
    const double dx = other->x - one->x;
    const double dy = other->y - one->y;
    const double length = sqrt(dx * dx + dy * dy);
    const double begin = ceil((low - fan->first) / fan->step);
    const double end = floor((high - fan->first) / fan->step);
    for (double at = fmax(begin, 0.0); at <= end && at < (double)fan->count; at += 1.0) {
        const uint32_t place = (uint32_t)at;
        const double *ray = &fan->rays[2U * place];
        const double across = ray[0] * dy - ray[1] * dx;
        const double range = (one->x * dy - one->y * dx) / across; /* not finite along the wall, and so no echo */
        if (range > 0.0 && range <= fan->range_max && range < (double)ranges[place]) {
            ranges[place] = (float)range;
            incidence[place] = (float)(fabs(across) / length);
        }
    }
}

void lidar_cast(const lidar_fan *fan, const lidar_pose *pose, const double *segments, uint32_t segment_count,
                double longest, float *ranges, float *incidence)
{
    const double reach = (fan->range_max + longest) * (fan->range_max + longest);
    sight other = {0};
    bool chained = false; /* `other` is the end of the segment before */
    for (uint32_t i = 0U; i < fan->count; i++) {
        ranges[i] = INFINITY;
        incidence[i] = 0.0f;
    }
    for (uint32_t i = 0U; i < segment_count; i++) {
        const double *end = &segments[4U * i];
        const double dx = end[0] - pose->x;
        const double dy = end[1] - pose->y;
        if (dx * dx + dy * dy > reach || dx * pose->axis_x + dy * pose->axis_y < -longest) {
            chained = false;
            continue;
        }
        const bool follows = chained && end[0] == end[-2] && end[1] == end[-1];
        const sight one = follows ? other : look(pose, end);
        other = look(pose, end + 2);
        chained = true;
        const double low = fmin(one.angle, other.angle);
        const double high = fmax(one.angle, other.angle);
        if (high - low <= HALF_TURN) {
            meet(fan, low, high, &one, &other, ranges, incidence);
        } else { /* it passes behind */
            meet(fan, -HALF_TURN, low, &one, &other, ranges, incidence);
            meet(fan, high, HALF_TURN, &one, &other, ranges, incidence);
        }
    }
}
