/* Small float32 helpers that every controller needs. */
#ifndef RACELOOP_OBC_NUMERIC_H
#define RACELOOP_OBC_NUMERIC_H

#include <stdint.h>

#define NUMERIC_PI 3.14159265f

/* value limited to [low, high]; NaN gives low. low <= high. */
float numeric_clamp(float value, float low, float high);

/* Angle wrapped to (-pi, pi]. angle: rad, |angle| < 100; not finite gives 0. */
float numeric_wrap_angle(float angle);

/* Linear interpolation in a table with equal spacing, constant beyond its ends.
 * table: count >= 2 values. position: in units of the spacing, 0 at table[0]; NaN gives table[0]. */
float numeric_interpolate(const float *table, uint32_t count, float position);

#endif
