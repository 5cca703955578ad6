#define _POSIX_C_SOURCE 200809L

#include "ports/linux/deadline_timer.h"

#include <errno.h>
#include <time.h>

enum { NS_PER_S = 1000000000 };

uint64_t monotonic_ns(void)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now); /* cannot fail: the clock exists and the pointer is ours */
    return (uint64_t)now.tv_sec * NS_PER_S + (uint64_t)now.tv_nsec;
}

void deadline_timer_init(deadline_timer *self, uint64_t epoch_ns, uint64_t phase_ns, uint64_t period_ns)
{
    const uint64_t now_ns = monotonic_ns();
    *self = (deadline_timer){.start_ns = epoch_ns + phase_ns, .period_ns = period_ns};
    if (now_ns > self->start_ns) {
        self->next_slot = (now_ns - self->start_ns) / period_ns + 1U;
    }
}

/* The slot to serve at now_ns: the next one, or the newest that is due when more than a period was lost. */
static uint64_t slot_to_serve(const deadline_timer *self, uint64_t now_ns)
{
    const uint64_t next_ns = self->start_ns + self->next_slot * self->period_ns;
    return now_ns > next_ns ? self->next_slot + (now_ns - next_ns) / self->period_ns : self->next_slot;
}

int32_t deadline_timer_wait(deadline_timer *self)
{
    const uint64_t slot = slot_to_serve(self, monotonic_ns());
    const uint64_t deadline_ns = self->start_ns + slot * self->period_ns;
    const struct timespec deadline = {
        .tv_sec = (time_t)(deadline_ns / NS_PER_S),
        .tv_nsec = (long)(deadline_ns % NS_PER_S),
    };
    if (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &deadline, NULL) == EINTR) {
        return DEADLINE_INTERRUPTED;
    }
    self->wake_ns = monotonic_ns();
    /* A process that was stopped, or not scheduled, during the wait may have slept through whole slots. */
    const uint64_t served = slot_to_serve(self, self->wake_ns);
    self->skipped += served - self->next_slot;
    self->slot = served;
    self->deadline_ns = self->start_ns + served * self->period_ns;
    self->next_slot = served + 1U;
    return DEADLINE_REACHED;
}
