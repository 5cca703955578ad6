#include "common/codec.h"

#include <math.h>
#include <stddef.h>

#include "generated/codec_table.h"

/* The 8 data bytes as one little-endian number: bit n of the DBC file is bit n of it. */
static uint64_t load_data(const uint8_t *data)
{
    uint64_t bits = 0U;
    for (uint32_t i = 0U; i < CAN_DATA_MAX; i++) {
        bits |= (uint64_t)data[i] << (8U * i);
    }
    return bits;
}

static void store_data(uint8_t *data, uint64_t bits)
{
    for (uint32_t i = 0U; i < CAN_DATA_MAX; i++) {
        data[i] = (uint8_t)(bits >> (8U * i));
    }
}

static uint64_t field_mask(uint8_t length)
{
    return ((uint64_t)1U << length) - 1U;
}

static uint64_t read_field(const uint8_t *data, uint8_t start, uint8_t length)
{
    return (load_data(data) >> start) & field_mask(length);
}

static void write_field(uint8_t *data, uint8_t start, uint8_t length, uint64_t value)
{
    const uint64_t mask = field_mask(length) << start;
    store_data(data, (load_data(data) & ~mask) | ((value << start) & mask));
}

/* Address in the order of codec_table. */
static uint64_t sort_key(uint8_t bus, bool extended, uint32_t id)
{
    return ((uint64_t)bus << 40U) | ((uint64_t)(extended ? 1U : 0U) << 32U) | id;
}

const codec_message *codec_find(uint8_t bus, uint32_t id, bool extended)
{
    return codec_find_in(&codec_profiles[CODEC_PROFILE_V14], bus, id, extended);
}

const codec_message *codec_find_in(const codec_profile *profile, uint8_t bus, uint32_t id, bool extended)
{
    const uint64_t key = sort_key(bus, extended, id);
    uint32_t low = 0U;
    uint32_t high = profile->count;
    while (low < high) {
        const uint32_t middle = low + (high - low) / 2U;
        const codec_message *row = &profile->messages[middle];
        const uint64_t row_key = sort_key(row->bus, row->extended != 0U, row->id);
        if (row_key < key) {
            low = middle + 1U;
        } else if (row_key > key) {
            high = middle;
        } else {
            return row;
        }
    }
    return NULL;
}

codec_status codec_accept(const can_frame *frame, const codec_message **message)
{
    return codec_accept_in(&codec_profiles[CODEC_PROFILE_V14], frame, message);
}

codec_status codec_accept_in(const codec_profile *profile, const can_frame *frame, const codec_message **message)
{
    *message = NULL;
    /* First the kinds of frame whose id and data mean nothing: an error frame's id holds error classes. */
    if ((frame->flags & CAN_FLAG_ERROR) != 0U) {
        return CODEC_ERROR_FRAME;
    }
    *message = codec_find_in(profile, frame->bus, frame->id, (frame->flags & CAN_FLAG_EXTENDED) != 0U);
    if (*message == NULL) {
        return CODEC_UNKNOWN_ID;
    }
    if ((frame->flags & CAN_FLAG_REMOTE) != 0U) {
        return CODEC_REMOTE_FRAME;
    }
    if (frame->dlc < (*message)->dlc) {
        return CODEC_SHORT_FRAME;
    }
    return CODEC_OK;
}

static codec_status check_content(codec_rx *rx, const can_frame *frame, const codec_message *message)
{
    if (message->crc_length != 0U &&
        read_field(frame->data, message->crc_start, message->crc_length) != codec_frame_crc(frame, message)) {
        return CODEC_CRC_MISMATCH;
    }
    if (message->counter_length == 0U) {
        return CODEC_OK;
    }
    const uint8_t counter = (uint8_t)read_field(frame->data, message->counter_start, message->counter_length);
    const bool stuck = rx->counter_known && counter == rx->counter;
    rx->counter = counter;
    rx->counter_known = true;
    return stuck ? CODEC_COUNTER_STUCK : CODEC_OK;
}

codec_status codec_receive(codec_rx *rx, const can_frame *frame, uint64_t now_us)
{
    const codec_message *message = NULL;
    codec_status status = codec_accept(frame, &message);
    if (status == CODEC_OK) {
        status = check_content(rx, frame, message);
    }
    rx->last_status = (int8_t)status;
    if (status != CODEC_OK) {
        rx->rejected++;
        return status;
    }
    rx->last_valid_us = now_us;
    rx->valid++;
    rx->seen = true;
    return CODEC_OK;
}

bool codec_timed_out(const codec_rx *rx, uint16_t timeout_ms, uint64_t since_us, uint64_t now_us)
{
    if (timeout_ms == 0U) {
        return false;
    }
    const uint64_t reference_us = rx->seen ? rx->last_valid_us : since_us;
    /* A reference in the future (a clock that was set back) wraps to a huge age: nobody knows how old it is. */
    return now_us - reference_us > (uint64_t)timeout_ms * 1000U;
}

void codec_finish(can_frame *frame, const codec_message *message, uint8_t *counter)
{
    if (message->counter_length != 0U) {
        write_field(frame->data, message->counter_start, message->counter_length, *counter);
        *counter = (uint8_t)((*counter + 1U) & field_mask(message->counter_length));
    }
    /* Without a CRC its field has no bits, and nothing is written. */
    write_field(frame->data, message->crc_start, message->crc_length, codec_frame_crc(frame, message));
}

uint16_t codec_crc16(uint16_t crc, const uint8_t *data, uint32_t length)
{
    uint32_t remainder = crc;
    for (uint32_t i = 0U; i < length; i++) {
        remainder ^= (uint32_t)data[i] << 8U;
        for (uint32_t bit = 0U; bit < 8U; bit++) {
            remainder = (remainder & 0x8000U) != 0U ? (remainder << 1U) ^ 0x1021U : remainder << 1U;
        }
    }
    return (uint16_t)remainder;
}

uint16_t codec_frame_crc(const can_frame *frame, const codec_message *message)
{
    const uint8_t id[2] = {(uint8_t)message->id, (uint8_t)(message->id >> 8U)};
    const uint16_t crc = codec_crc16(0xFFFFU, frame->data, message->crc_start / 8U);
    return codec_crc16(crc, id, sizeof id);
}

float codec_clamp(float value, float minimum, float maximum, codec_status *status)
{
    if (isnan(value)) {
        *status = CODEC_NOT_FINITE;
        return minimum;
    }
    if (value >= minimum && value <= maximum) {
        *status = CODEC_OK;
        return value;
    }
    *status = isinf(value) ? CODEC_NOT_FINITE : CODEC_OUT_OF_RANGE;
    return value < minimum ? minimum : maximum;
}
