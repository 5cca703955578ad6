#include "hub.h"

#include <string.h>

enum {
    KNOWN_FLAGS = CAN_FLAG_EXTENDED | CAN_FLAG_REMOTE | CAN_FLAG_ERROR,
    NS_PER_US = 1000,
    LOOKS_DIFFER_US = 1000, /* at most, even if the machine interrupts them */
};

static bool can_exist(const can_frame *frame)
{
    /* The identifier of an error frame is a set of error classes, as wide as an extended one. */
    const bool wide = (frame->flags & (CAN_FLAG_EXTENDED | CAN_FLAG_ERROR)) != 0;
    return frame->id <= (wide ? (uint32_t)CAN_ID_EXTENDED_MAX : (uint32_t)CAN_ID_STANDARD_MAX) &&
           frame->dlc <= CAN_DATA_MAX && (frame->flags & ~KNOWN_FLAGS) == 0;
}

uint32_t hub_carry(hub_bus *self, uint8_t bus, uint64_t stamp_ns, const can_frame *frames, uint32_t count,
                   can_frame *on_bus)
{
    if (self->newest_ns < stamp_ns) {
        self->newest_ns = stamp_ns;
    }
    uint32_t carried = 0;
    for (uint32_t i = 0; i < count; i++) {
        if (frames[i].bus != bus || !can_exist(&frames[i])) {
            continue;
        }
        can_frame *frame = &on_bus[carried++];
        *frame = frames[i];
        frame->time_us = self->newest_ns / NS_PER_US;
        frame->sender = CAN_STATION_NONE;
        const uint32_t used = (frame->flags & CAN_FLAG_REMOTE) != 0 ? 0U : frame->dlc;
        memset(&frame->data[used], 0, CAN_DATA_MAX - used);
    }
    self->frames += carried;
    return carried;
}

int64_t hub_wall_offset_us(int64_t used_us, int64_t seen_us)
{
    const int64_t step_us = seen_us - used_us;
    return step_us >= LOOKS_DIFFER_US || step_us <= -LOOKS_DIFFER_US ? seen_us : used_us;
}

static bool is_wanted(const can_link_filter *filters, uint32_t filter_count, const can_frame *frame)
{
    if (filter_count == CAN_LINK_EVERYTHING || (frame->flags & CAN_FLAG_ERROR) != 0) {
        return true;
    }
    if ((frame->flags & CAN_FLAG_REMOTE) != 0) {
        return false;
    }
    const bool extended = (frame->flags & CAN_FLAG_EXTENDED) != 0;
    for (uint32_t i = 0; i < filter_count; i++) {
        if (filters[i].id == frame->id && (filters[i].extended != 0) == extended) {
            return true;
        }
    }
    return false;
}

uint32_t hub_select(const can_link_filter *filters, uint32_t filter_count, const can_frame *frames, uint32_t count,
                    can_frame *heard)
{
    uint32_t selected = 0;
    for (uint32_t i = 0; i < count; i++) {
        if (is_wanted(filters, filter_count, &frames[i])) {
            heard[selected++] = frames[i];
        }
    }
    return selected;
}
