#include "obc/sensor_monitor.h"

#include "generated/sensors.h"

/* Messages of each sensor; the first starts a sample. */
typedef struct sensor_messages {
    uint32_t first_id;
    uint32_t count;
    uint32_t moving; /* the first so many are never still; what a receiver says of its own quality may be */
    void (*take)(sensor_values *values, uint32_t index, const can_frame *frame, uint64_t now_us);
} sensor_messages;

static const sensor_messages messages[SENSOR_COUNT] = {
    [SENSOR_GNSS_A] = {SENSORS_GNSS_A_POSITION_FRAME_ID, 4, 3, sensor_values_take_gnss},
    [SENSOR_GNSS_B] = {SENSORS_GNSS_B_POSITION_FRAME_ID, 4, 3, sensor_values_take_gnss},
    [SENSOR_IMU] = {SENSORS_IMU_RATES_FRAME_ID, 2, 2, sensor_values_take_imu},
};

static void start_sample(sensor_state *self, uint64_t now_us)
{
    if (self->seen) {
        self->size = self->frames;
    }
    self->frames = 0U;
    self->seen = true;
    self->sample_us = now_us;
    rate_counter_add(&self->rate, now_us);
}

void sensor_monitor_push(sensor_monitor *self, const can_frame *frame, uint64_t now_us)
{
    for (uint32_t i = 0U; i < SENSOR_COUNT; i++) {
        sensor_state *sensor = &self->sensors[i];
        const uint32_t index = frame->id - messages[i].first_id; /* wraps beyond count for lower ids */
        if (index >= messages[i].count || codec_receive(&sensor->rx[index], frame, now_us) != CODEC_OK) {
            continue;
        }
        if (index == 0U) {
            start_sample(sensor, now_us);
        }
        if (sensor->frames < UINT16_MAX) {
            sensor->frames++;
        }
        messages[i].take(&sensor->values, index, frame, now_us);
    }
}

static uint16_t saturated(uint64_t value)
{
    return value < UINT16_MAX ? (uint16_t)value : (uint16_t)UINT16_MAX;
}

/* Steps that are too large. After a gap as long as a time-out the last sample explains nothing any more. */
static uint8_t find_jumps(const sensor_values *values, const sensor_limits *limits)
{
    uint8_t jumps = 0U;
    for (uint32_t i = 0U; i < SENSOR_STEPS; i++) {
        if (values->gap_us <= (uint64_t)limits->timeout_ms * 1000U && !(values->step[i] <= limits->max_step[i])) {
            jumps |= (uint8_t)(1U << i);
        }
    }
    return jumps;
}

sensor_health sensor_monitor_check(sensor_monitor *self, uint32_t sensor, const sensor_limits *limits, uint64_t now_us)
{
    sensor_state *state = &self->sensors[sensor];
    const uint32_t rate = rate_counter_get(&state->rate, now_us);
    const uint64_t age_ms = state->seen ? (now_us - state->sample_us) / 1000U : UINT16_MAX;
    const bool timed_out = !state->seen || age_ms > limits->timeout_ms;
    const uint64_t still_ms = sensor_values_still_us(&state->values, messages[sensor].moving, now_us) / 1000U;
    return (sensor_health){
        .age_ms = saturated(age_ms),
        .rate = saturated(rate),
        .size = state->size,
        .still_ms = saturated(still_ms),
        .jumps = find_jumps(&state->values, limits),
        .timed_out = timed_out,
        .low_rate = (float)rate < limits->min_rate,
        .wrong_size = state->size != limits->data_size,
        .frozen = !timed_out && still_ms > limits->frozen_timeout_ms, /* silence is no standstill of values */
    };
}

float sensor_monitor_ground_speed(const sensor_monitor *self, uint32_t sensor)
{
    return sensor_values_ground_speed(&self->sensors[sensor].values);
}
