#include "dbc/codec_values.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "common/codec.h"
#include "generated/codec_table.h"
#include "generated/codec_values_table.h"

/* A message of a profile, or null. */
static const codec_values_message *find(uint32_t profile, uint32_t message_index)
{
    if (profile >= CODEC_PROFILE_COUNT || message_index >= codec_profiles[profile].count) {
        return NULL;
    }
    return &codec_values_profiles[profile].messages[message_index];
}

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

int codec_values_encode(uint32_t profile, uint32_t message_index, const double *values, uint8_t *data)
{
    const codec_values_message *message = find(profile, message_index);
    return message != NULL ? encode(message, values, data) : CODEC_UNKNOWN_ID;
}

int codec_values_decode(uint32_t profile, uint32_t message_index, const uint8_t *data, uint32_t length, double *values)
{
    const codec_values_message *message = find(profile, message_index);
    if (message == NULL) {
        return CODEC_UNKNOWN_ID;
    }
    if (length < codec_profiles[profile].messages[message_index].dlc) {
        return CODEC_SHORT_FRAME;
    }
    uint8_t padded[CAN_DATA_MAX] = {0};
    memcpy(padded, data, length < CAN_DATA_MAX ? length : CAN_DATA_MAX);
    message->decode(padded, values);
    return CODEC_OK;
}

int codec_values_frame(uint32_t profile, uint32_t message_index, uint64_t time_us, uint8_t sender, const double *values,
                       can_frame *frame)
{
    return (int)codec_values_frames(profile, message_index, &time_us, sender, values, 1, frame);
}

int64_t codec_values_frames(uint32_t profile, uint32_t message_index, const uint64_t *time_us, uint8_t sender,
                            const double *values, uint32_t count, can_frame *frames)
{
    const codec_values_message *message = find(profile, message_index);
    if (message == NULL) {
        return CODEC_UNKNOWN_ID;
    }
    const codec_message *row = &codec_profiles[profile].messages[message_index];
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

void codec_values_identify(uint32_t profile, const can_frame *frames, uint32_t count, int32_t *message_index)
{
    const codec_profile *table = &codec_profiles[profile];
    for (uint32_t i = 0; i < count; i++) {
        const codec_message *message = NULL;
        const codec_status status = codec_accept_in(table, &frames[i], &message);
        message_index[i] = status == CODEC_OK ? (int32_t)(message - table->messages) : (int32_t)status;
    }
}

int codec_values_decode_columns(uint32_t profile, uint32_t message_index, const can_frame *frames, const uint32_t *rows,
                                uint32_t count, double *values)
{
    const codec_values_message *message = find(profile, message_index);
    if (message == NULL) {
        return CODEC_UNKNOWN_ID;
    }
    double one[8 * CAN_DATA_MAX]; /* no message has more signals than bits */
    for (uint32_t i = 0; i < count; i++) {
        message->decode(frames[rows[i]].data, one);
        for (uint32_t s = 0; s < message->signal_count; s++) {
            values[(size_t)s * count + i] = one[s];
        }
    }
    return CODEC_OK;
}
