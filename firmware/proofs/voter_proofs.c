/* Vote of three channels: any values up to half of FLT_MAX, any of them usable; those not usable may be NaN. */
#include <math.h>

#include "common/voter.h"
#include "proofs/proof.h"

static bool between(float value, float one, float other)
{
    return value >= fminf(one, other) && value <= fmaxf(one, other);
}

/* Who takes part, and who deviates. */
void proof_vote(void)
{
    float values[VOTER_CHANNELS];
    bool usable[VOTER_CHANNELS];
    uint32_t count = 0U;
    for (uint32_t i = 0U; i < VOTER_CHANNELS; i++) {
        values[i] = nondet_float();
        usable[i] = nondet_bool();
        ASSUME(!usable[i] || fabsf(values[i]) <= 0.5f * FLT_MAX);
        count += usable[i] ? 1U : 0U;
    }
    const float tolerance = nondet_float();
    ASSUME(tolerance >= 0.0f && tolerance <= FLT_MAX);
    const voter_ballot ballot = voter_vote(values, usable, tolerance);

    PROVE(ballot.valid == (count >= 2U), "two channels or more make a vote");
    for (uint32_t i = 0U; i < VOTER_CHANNELS; i++) {
        PROVE(usable[i] || !ballot.deviates[i], "only who takes part can deviate");
        PROVE(ballot.valid || !ballot.deviates[i], "nobody deviates from no vote");
    }
}

/* Of three, none can pull the vote out of the two others, whatever it says. */
void proof_median(void)
{
    const float values[VOTER_CHANNELS] = {nondet_float(), nondet_float(), nondet_float()};
    const bool usable[VOTER_CHANNELS] = {true, true, true};
    for (uint32_t i = 0U; i < VOTER_CHANNELS; i++) {
        ASSUME(fabsf(values[i]) <= 0.5f * FLT_MAX);
    }
    const voter_ballot ballot = voter_vote(values, usable, 0.0f);
    for (uint32_t i = 0U; i < VOTER_CHANNELS; i++) {
        const float one = values[(i + 1U) % VOTER_CHANNELS];
        const float other = values[(i + 2U) % VOTER_CHANNELS];
        PROVE(between(ballot.value, one, other) || between(values[i], one, other),
              "one outside of the others has no say");
    }
}
