/* Debounce: how long a condition has held without a break. */
#ifndef RACELOOP_DEBOUNCE_H
#define RACELOOP_DEBOUNCE_H

#include <stdbool.h>
#include <stdint.h>

/* State of one condition: zero it to start. */
typedef struct debounce {
    bool active;       /* the condition held at the last call */
    uint64_t since_us; /* when it began to hold; only meaningful while active */
} debounce;

/* True when `condition` has held at every call for at least `hold_us` microseconds; 0: at once.
 * self: not null. now_us: monotonic. */
bool debounce_step(debounce *self, bool condition, uint32_t hold_us, uint64_t now_us);

#endif
