/* Health of the sensors: age, update rate, data size and plausibility of what they send (SSM-4).
 *
 * A sample is the group of frames that starts with the sensor's first message; its size is the number of frames that
 * came before the next sample started. Only frames that pass the codec count. Nothing is healthy until it was seen.
 */
#ifndef RACELOOP_OBC_SENSOR_MONITOR_H
#define RACELOOP_OBC_SENSOR_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"
#include "obc/rate_counter.h"
#include "obc/sensor_values.h"

enum sensor_id {
    SENSOR_GNSS_A = 0,
    SENSOR_GNSS_B = 1,
    SENSOR_IMU = 2,
    SENSOR_COUNT = 3,
};

/* Limits of one sensor. */
typedef struct sensor_limits {
    uint32_t timeout_ms;          /* age of the newest sample */
    float min_rate;               /* samples per second */
    uint32_t data_size;           /* frames per sample */
    uint32_t frozen_timeout_ms;   /* time without a change of a message's values */
    float max_step[SENSOR_STEPS]; /* largest jump, in the units of sensor_values.step */
} sensor_limits;

/* Verdict on one sensor. */
typedef struct sensor_health {
    uint16_t age_ms;   /* of the newest sample, saturating; 65535 when there was none */
    uint16_t rate;     /* samples in the last full second */
    uint16_t size;     /* frames of the newest finished sample */
    uint16_t still_ms; /* longest time for which a message has repeated itself, saturating */
    uint8_t jumps;     /* bit n: step n of the newest sample is too large */
    bool timed_out;
    bool low_rate;
    bool wrong_size;
    bool frozen;
} sensor_health;

/* Reception state of one sensor. */
typedef struct sensor_state {
    codec_rx rx[SENSOR_FRAMES_MAX];
    uint64_t sample_us; /* start of the newest sample */
    rate_counter rate;  /* of samples */
    uint16_t frames;    /* of the sample being received */
    uint16_t size;      /* frames of the newest finished sample; 0: none yet */
    bool seen;          /* a sample has started */
    sensor_values values;
} sensor_state;

/* All sensors: zero it to start. */
typedef struct sensor_monitor {
    sensor_state sensors[SENSOR_COUNT];
} sensor_monitor;

/* Take a frame from CAN-S; frames of no sensor are ignored. now_us: time of the tick, monotonic. */
void sensor_monitor_push(sensor_monitor *self, const can_frame *frame, uint64_t now_us);

/* Verdict on a sensor. sensor: enum sensor_id below SENSOR_COUNT. now_us: not before the newest push. */
sensor_health sensor_monitor_check(sensor_monitor *self, uint32_t sensor, const sensor_limits *limits, uint64_t now_us);

/* Speed over ground by a receiver, m/s. sensor: SENSOR_GNSS_A or SENSOR_GNSS_B. */
float sensor_monitor_ground_speed(const sensor_monitor *self, uint32_t sensor);

#endif
