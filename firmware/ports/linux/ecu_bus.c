#include "ports/linux/ecu_bus.h"

#include <inttypes.h>
#include <stdbool.h>
#include <stddef.h>

#include "common/codec.h"
#include "generated/codec_values_table.h"
#include "ports/linux/ecu_options.h"
#include "ports/linux/process_log.h"

enum {
    BATCHES_MAX = 16, /* of ECU_BUS_FRAMES_MAX frames: what a receive buffer can hold is read in one cycle */
};

/* Bits of `told`. */
enum loss {
    LOSS_REFUSED = 1,
    LOSS_OVERFLOW = 2,
    LOSS_LATE = 4,
    LOSS_CROWDED = 8,
    LOSS_SECOND = 16,
};

uint32_t ecu_bus_filters(uint8_t station, uint8_t bus, can_link_filter *filters)
{
    /* By V14, whatever profile is spoken: identifiers are the same, and what others have besides tells the ECUs
     * nothing. */
    uint32_t count = 0U;
    for (uint32_t i = 0U; i < codec_table_count; i++) {
        const codec_message *message = &codec_table[i];
        const bool wanted = message->sender == station || (message->receivers >> station & 1U) != 0U;
        if (message->bus == bus && wanted && count < CAN_LINK_FILTERS_MAX) {
            filters[count++] = (can_link_filter){.id = message->id, .extended = message->extended};
        }
    }
    return count;
}

uint8_t ecu_bus_judge(uint8_t station, const can_frame *frame, uint64_t now_us, uint32_t fresh_us)
{
    if ((frame->flags & CAN_FLAG_ERROR) == 0U) {
        const codec_message *message = codec_find(frame->bus, frame->id, (frame->flags & CAN_FLAG_EXTENDED) != 0U);
        if (message != NULL && message->sender == station) {
            return ECU_BUS_SECOND_SENDER;
        }
    }
    return frame->time_us + fresh_us < now_us ? ECU_BUS_LATE : ECU_BUS_TAKE;
}

int32_t ecu_bus_open(ecu_bus *self, const char *address, uint8_t station, uint8_t bus, uint64_t epoch_ns,
                     uint32_t fresh_us)
{
    can_link_filter filters[CAN_LINK_FILTERS_MAX];
    self->station = station;
    self->fresh_us = fresh_us;
    return can_link_open(&self->link, address, bus, epoch_ns, filters, ecu_bus_filters(station, bus, filters));
}

uint32_t ecu_bus_receive(ecu_bus *self, can_frame *frames, uint64_t now_us)
{
    uint32_t count = 0U;
    uint32_t read = ECU_BUS_FRAMES_MAX;
    const uint64_t second_before = self->second_sender;
    self->newest_us = 0U;
    /* A batch that left no room for another packet may have left frames behind. */
    for (uint32_t i = 0U; i < BATCHES_MAX && read > ECU_BUS_FRAMES_MAX - CAN_LINK_RECEIVE_MIN; i++) {
        can_frame batch[ECU_BUS_FRAMES_MAX];
        read = can_link_receive(&self->link, batch, ECU_BUS_FRAMES_MAX);
        for (uint32_t k = 0U; k < read; k++) {
            const uint8_t verdict = ecu_bus_judge(self->station, &batch[k], now_us, self->fresh_us);
            bool wanted = verdict == ECU_BUS_TAKE;
            self->newest_us = batch[k].time_us;
            if (verdict == ECU_BUS_SECOND_SENDER) {
                wanted = self->second_sender == second_before;
                self->second_sender++;
                self->second_id = batch[k].id;
                self->second_flags = batch[k].flags;
            }
            if (verdict == ECU_BUS_LATE) {
                self->late++;
            } else if (!wanted) {
                continue; /* one of them says all */
            } else if (count < ECU_BUS_FRAMES_MAX) {
                frames[count++] = batch[k];
            } else {
                self->crowded_out++;
            }
        }
    }
    return count;
}

/* True once for a kind of loss, when there is some. */
static bool first(ecu_bus *self, uint8_t kind, uint64_t count)
{
    if (count == 0U || (self->told & kind) != 0U) {
        return false;
    }
    self->told |= kind;
    return true;
}

static void tell_second_sender(const ecu_bus *self, const char *bus, const char *name)
{
    const codec_message *message =
        codec_find(self->link.bus, self->second_id, (self->second_flags & CAN_FLAG_EXTENDED) != 0U);
    const char *message_name = message != NULL ? codec_values_table[message - codec_table].name : "?";
    process_log("%s: another station sends %s (0x%" PRIX32 "): is a second %s on the bus?", bus, message_name,
                self->second_id, name);
}

static void tell_state(ecu_bus *self, const char *bus, uint64_t now_us)
{
    const can_link *link = &self->link;
    const bool down = link->state == CAN_LINK_DOWN;
    if (link->statistics.outages != self->outages_told && self->down_us == 0U) {
        if (down) {
            process_log("%s: %s went down: %s; trying again", bus, link->address,
                        can_link_error_text(link->last_error));
            self->down_us = now_us;
        } else {
            process_log("%s: %s was down for a moment", bus, link->address);
        }
    } else if (self->down_us != 0U && !down) {
        process_log("%s: %s is up again after %" PRIu64 " ms", bus, link->address, (now_us - self->down_us) / 1000U);
        self->down_us = 0U;
    }
    self->outages_told = link->statistics.outages;
}

void ecu_bus_tell(ecu_bus *self, const char *name, uint64_t now_us)
{
    const can_link *link = &self->link;
    const char *bus = ecu_bus_name(link->bus);
    if (link->state == CAN_LINK_CLOSED) {
        return;
    }
    tell_state(self, bus, now_us);
    if (first(self, LOSS_REFUSED, link->statistics.refused)) {
        process_log("%s: %s takes no more frames, the send queue is full; what is refused is dropped", bus,
                    link->address);
    }
    if (first(self, LOSS_OVERFLOW, link->statistics.overflows)) {
        process_log("%s: frames were lost, the receive queue of %s was full", bus, link->address);
    }
    if (first(self, LOSS_LATE, self->late)) {
        process_log("%s: frames waited for more than %" PRIu32 " ms and are dropped", bus, self->fresh_us / 1000U);
    }
    if (first(self, LOSS_CROWDED, self->crowded_out)) {
        process_log("%s: more than %d frames came in one cycle, the others are dropped", bus, ECU_BUS_FRAMES_MAX);
    }
    if (first(self, LOSS_SECOND, self->second_sender)) {
        tell_second_sender(self, bus, name);
    }
}

void ecu_bus_summarise(const ecu_bus *self)
{
    const can_link_statistics *counts = &self->link.statistics;
    if (self->link.kind == 0U) {
        return;
    }
    process_log("%s: received %" PRIu64 ", sent %" PRIu64 ", refused %" PRIu64 ", undelivered %" PRIu64
                ", lost in the queue %" PRIu64 ", late %" PRIu64 ", too many at once %" PRIu64
                ", from a second sender %" PRIu64 ", error frames %" PRIu64 ", outages %" PRIu64
                ", clock steps %" PRIu64,
                ecu_bus_name(self->link.bus), counts->received, counts->sent, counts->refused, counts->undelivered,
                counts->overflows, self->late, self->crowded_out, self->second_sender, counts->error_frames,
                counts->outages, counts->clock_steps);
}
