#include "obc/scan_monitor.h"

#include <stddef.h>

#include "common/codec.h"
#include "generated/autonomy.h"

void scan_monitor_push(scan_monitor *self, const can_frame *frame, uint64_t now_us)
{
    const codec_message *message = NULL;
    struct autonomy_sensor_notice_t notice = {0};
    (void)autonomy_sensor_notice_unpack(&notice, frame->data, CAN_DATA_MAX);
    const uint32_t sensor = (uint32_t)notice.sensor_id - SCAN_FIRST_ID; /* wraps beyond the count for lower ids */
    if (codec_accept(frame, &message) != CODEC_OK || sensor >= SCAN_COUNT) {
        self->rejected++;
        return;
    }
    scan_state *state = &self->sensors[sensor];
    if (!state->seen || notice.sensor_sequence != state->sequence) {
        state->new_us = now_us;
    }
    state->notice_us = now_us;
    state->sequence = notice.sensor_sequence;
    state->size = notice.sensor_data_size;
    state->sample_age_ms = notice.sensor_sample_age;
    state->seen = true;
    rate_counter_add(&state->rate, now_us);
}

/* Milliseconds since a time, saturating. */
static uint16_t elapsed_ms(uint64_t since_us, uint32_t more_ms, uint64_t now_us)
{
    const uint64_t elapsed = (now_us - since_us) / 1000U + more_ms;
    return elapsed < UINT16_MAX ? (uint16_t)elapsed : (uint16_t)UINT16_MAX;
}

scan_health scan_monitor_check(scan_monitor *self, uint32_t sensor, const scan_limits *limits, uint64_t now_us)
{
    scan_state *state = &self->sensors[sensor];
    const uint16_t age_ms =
        state->seen ? elapsed_ms(state->notice_us, state->sample_age_ms, now_us) : (uint16_t)UINT16_MAX;
    const uint16_t still_ms = state->seen ? elapsed_ms(state->new_us, 0U, now_us) : (uint16_t)UINT16_MAX;
    const uint32_t rate = rate_counter_get(&state->rate, now_us);
    const bool timed_out = age_ms > limits->timeout_ms;
    return (scan_health){
        .age_ms = age_ms,
        .still_ms = still_ms,
        .rate = rate,
        .size = state->size,
        .timed_out = timed_out,
        .low_rate = (float)rate < limits->min_rate,
        .wrong_size = state->size < limits->min_size || state->size > limits->max_size,
        .frozen = !timed_out && still_ms > limits->timeout_ms, /* silence is no standstill */
    };
}
