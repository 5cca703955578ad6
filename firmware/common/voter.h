/* Vote of redundant channels: the median of three, the mean of two, nothing from one. */
#ifndef RACELOOP_VOTER_H
#define RACELOOP_VOTER_H

#include <stdbool.h>
#include <stdint.h>

enum { VOTER_CHANNELS = 3 };

/* Outcome of one vote. */
typedef struct voter_ballot {
    float value;                   /* only meaningful when valid */
    bool valid;                    /* two channels or more took part */
    bool deviates[VOTER_CHANNELS]; /* took part and lies farther than the tolerance from the others */
} voter_ballot;

/* Vote.
 *
 * values: any unit; those not usable are never read, so they may be NaN. usable: which channels take part; a
 * usable value is of at most half of FLT_MAX. tolerance: largest distance from the median, or between two; same unit,
 * not negative.
 * Of two channels that disagree both deviate: nobody can say which one is right.
 */
voter_ballot voter_vote(const float values[VOTER_CHANNELS], const bool usable[VOTER_CHANNELS], float tolerance);

#endif
