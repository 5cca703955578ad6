/* Generated decoders and encoders, codec runtime, translation of profiles. Input: profile, row, 24 bytes of a frame,
 * which is decoded, encoded, received and translated; then values to be encoded. */
#include "hil_tests/fuzz/fuzz_bytes.h"

#include <math.h>

#include "common/codec.h"
#include "common/dbw_profile.h"
#include "dbc/codec_values.h"
#include "generated/codec_table.h"
#include "generated/codec_values_table.h"

enum { SIGNALS_MAX = 64 };

/* What was decoded can be encoded, unless it is a NaN or an infinity, and then means the same. */
static void there_and_back(uint32_t profile, uint32_t index, const uint8_t *data)
{
    double values[SIGNALS_MAX];
    double again[SIGNALS_MAX];
    uint8_t encoded[CAN_DATA_MAX];
    const codec_values_message *message = &codec_values_profiles[profile].messages[index];
    FUZZ_CHECK(codec_values_decode(profile, index, data, CAN_DATA_MAX, values) == 0);
    const int refused = codec_values_encode(profile, index, values, encoded);
    if (refused != 0) {
        FUZZ_CHECK(refused > 0 && !isfinite(values[refused - 1]));
        return;
    }
    FUZZ_CHECK(codec_values_decode(profile, index, encoded, CAN_DATA_MAX, again) == 0);
    for (uint32_t i = 0; i < message->signal_count; i++) {
        FUZZ_CHECK(values[i] == again[i]);
    }
}

static void encode_anything(uint32_t profile, uint32_t index, fuzz_bytes *in)
{
    double values[SIGNALS_MAX];
    uint8_t encoded[CAN_DATA_MAX];
    fuzz_take(in, values, sizeof values);
    const int refused = codec_values_encode(profile, index, values, encoded);
    FUZZ_CHECK(refused >= 0 && refused <= (int)codec_values_profiles[profile].messages[index].signal_count);
}

static void receive(const can_frame *frame)
{
    const codec_message *message;
    codec_rx rx = {0};
    const codec_status status = codec_receive(&rx, frame, 1000U);
    FUZZ_CHECK((status == CODEC_OK) == (rx.valid == 1U) && rx.valid + rx.rejected == 1U);
    if (codec_accept(frame, &message) != CODEC_OK) {
        FUZZ_CHECK(status != CODEC_OK);
        return;
    }
    can_frame finished = *frame;
    uint8_t counter = (uint8_t)((rx.counter + 1U) & ((1U << message->counter_length) - 1U));
    codec_finish(&finished, message, &counter);
    FUZZ_CHECK(codec_receive(&rx, &finished, 2000U) == CODEC_OK);
    FUZZ_CHECK(message->counter_length == 0U || codec_receive(&rx, &finished, 3000U) == CODEC_COUNTER_STUCK);
}

static void translate(const can_frame *frame, uint8_t profile)
{
    dbw_profile speaker = {0};
    can_frame v14;
    FUZZ_CHECK(dbw_profile_select(&speaker, profile));
    FUZZ_CHECK(dbw_profile_receive(&speaker, frame, &v14) <= DBW_PROFILE_REFUSED);
    const codec_message *message;
    if (codec_accept(frame, &message) == CODEC_OK) {
        can_frame sent[2] = {*frame, *frame};
        can_outbox out = {.frames = sent, .capacity = 2, .count = 2};
        dbw_profile_send(&speaker, &out, 0U);
        FUZZ_CHECK(out.count <= 2U);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    fuzz_bytes in = {data, size};
    const uint32_t profile = fuzz_u8(&in) % CODEC_PROFILE_COUNT;
    const uint32_t index = fuzz_u8(&in) % codec_profiles[profile].count;
    const codec_message *message = &codec_profiles[profile].messages[index];
    can_frame frame;
    fuzz_take(&in, &frame, sizeof frame);
    there_and_back(profile, index, frame.data);
    receive(&frame);
    translate(&frame, (uint8_t)profile);
    frame.id = message->id;
    frame.bus = message->bus;
    frame.dlc = message->dlc;
    frame.flags = message->extended != 0U ? (uint8_t)CAN_FLAG_EXTENDED : 0U;
    receive(&frame);
    translate(&frame, (uint8_t)profile);
    encode_anything(profile, index, &in);
    float value;
    float end;
    fuzz_take(&in, &value, sizeof value);
    fuzz_take(&in, &end, sizeof end);
    if (isfinite(end)) {
        codec_status status;
        const float clamped = codec_clamp(value, -fabsf(end), fabsf(end), &status);
        FUZZ_CHECK(clamped >= -fabsf(end) && clamped <= fabsf(end));
        FUZZ_CHECK((status == CODEC_OK) == (clamped == value));
    }
    return 0;
}
