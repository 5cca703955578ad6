/* Vote of redundant channels: the median of three, the mean of two, nothing from one. */
#ifndef RACELOOP_SPACE_DRIVE_VOTER_H
#define RACELOOP_SPACE_DRIVE_VOTER_H

#include <stdbool.h>
#include <stdint.h>

enum { SPACE_DRIVE_CHANNELS = 3 };

/* Outcome of one vote. */
typedef struct space_drive_ballot {
    float value;                          /* only meaningful when valid */
    bool valid;                           /* two channels or more took part */
    bool deviates[SPACE_DRIVE_CHANNELS];  /* took part and lies farther than the tolerance from the others */
} space_drive_ballot;

/* Vote.
 *
 * values: any unit; those not usable are never read, so they may be NaN. usable: which channels take part; a
 * usable value is finite. tolerance: largest distance from the median, or between two; same unit, not negative.
 * Of two channels that disagree both deviate: nobody can say which one is right.
 */
space_drive_ballot space_drive_vote(const float values[SPACE_DRIVE_CHANNELS], const bool usable[SPACE_DRIVE_CHANNELS],
                                    float tolerance);

#endif
