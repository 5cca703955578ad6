#include "obc/numeric.h"

#include <math.h>

float numeric_clamp(float value, float low, float high)
{
    if (!(value >= low)) {
        return low;
    }
    return value > high ? high : value;
}

float numeric_wrap_angle(float angle)
{
    if (!(fabsf(angle) < 100.0f)) {
        return 0.0f;
    }
    const float turns = roundf(angle / (2.0f * NUMERIC_PI));
    const float wrapped = angle - turns * 2.0f * NUMERIC_PI;
    return wrapped <= -NUMERIC_PI ? wrapped + 2.0f * NUMERIC_PI : wrapped;
}

float numeric_interpolate(const float *table, uint32_t count, float position)
{
    const float last = (float)(count - 1u);
    const float at = numeric_clamp(position, 0.0f, last);
    uint32_t i = (uint32_t)at;
    if (i > count - 2u) {
        i = count - 2u;
    }
    const float part = at - (float)i;
    return table[i] + part * (table[i + 1u] - table[i]);
}
