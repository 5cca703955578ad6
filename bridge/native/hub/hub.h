/* The rules of the hub's buses: which frames a bus carries, when they were on it, and who hears them. Pure. */
#ifndef RACELOOP_HUB_H
#define RACELOOP_HUB_H

#include <stdbool.h>
#include <stdint.h>

#include "ports/linux/can_link.h"

/* What one bus carried. Zeroed at the start. */
typedef struct hub_bus {
    uint64_t newest_ns; /* stamp of the newest frame, CLOCK_MONOTONIC */
    uint64_t frames;
} hub_bus;

/* Put a sender's frames on the bus.
 *
 * frames, count: as they came. bus: enum can_bus of the sender. stamp_ns: CLOCK_MONOTONIC time at which the kernel took
 * them in; on the bus no frame is older than the one before it, so an older stamp becomes that one's.
 * on_bus: receives those that a CAN bus can carry, at most `count`, stamped, without sender, unused data zeroed.
 * Returns how many; the others name another bus, or have an identifier, a length or flags that do not exist. */
uint32_t hub_carry(hub_bus *self, uint8_t bus, uint64_t stamp_ns, const can_frame *frames, uint32_t count,
                   can_frame *on_bus);

/* CLOCK_REALTIME - CLOCK_MONOTONIC for the stamps of a bus, us: the one used so far, unless one that was seen later
 * shows that the wall clock was set. Two looks at the same clocks differ by a few us, which would turn stamps around.
 */
int64_t hub_wall_offset_us(int64_t used_us, int64_t seen_us);

/* Choose what a receiver wants to hear.
 *
 * filters, filter_count: as in can_link_open. Error frames are always wanted, remote frames by who wants all.
 * heard: receives at most `count` frames. Returns how many. */
uint32_t hub_select(const can_link_filter *filters, uint32_t filter_count, const can_frame *frames, uint32_t count,
                    can_frame *heard);

#endif
