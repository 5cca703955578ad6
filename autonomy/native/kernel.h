/* Small things that kernels do in their innermost loops; inline, and therefore apart from the headers that are bound.
 */
#ifndef AUTONOMY_KERNEL_H
#define AUTONOMY_KERNEL_H

#include <math.h>
#include <stdbool.h>

#include "autonomy/native/point_cloud.h"

/* Not fminf and fmaxf, which are calls for the sake of NaN. */
static inline float least(float one, float other)
{
    return one < other ? one : other;
}

static inline float greatest(float one, float other)
{
    return one > other ? one : other;
}

static inline float square(float value)
{
    return value * value;
}

/* Points that kernels work on at a time: first what the compiler can do to several at once, then the rest. */
enum { CLOUD_BLOCK = 512 };

/* Whether a point is one to look at, 0 or 1; without a branch. NaN fails every comparison. */
static inline int32_t cloud_takes(const cloud_point *point)
{
    const float range = (float)CLOUD_RANGE_M;
    return (int32_t)(fabsf(point->x) < range) & (int32_t)(fabsf(point->y) < range) & (int32_t)(fabsf(point->z) < range);
}

/* Count the points of a block that are not taken by what is wrong with them. */
static inline void cloud_count_dropped(const cloud_point *points, uint32_t count, uint32_t dropped, cloud_tally *tally)
{
    for (uint32_t i = 0U; dropped > 0U && i < count; i++) {
        if (cloud_takes(&points[i]) == 0) {
            const bool finite = isfinite(points[i].x) && isfinite(points[i].y) && isfinite(points[i].z);
            tally->far += (uint32_t)finite;
            tally->not_finite += (uint32_t)!finite;
            dropped--;
        }
    }
}

#endif
