#include "obc/sensor_monitor.h"

#include "generated/sensors.h"

/* Messages of each sensor; the first starts a sample. */
typedef struct sensor_messages {
    uint32_t first_id;
    uint32_t count;
} sensor_messages;

static const sensor_messages messages[SENSOR_COUNT] = {
    [SENSOR_GNSS_A] = {SENSORS_GNSS_A_POSITION_FRAME_ID, 4},
    [SENSOR_GNSS_B] = {SENSORS_GNSS_B_POSITION_FRAME_ID, 4},
    [SENSOR_IMU] = {SENSORS_IMU_RATES_FRAME_ID, 2},
};

/* Move on to the bucket of now_us, emptying those that are entered. */
static void advance_buckets(sensor_state *self, uint64_t now_us)
{
    const uint64_t bucket = now_us / SENSOR_BUCKET_US;
    for (uint32_t i = 0U; i < SENSOR_BUCKETS && self->bucket < bucket; i++) {
        self->bucket++;
        self->buckets[self->bucket % SENSOR_BUCKETS] = 0U;
    }
    self->bucket = bucket; /* after a gap of more than all buckets, which are empty now */
}

static void start_sample(sensor_state *self, uint64_t now_us)
{
    if (self->seen) {
        self->size = self->frames;
    }
    self->frames = 0U;
    self->seen = true;
    self->sample_us = now_us;
    advance_buckets(self, now_us);
    self->buckets[self->bucket % SENSOR_BUCKETS]++;
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
    }
}

sensor_health sensor_monitor_check(sensor_monitor *self, uint32_t sensor, const sensor_limits *limits, uint64_t now_us)
{
    sensor_state *state = &self->sensors[sensor];
    advance_buckets(state, now_us);
    uint32_t rate = 0U;
    for (uint32_t i = 0U; i < SENSOR_BUCKETS; i++) {
        rate += i == state->bucket % SENSOR_BUCKETS ? 0U : state->buckets[i];
    }
    const uint64_t age_ms = state->seen ? (now_us - state->sample_us) / 1000U : UINT16_MAX;
    return (sensor_health){
        .age_ms = age_ms < UINT16_MAX ? (uint16_t)age_ms : UINT16_MAX,
        .rate = rate < UINT16_MAX ? (uint16_t)rate : UINT16_MAX,
        .size = state->size,
        .timed_out = !state->seen || age_ms > limits->timeout_ms,
        .low_rate = (float)rate < limits->min_rate,
        .wrong_size = state->size != limits->data_size,
    };
}
