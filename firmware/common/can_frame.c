#include "common/can_frame.h"

#include <stddef.h>
#include <string.h>

can_frame *can_outbox_add(can_outbox *out, uint8_t bus, uint32_t id, uint8_t flags, uint8_t dlc)
{
    if (out->count >= out->capacity) {
        out->dropped++;
        return NULL;
    }
    can_frame *frame = &out->frames[out->count++];
    memset(frame, 0, sizeof *frame);
    frame->bus = bus;
    frame->id = id;
    frame->flags = flags;
    frame->dlc = dlc;
    return frame;
}
