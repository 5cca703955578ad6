#include "can_wire.h"

#include <stddef.h>
#include <string.h>

enum {
    TRAILER_BITS = 10,     /* CRC delimiter, acknowledge slot and delimiter, end of frame */
    ERROR_FRAME_BITS = 20, /* flag, its echo, delimiter */
    CRC_BITS = 15,
    CRC_POLYNOMIAL = 0x4599,
    STUFF_RUN = 5, /* equal bits after which the sender inserts the opposite one */
    HEADER_BYTES_MAX = 5,
    STUFF_COUNT_BITS = 4, /* of FD: three and a parity */
};

/* The stuffed part of a frame up to the data, right-aligned in bytes: leading zeros do not change the CRC, and so
 * the data bytes stay aligned. */
typedef struct wire_form {
    uint8_t bytes[HEADER_BYTES_MAX + CAN_DATA_MAX];
    uint32_t length; /* bytes */
    uint32_t bits;   /* of them on the wire, the last ones */
} wire_form;

static uint32_t data_length(const can_frame *frame)
{
    if ((frame->flags & CAN_FLAG_REMOTE) != 0) {
        return 0;
    }
    return frame->dlc < CAN_DATA_MAX ? frame->dlc : CAN_DATA_MAX;
}

static wire_form form_of(const can_frame *frame)
{
    const uint64_t remote = (frame->flags & CAN_FLAG_REMOTE) != 0 ? 1U : 0U;
    const uint64_t dlc = frame->dlc & 0xFU;
    uint64_t header;
    uint32_t bits;
    if ((frame->flags & CAN_FLAG_EXTENDED) != 0) {
        /* start 0, base id, substitute remote request 1, extension 1, rest of id, remote, two reserved 0, dlc */
        const uint64_t base = (frame->id >> 18) & 0x7FFU;
        const uint64_t rest = frame->id & 0x3FFFFU;
        header = (base << 27) | (UINT64_C(3) << 25) | (rest << 7) | (remote << 6) | dlc;
        bits = 39;
    } else {
        /* start 0, id, remote, extension 0, reserved 0, dlc */
        header = ((uint64_t)(frame->id & 0x7FFU) << 7) | (remote << 6) | dlc;
        bits = 19;
    }
    wire_form form = {.length = (bits + 7U) / 8U, .bits = bits};
    for (uint32_t i = 0; i < form.length; i++) {
        form.bytes[i] = (uint8_t)(header >> (8U * (form.length - 1U - i)));
    }
    const uint32_t count = data_length(frame);
    memcpy(&form.bytes[form.length], frame->data, count);
    form.length += count;
    form.bits += 8U * count;
    return form;
}

/* State of the bit stuffer: value of the last bit times 4, plus how many of them are in a row less one. */
typedef struct stuffer {
    uint32_t state;
    uint32_t inserted;
} stuffer;

/* Send the low `count` bits of `value`, most significant first. */
static void send_bits(stuffer *self, uint32_t value, uint32_t count)
{
    for (uint32_t i = count; i > 0; i--) {
        uint32_t bit = (value >> (i - 1U)) & 1U;
        uint32_t run = bit == self->state / 4U ? self->state % 4U + 2U : 1U;
        if (run == STUFF_RUN) {
            self->inserted++;
            bit ^= 1U;
            run = 1;
        }
        self->state = bit * 4U + run - 1U;
    }
}

static void send_byte(const can_wire *tables, stuffer *self, uint8_t value)
{
    const uint32_t entry = tables->stuffing[self->state][value];
    self->state = entry % 8U;
    self->inserted += entry / 8U;
}

void can_wire_init(can_wire *self)
{
    for (uint32_t value = 0; value < 256U; value++) {
        uint32_t crc = value << 7;
        for (uint32_t bit = 0; bit < 8U; bit++) {
            crc = (crc & 0x4000U) != 0 ? (crc << 1) ^ CRC_POLYNOMIAL : crc << 1;
        }
        self->crc[value] = (uint16_t)(crc & 0x7FFFU);
        for (uint32_t state = 0; state < CAN_WIRE_STUFF_STATES; state++) {
            stuffer stuffing = {.state = state, .inserted = 0};
            send_bits(&stuffing, value, 8);
            self->stuffing[state][value] = (uint8_t)(stuffing.state + stuffing.inserted * 8U);
        }
    }
}

uint16_t can_wire_crc15(const can_wire *self, const uint8_t *bytes, uint32_t length)
{
    uint32_t crc = 0;
    for (uint32_t i = 0; i < length; i++) {
        crc = ((crc << 8) ^ self->crc[((crc >> 7) ^ bytes[i]) & 0xFFU]) & 0x7FFFU;
    }
    return (uint16_t)crc;
}

uint32_t can_wire_bits(const can_wire *self, const can_frame *frame, uint32_t *stuff_bits)
{
    *stuff_bits = 0;
    if ((frame->flags & CAN_FLAG_ERROR) != 0) {
        return ERROR_FRAME_BITS;
    }
    const wire_form form = form_of(frame);
    stuffer stuffing = {.state = 4, .inserted = 0}; /* an idle bus is recessive; a frame starts dominant */
    send_bits(&stuffing, form.bytes[0], form.bits % 8U);
    for (uint32_t i = 1; i < form.length; i++) {
        send_byte(self, &stuffing, form.bytes[i]);
    }
    const uint32_t crc = can_wire_crc15(self, form.bytes, form.length);
    send_byte(self, &stuffing, (uint8_t)(crc >> 7));
    send_bits(&stuffing, crc, 7);
    *stuff_bits = stuffing.inserted;
    return form.bits + CRC_BITS + stuffing.inserted + TRAILER_BITS;
}

/* Fixed stuff bits stand before the stuff count and behind every fourth bit of it and of the CRC. */
static uint32_t fd_crc_field(uint32_t data_bytes, uint32_t *fixed_stuff_bits)
{
    const uint32_t bits = STUFF_COUNT_BITS + (data_bytes <= 16U ? 17U : 21U);
    *fixed_stuff_bits = (bits + 3U) / 4U;
    return bits + *fixed_stuff_bits;
}

static uint32_t fd_data_bytes(uint32_t length, uint32_t *code)
{
    static const uint8_t STEPS[] = {12, 16, 20, 24, 32, 48, 64};
    *code = length;
    if (length <= CAN_DATA_MAX) {
        return length;
    }
    uint32_t step = 0;
    while (step < sizeof STEPS - 1U && STEPS[step] < length) {
        step++;
    }
    *code = 9U + step;
    return STEPS[step];
}

can_wire_fd_length can_wire_fd_bits(const can_wire *self, const can_frame *frame, const uint8_t *more)
{
    const uint32_t switched = (frame->flags & CAN_WIRE_FLAG_BRS) != 0 ? 1U : 0U;
    const uint32_t passive = (frame->flags & CAN_WIRE_FLAG_ESI) != 0 ? 1U : 0U;
    uint32_t code;
    const uint32_t bytes = fd_data_bytes(frame->dlc, &code);
    stuffer stuffing = {.state = 4, .inserted = 0};
    can_wire_fd_length length = {.head = 17, .tail = 9};
    if ((frame->flags & CAN_FLAG_EXTENDED) != 0) {
        /* start 0, base id, substitute remote request 1, extension 1; rest of id, 0, FD 1, reserved 0 */
        length.head = 36;
        send_bits(&stuffing, ((frame->id >> 18) & 0x7FFU) << 2 | 3U, 14);
        send_bits(&stuffing, (frame->id & 0x3FFFFU) << 3 | 2U, 21);
    } else {
        /* start 0, id, 0, extension 0, FD 1, reserved 0 */
        send_bits(&stuffing, (frame->id & 0x7FFU) << 4 | 2U, 16);
    }
    const uint32_t head_stuff = stuffing.inserted; /* one behind the switch is sent at the new rate */
    send_bits(&stuffing, switched, 1);
    uint32_t stuff;
    if (bytes == 0) {
        send_bits(&stuffing, passive << 3 | code >> 1, 4);
        stuff = stuffing.inserted;
    } else {
        send_bits(&stuffing, passive << 4 | code, 5);
        uint8_t last = 0;
        for (uint32_t i = 0; i < bytes; i++) {
            /* What is sent beyond the sender's data is padding. */
            const uint8_t *source = i < CAN_DATA_MAX ? frame->data : more;
            last = 0;
            if (i < frame->dlc && source != NULL) {
                last = source[i < CAN_DATA_MAX ? i : i - CAN_DATA_MAX];
            }
            if (i + 1U < bytes) {
                send_byte(self, &stuffing, last);
            }
        }
        send_bits(&stuffing, (uint32_t)last >> 1, 7);
        /* Behind the last bit stands a fixed stuff bit, never a dynamic one. */
        stuff = stuffing.inserted;
    }
    uint32_t fixed;
    const uint32_t crc_field = fd_crc_field(bytes, &fixed);
    length.head += head_stuff;
    length.fast = 5U + 8U * bytes + (stuff - head_stuff) + crc_field + 1U;
    length.stuff = stuff + fixed;
    return length;
}

void can_wire_bits_of_each(const can_wire *self, const can_frame *frames, uint32_t count, uint32_t *bits)
{
    for (uint32_t i = 0; i < count; i++) {
        uint32_t stuff_bits;
        bits[i] = can_wire_bits(self, &frames[i], &stuff_bits) + (uint32_t)CAN_WIRE_INTERFRAME_BITS;
    }
}

uint32_t can_wire_arbitration(const can_frame *frame)
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
