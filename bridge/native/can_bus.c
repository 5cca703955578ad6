#include "can_bus.h"

#include <string.h>

enum {
    TRAILER_BITS = 10,     /* CRC delimiter, acknowledge slot and delimiter, end of frame */
    ERROR_FRAME_BITS = 20, /* flag, its echo, delimiter */
    CRC_BITS = 15,
    STUFF_RUN = 5, /* equal bits after which the sender inserts the opposite one */
    HEADER_BYTES_MAX = 5,
};

/* The stuffed part of a frame up to the data, right-aligned in bytes: leading zeros do not change the CRC, and
 * so the data bytes stay aligned. */
typedef struct wire_header {
    uint8_t bytes[HEADER_BYTES_MAX + CAN_DATA_MAX];
    uint32_t length; /* bytes */
    uint32_t bits;   /* of them on the wire, the last ones */
} wire_header;

static uint32_t data_length(const can_frame *frame)
{
    if ((frame->flags & CAN_FLAG_REMOTE) != 0) {
        return 0;
    }
    return frame->dlc < CAN_DATA_MAX ? frame->dlc : CAN_DATA_MAX;
}

static wire_header wire_form(const can_frame *frame)
{
    const uint64_t remote = (frame->flags & CAN_FLAG_REMOTE) != 0 ? 1U : 0U;
    const uint64_t dlc = frame->dlc & 0xFU;
    uint64_t field;
    uint32_t bits;
    if ((frame->flags & CAN_FLAG_EXTENDED) != 0) {
        /* start 0, base id, substitute remote request 1, extension 1, rest of id, remote, two reserved 0, dlc */
        const uint64_t base = (frame->id >> 18) & 0x7FFU;
        const uint64_t rest = frame->id & 0x3FFFFU;
        field = (base << 27) | (UINT64_C(3) << 25) | (rest << 7) | (remote << 6) | dlc;
        bits = 39;
    } else {
        /* start 0, id, remote, extension 0, reserved 0, dlc */
        field = ((uint64_t)(frame->id & 0x7FFU) << 7) | (remote << 6) | dlc;
        bits = 19;
    }
    wire_header header = {.length = (bits + 7U) / 8U, .bits = bits};
    for (uint32_t i = 0; i < header.length; i++) {
        header.bytes[i] = (uint8_t)(field >> (8U * (header.length - 1U - i)));
    }
    const uint32_t count = data_length(frame);
    memcpy(&header.bytes[header.length], frame->data, count);
    header.length += count;
    header.bits += 8U * count;
    return header;
}

/* State of the bit stuffer: the value of the last bit and how many of them are in a row. */
typedef struct stuffer {
    uint32_t last;
    uint32_t run;
    uint32_t inserted;
} stuffer;

/* Send the low `count` bits of `value`, most significant first. */
static void stuffer_send(stuffer *self, uint32_t value, uint32_t count)
{
    for (uint32_t i = count; i > 0; i--) {
        const uint32_t bit = (value >> (i - 1U)) & 1U;
        self->run = bit == self->last ? self->run + 1U : 1U;
        self->last = bit;
        if (self->run == STUFF_RUN) {
            self->inserted++;
            self->last = bit ^ 1U;
            self->run = 1;
        }
    }
}

uint16_t can_bus_crc15(const uint8_t *bytes, uint32_t length)
{
    uint32_t crc = 0;
    for (uint32_t i = 0; i < length; i++) {
        crc ^= (uint32_t)bytes[i] << 7;
        for (uint32_t bit = 0; bit < 8U; bit++) {
            crc = (crc & 0x4000U) != 0 ? (crc << 1) ^ 0x4599U : crc << 1;
        }
    }
    return (uint16_t)(crc & 0x7FFFU);
}

uint32_t can_bus_frame_bits(const can_frame *frame, uint32_t *stuff_bits)
{
    *stuff_bits = 0;
    if ((frame->flags & CAN_FLAG_ERROR) != 0) {
        return ERROR_FRAME_BITS;
    }
    const wire_header header = wire_form(frame);
    stuffer stuffing = {.last = 1, .run = 0, .inserted = 0}; /* an idle bus is recessive */
    const uint32_t first = header.bits % 8U == 0 ? 8U : header.bits % 8U;
    stuffer_send(&stuffing, header.bytes[0], first);
    for (uint32_t i = 1; i < header.length; i++) {
        stuffer_send(&stuffing, header.bytes[i], 8);
    }
    stuffer_send(&stuffing, can_bus_crc15(header.bytes, header.length), CRC_BITS);
    *stuff_bits = stuffing.inserted;
    return header.bits + CRC_BITS + stuffing.inserted + TRAILER_BITS;
}

uint32_t can_bus_arbitration(const can_frame *frame)
{
    if ((frame->flags & CAN_FLAG_ERROR) != 0) {
        return 0;
    }
    const uint32_t remote = (frame->flags & CAN_FLAG_REMOTE) != 0 ? 1U : 0U;
    if ((frame->flags & CAN_FLAG_EXTENDED) != 0) {
        const uint32_t base = (frame->id >> 18) & 0x7FFU;
        return (base << 21) | (3U << 19) | ((frame->id & 0x3FFFFU) << 1) | remote;
    }
    return ((frame->id & 0x7FFU) << 21) | (remote << 20);
}

void can_bus_init(can_bus_model *self, uint32_t bit_rate)
{
    memset(self, 0, sizeof *self);
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
    const uint64_t rank = ((uint64_t)can_bus_arbitration(frame) << 32) | (self->sequence & UINT32_MAX);
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
        const uint32_t bits = can_bus_frame_bits(next, &stuff_bits);
        const uint64_t end_ns = cursor_ns + (uint64_t)bits * self->bit_ns;
        if (end_ns >= slot_end_ns) {
            break;
        }
        out[count] = *next;
        out[count].time_us = end_ns / 1000U;
        count++;
        self->pending_count--;
        const uint64_t busy_bits = (uint64_t)bits + CAN_BUS_INTERFRAME_BITS;
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
