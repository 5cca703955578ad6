/* A cycle with absolute deadlines on CLOCK_MONOTONIC.
 *
 * Slot n is due at epoch + phase + n * period. A wait ends at the next slot that has not begun; slots that passed while
 * the caller was busy or stopped are skipped and counted, never run late one after the other. All stations of a run
 * share the epoch, so their phases order them within the period as lock step does.
 */
#ifndef RACELOOP_PORT_DEADLINE_TIMER_H
#define RACELOOP_PORT_DEADLINE_TIMER_H

#include <stdint.h>

/* How a wait ended. */
enum deadline_wait {
    DEADLINE_REACHED = 0,
    DEADLINE_INTERRUPTED = 1, /* a signal came first; no slot was used up */
};

/* One cycle: start it with deadline_timer_init. Times in ns on CLOCK_MONOTONIC. */
typedef struct deadline_timer {
    uint64_t start_ns; /* when slot 0 is due */
    uint64_t period_ns;
    uint64_t slot;        /* slot that the last wait reached */
    uint64_t next_slot;   /* earliest slot that the next wait may end at */
    uint64_t deadline_ns; /* when `slot` was due */
    uint64_t wake_ns;     /* when its wait returned */
    uint64_t skipped;     /* slots that passed unused, in all */
} deadline_timer;

/* Now on CLOCK_MONOTONIC, ns. */
uint64_t monotonic_ns(void);

/* epoch_ns: of the run. phase_ns: after the epoch. period_ns: 1..10^9. The first wait ends at the first slot from now
 * on, or slot 0; slots before it do not count as skipped. */
void deadline_timer_init(deadline_timer *self, uint64_t epoch_ns, uint64_t phase_ns, uint64_t period_ns);

/* Sleep until the next slot. A caller that comes late by less than one period gets the slot that is due at once:
 * lateness is for its log to show. Slots more than one period behind are skipped. Returns enum deadline_wait. */
int32_t deadline_timer_wait(deadline_timer *self);

#endif
