/* A pure delay of a sampled command, as a ring of fixed size inside the state. */
#ifndef RACELOOP_PLANT_DELAY_H
#define RACELOOP_PLANT_DELAY_H

#include <math.h>
#include <stdint.h>

#include "variables.h"

/** Samples of one inner step each; longer delays are not allowed by the variable table. */
#define DELAY_SAMPLES 256

struct delay_line {
    double sample[DELAY_SAMPLES];
    uint32_t next;
};

/** Fill the line with `value`, as if it had been commanded for ever. */
static inline void delay_fill(struct delay_line *line, double value)
{
    for (uint32_t i = 0; i < DELAY_SAMPLES; ++i) {
        line->sample[i] = value;
    }
    line->next = 0;
}

/** Push this step's `value`, return the value `delay_s` (0 to 0.255 s) ago. */
static inline double delay_step(struct delay_line *line, double value, double delay_s)
{
    const uint32_t back = (uint32_t)(delay_s / PLANT_INNER_STEP_S + 0.5) % DELAY_SAMPLES;
    const uint32_t at = line->next % DELAY_SAMPLES;
    line->sample[at] = value;
    const double out = line->sample[(at + DELAY_SAMPLES - back) % DELAY_SAMPLES];
    line->next = (at + 1U) % DELAY_SAMPLES;
    return out;
}

#endif
