#include "dbc/codec_values.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "common/codec.h"
#include "generated/codec_values_table.h"

static int encode(const codec_values_message *message, const double *values, uint8_t *data)
{
    for (uint32_t i = 0; i < message->signal_count; i++) {
        const codec_values_signal *signal = &message->signals[i];
        const double raw = round((values[i] - signal->offset) / signal->scale);
        /* Written so that NaN fails. The generated pack functions would wrap it silently. */
        if (!(raw >= signal->raw_min && raw <= signal->raw_max)) {
            return (int)i + 1;
        }
    }
    message->encode(values, data);
    return CODEC_OK;
}

int codec_values_encode(uint32_t message_index, const double *values, uint8_t *data)
{
    if (message_index >= codec_table_count) {
        return CODEC_UNKNOWN_ID;
    }
    return encode(&codec_values_table[message_index], values, data);
}

int codec_values_decode(uint32_t message_index, const uint8_t *data, uint32_t length, double *values)
{
    if (message_index >= codec_table_count) {
        return CODEC_UNKNOWN_ID;
    }
    if (length < codec_table[message_index].dlc) {
        return CODEC_SHORT_FRAME;
    }
    uint8_t padded[CAN_DATA_MAX] = {0};
    memcpy(padded, data, length < CAN_DATA_MAX ? length : CAN_DATA_MAX);
    codec_values_table[message_index].decode(padded, values);
    return CODEC_OK;
}

int codec_values_frame(uint32_t message_index, uint64_t time_us, uint8_t sender, const double *values, can_frame *frame)
{
    return (int)codec_values_frames(message_index, &time_us, sender, values, 1, frame);
}

int64_t codec_values_frames(uint32_t message_index, const uint64_t *time_us, uint8_t sender, const double *values,
                            uint32_t count, can_frame *frames)
{
    if (message_index >= codec_table_count) {
        return CODEC_UNKNOWN_ID;
    }
    const codec_message *row = &codec_table[message_index];
    const codec_values_message *message = &codec_values_table[message_index];
    for (uint32_t i = 0; i < count; i++) {
        can_frame *frame = &frames[i];
        const int refused = encode(message, &values[(size_t)i * message->signal_count], frame->data);
        if (refused != CODEC_OK) {
            return (int64_t)i * message->signal_count + refused;
        }
        frame->time_us = time_us != NULL ? time_us[i] : 0U;
        frame->id = row->id;
        frame->bus = row->bus;
        frame->dlc = row->dlc;
        frame->flags = row->extended != 0U ? (uint8_t)CAN_FLAG_EXTENDED : 0U;
        frame->sender = sender;
    }
    return CODEC_OK;
}

void codec_values_identify(const can_frame *frames, uint32_t count, int32_t *message_index)
{
    for (uint32_t i = 0; i < count; i++) {
        const codec_message *message = NULL;
        const codec_status status = codec_accept(&frames[i], &message);
        message_index[i] = status == CODEC_OK ? (int32_t)(message - codec_table) : (int32_t)status;
    }
}

int codec_values_decode_columns(uint32_t message_index, const can_frame *frames, const uint32_t *rows, uint32_t count,
                                double *values)
{
    if (message_index >= codec_table_count) {
        return CODEC_UNKNOWN_ID;
    }
    const codec_values_message *message = &codec_values_table[message_index];
    double one[8 * CAN_DATA_MAX]; /* no message has more signals than bits */
    for (uint32_t i = 0; i < count; i++) {
        message->decode(frames[rows[i]].data, one);
        for (uint32_t s = 0; s < message->signal_count; s++) {
            values[(size_t)s * count + i] = one[s];
        }
    }
    return CODEC_OK;
}
