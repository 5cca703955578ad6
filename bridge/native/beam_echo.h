/* From where beams end to the points that a LiDAR reports: which echoes are lost, and by how much ranges are off. */
#ifndef RACELOOP_BEAM_ECHO_H
#define RACELOOP_BEAM_ECHO_H

#include <stdint.h>

#include "bridge/native/beam_cast.h"
#include "bridge/native/rigid_motion.h"

enum { NOISE_QUANTILES = 4096 };

/* What becomes of an echo on its way.
 *
 * A diffuse surface (Lambert) that is larger than the beam sends back, at the distance r and under the sine s of the
 * incidence to it, light in proportion to reflectivity * s / r^2. The light that is detected is a number of photons,
 * which is Poisson's; without any there is no echo:
 *
 *     P(echo) = 1 - exp(-gain * reflectivity * s / r^2) */
typedef struct beam_detector {
    double gain;                      /* m2, 0 or more: photons from a white surface, met squarely, times r^2 */
    double noise;                     /* m, 0 or more, standard deviation of the range */
    double quantile[NOISE_QUANTILES]; /* of the noise, in units of its standard deviation, equally likely */
} beam_detector;

/* Points of a scan. Randomness belongs to a beam, not to its turn: it comes from `key` and the beam's number alone, by
 * the mixing function of SplitMix64 (Steele, Lea, Flood 2014).
 * mount: of the LiDAR in the vehicle's frame.
 * key: of this scan; first_beam: number of the LiDAR's first beam, so that several share a key.
 * points: room for columns * lines points of four numbers; out: echoes in the order of the beams, x, y and z in the
 * axes that the vehicle had when their column was taken, m, and their age at the end of the scan, s. beams: NULL, or
 * room for as many numbers; out: number of each point's beam. Returns how many there are. */
uint32_t beam_echo(const beam_pattern *pattern, const rigid_pose *mount, const beam_detector *detector,
                   const beam_hits *hits, uint64_t key, uint32_t first_beam, float *points, uint32_t *beams);

#endif
