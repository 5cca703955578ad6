/* Codec runtime, on the generated tables: any frame, any state before it. */
#include <math.h>

#include "common/codec.h"
#include "generated/codec_table.h"
#include "proofs/proof.h"

#define SECOND_US UINT64_C(1000000)

static can_frame any_frame(void)
{
    can_frame frame;
    return frame;
}

static codec_rx any_rx(void)
{
    codec_rx rx;
    rx.seen = nondet_bool();
    rx.counter_known = nondet_bool();
    return rx;
}

static const codec_message *any_message(void)
{
    const uint32_t row = nondet_uint32();
    ASSUME(row < codec_table_count);
    return &codec_table[row];
}

/* A row is found by its address, and nothing else is found. */
void proof_find(void)
{
    const codec_message *wanted = any_message();
    PROVE(codec_find(wanted->bus, wanted->id, wanted->extended != 0U) == wanted, "every row is found");
    const uint8_t bus = nondet_uint8();
    const uint32_t id = nondet_uint32();
    const bool extended = nondet_bool();
    const codec_message *found = codec_find(bus, id, extended);
    PROVE(found == 0 || (found->bus == bus && found->id == id && (found->extended != 0U) == extended),
          "what is found has the address");
}

/* A refused frame refreshes nothing, and each frame is counted once. */
void proof_receive(void)
{
    const can_frame frame = any_frame();
    const codec_rx before = any_rx();
    const uint64_t now_us = nondet_uint64();
    codec_rx rx = before;
    const codec_status status = codec_receive(&rx, &frame, now_us);
    PROVE(status <= CODEC_OK && -(int)status < CODEC_STATUS_COUNT, "a verdict of the enum");
    PROVE(rx.last_status == (int8_t)status, "the verdict is kept");
    if (status == CODEC_OK) {
        PROVE(rx.valid == before.valid + 1U && rx.rejected == before.rejected, "counted as valid");
        PROVE(rx.last_valid_us == now_us && rx.seen, "refreshed");
        const codec_message *message;
        PROVE(codec_accept(&frame, &message) == CODEC_OK, "valid frames are acceptable ones");
        PROVE(frame.dlc >= message->dlc, "with all their data");
        PROVE(message->counter_length == 0U || !before.counter_known || rx.counter != before.counter,
              "whose counter moved");
    } else {
        PROVE(rx.rejected == before.rejected + 1U && rx.valid == before.valid, "counted as rejected");
        PROVE(rx.last_valid_us == before.last_valid_us && rx.seen == before.seen, "refreshes nothing");
    }
}

/* The counter goes round, and nothing beside counter and CRC is written. */
void proof_finish(void)
{
    const codec_message *message = any_message();
    const can_frame packed = any_frame();
    can_frame frame = packed;
    frame.bus = message->bus;
    frame.id = message->id;
    frame.dlc = message->dlc;
    frame.flags = message->extended != 0U ? (uint8_t)CAN_FLAG_EXTENDED : 0U;
    const uint32_t modulus = UINT32_C(1) << message->counter_length;
    const uint8_t sent = nondet_uint8();
    ASSUME(sent < modulus);
    uint8_t counter = sent;
    codec_finish(&frame, message, &counter);
    PROVE(message->counter_length == 0U || counter == (sent + 1U) % modulus, "the counter goes round its width");

    const uint32_t bit = nondet_uint32();
    ASSUME(bit < 64U);
    const bool in_counter =
        bit >= message->counter_start && bit < (uint32_t)message->counter_start + message->counter_length;
    const bool in_crc = bit >= message->crc_start && bit < (uint32_t)message->crc_start + message->crc_length;
    PROVE(in_counter || in_crc || ((frame.data[bit / 8U] ^ packed.data[bit / 8U]) >> (bit % 8U) & 1U) == 0U,
          "no other bit is written");
}

/* The result is in range whatever the value is; only values in range pass as they are. */
void proof_clamp(void)
{
    const float value = nondet_float();
    const float minimum = nondet_float();
    const float maximum = nondet_float();
    ASSUME(minimum <= maximum);
    codec_status status;
    const float result = codec_clamp(value, minimum, maximum, &status);
    PROVE(result >= minimum && result <= maximum, "in range");
    PROVE((status == CODEC_OK) == (value >= minimum && value <= maximum), "OK says that it was in range");
    PROVE(status != CODEC_OK || result == value, "and then it is untouched");
    PROVE(!isnan(value) || status == CODEC_NOT_FINITE, "NaN is told");
}

/* Fresh up to the time-out and not a microsecond longer: times up to a second, time-outs up to 255 ms. */
void proof_timed_out(void)
{
    const codec_rx rx = any_rx();
    const uint16_t timeout_ms = nondet_uint8();
    const uint64_t since_us = nondet_uint64();
    const uint64_t reference_us = rx.seen ? rx.last_valid_us : since_us;
    PROVE(!codec_timed_out(&rx, 0U, since_us, nondet_uint64()), "never without a time-out");
    ASSUME(timeout_ms != 0U && reference_us < SECOND_US);
    const uint64_t last_us = reference_us + timeout_ms * UINT64_C(1000);
    PROVE(!codec_timed_out(&rx, timeout_ms, since_us, last_us), "fresh up to the time-out");
    PROVE(codec_timed_out(&rx, timeout_ms, since_us, last_us + 1U), "and not a microsecond longer");
}

/* Never when the clock was set back. */
void proof_clock_set_back(void)
{
    const codec_rx rx = any_rx();
    const uint16_t timeout_ms = nondet_uint16();
    const uint64_t now_us = nondet_uint64();
    ASSUME(timeout_ms != 0U && rx.seen && now_us < rx.last_valid_us && rx.last_valid_us < UINT64_C(1) << 63U);
    PROVE(codec_timed_out(&rx, timeout_ms, 0U, now_us), "a time in the future is too old");
}
