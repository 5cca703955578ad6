#include "common/voter.h"

#include <math.h>

static float median(float a, float b, float c)
{
    return fmaxf(fminf(a, b), fminf(fmaxf(a, b), c));
}

voter_ballot voter_vote(const float values[VOTER_CHANNELS], const bool usable[VOTER_CHANNELS], float tolerance)
{
    float taken[VOTER_CHANNELS];
    uint32_t count = 0;

    for (uint32_t i = 0; i < VOTER_CHANNELS; i++) {
        if (usable[i]) {
            taken[count++] = values[i];
        }
    }
    if (count < 2U) {
        return (voter_ballot){0};
    }
    voter_ballot ballot = {.valid = true};
    ballot.value = count == 2U ? 0.5f * (taken[0] + taken[1]) : median(taken[0], taken[1], taken[2]);

    /* Two channels lie at equal distances from their mean, so half the tolerance bounds their difference. */
    const float allowed = count == 2U ? 0.5f * tolerance : tolerance;
    for (uint32_t i = 0; i < VOTER_CHANNELS; i++) {
        ballot.deviates[i] = usable[i] && fabsf(values[i] - ballot.value) > allowed;
    }
    return ballot;
}
