#include "bridge/native/beam_echo.h"

#include <math.h>
#include <stddef.h>

/* From so many photons on it is certain that there is one, as far as 40 bits of chance can tell. */
#define PHOTONS_CERTAIN 28.0

/* Number `index` of the sequence that SplitMix64 makes from a key. */
static uint64_t random_bits(uint64_t key, uint64_t index)
{
    uint64_t bits = key + (index + 1U) * UINT64_C(0x9E3779B97F4A7C15);
    bits = (bits ^ (bits >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    bits = (bits ^ (bits >> 27)) * UINT64_C(0x94D049BB133111EB);
    return bits ^ (bits >> 31);
}

uint32_t beam_echo(const beam_pattern *pattern, const rigid_pose *mount, const beam_detector *detector,
                   const beam_hits *hits, uint64_t key, uint32_t first_beam, float *points, uint32_t *beams)
{
    const double *axes = mount->axes;
    uint32_t count = 0U;
    for (uint32_t column = 0U; column < pattern->columns; column++) {
        const double cos = pattern->azimuth[column][0];
        const double sin = pattern->azimuth[column][1];
        const float age = (float)(pattern->period * ((double)(pattern->columns - column) - 0.5) / pattern->columns);
        const double ahead[3] = {axes[0] * cos + axes[1] * sin, axes[3] * cos + axes[4] * sin,
                                 axes[6] * cos + axes[7] * sin};
        for (uint32_t line = 0U; line < pattern->lines; line++) {
            const uint32_t beam = column * pattern->lines + line;
            if (hits->echo[beam] < 0.0) {
                continue;
            }
            const double range = hits->range[beam];
            const uint64_t bits = random_bits(key, (uint64_t)first_beam + beam);
            const double photons = detector->gain * hits->echo[beam] / (range * range);
            const double luck = ((double)(bits >> 24) + 0.5) * 0x1p-40; /* between 0 and 1 */
            if (photons < PHOTONS_CERTAIN && luck < exp(-photons)) {
                continue;
            }
            const double reported = range + detector->noise * detector->quantile[bits % NOISE_QUANTILES];
            const double level = reported * pattern->elevation[line][0];
            const double rise = reported * pattern->elevation[line][1];
            float *point = &points[4U * (size_t)count];
            for (unsigned axis = 0U; axis < 3U; axis++) {
                point[axis] = (float)(mount->place[axis] + level * ahead[axis] + rise * axes[3U * axis + 2U]);
            }
            point[3] = age;
            if (beams != NULL) {
                beams[count] = first_beam + beam;
            }
            count++;
        }
    }
    return count;
}
