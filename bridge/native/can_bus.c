#include "can_bus.h"

#include <string.h>

void can_bus_init(can_bus_model *self, uint32_t bit_rate)
{
    memset(self, 0, sizeof *self);
    can_wire_init(&self->wire);
    if (bit_rate >= 1000U && bit_rate <= 1000000U && 1000000000U % bit_rate == 0) {
        self->bit_ns = 1000000000U / bit_rate;
    }
}

bool can_bus_submit(can_bus_model *self, const can_frame *frame)
{
    if (self->pending_count == CAN_BUS_PENDING_MAX) {
        self->statistics.lost++;
        return false;
    }
    const uint64_t rank = ((uint64_t)can_wire_arbitration(frame) << 32) | (self->sequence & UINT32_MAX);
    self->sequence++;
    uint32_t place = self->pending_count;
    while (place > 0 && self->pending[place - 1U].rank < rank) {
        place--;
    }
    memmove(&self->pending[place + 1U], &self->pending[place], (self->pending_count - place) * sizeof self->pending[0]);
    self->pending[place].rank = rank;
    self->pending[place].frame = *frame;
    self->pending_count++;
    return true;
}

uint32_t can_bus_transmit(can_bus_model *self, uint64_t slot_start_us, uint64_t slot_end_us, can_frame *out,
                          uint32_t capacity)
{
    if (self->slot_start_us != slot_start_us) {
        self->slot_start_us = slot_start_us;
        self->slot_busy_ns = 0;
    }
    if (self->bit_ns == 0) {
        return 0;
    }
    const uint64_t slot_end_ns = slot_end_us * 1000U;
    uint64_t cursor_ns = slot_start_us * 1000U;
    if (cursor_ns < self->free_ns) {
        cursor_ns = self->free_ns;
    }
    uint32_t count = 0;
    while (self->pending_count > 0 && count < capacity) {
        const can_frame *next = &self->pending[self->pending_count - 1U].frame;
        uint32_t stuff_bits;
        const uint32_t bits = can_wire_bits(&self->wire, next, &stuff_bits);
        const uint64_t end_ns = cursor_ns + (uint64_t)bits * self->bit_ns;
        if (end_ns >= slot_end_ns) {
            break;
        }
        out[count] = *next;
        out[count].time_us = end_ns / 1000U;
        count++;
        self->pending_count--;
        const uint64_t busy_bits = (uint64_t)bits + CAN_WIRE_INTERFRAME_BITS;
        cursor_ns += busy_bits * self->bit_ns;
        self->slot_busy_ns += busy_bits * self->bit_ns;
        self->statistics.frames++;
        self->statistics.bits += busy_bits;
        self->statistics.stuff_bits += stuff_bits;
        self->statistics.busy_ns += busy_bits * self->bit_ns;
    }
    if (count > 0) {
        self->free_ns = cursor_ns;
    }
    return count;
}

void can_bus_end_slot(can_bus_model *self)
{
    self->statistics.deferred += self->pending_count;
    if (self->statistics.busiest_slot_ns < self->slot_busy_ns) {
        self->statistics.busiest_slot_ns = self->slot_busy_ns;
    }
}
