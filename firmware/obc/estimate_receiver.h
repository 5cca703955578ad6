/* The state of the car as estimation sends it on CAN-A, and the vertical acceleration that the IMU measures. */
#ifndef RACELOOP_OBC_ESTIMATE_RECEIVER_H
#define RACELOOP_OBC_ESTIMATE_RECEIVER_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"
#include "obc/control.h"

enum { ESTIMATE_FRAMES = 3 };

/* Quality of the estimate; the numbers are those of estimate_quality.estimate_quality_level. */
enum estimate_quality {
    ESTIMATE_LOST = 0,
    ESTIMATE_BAD = 1,
    ESTIMATE_DEGRADED = 2,
    ESTIMATE_GOOD = 3,
};

/* Newest estimate: zero it to start, which is LOST. */
typedef struct estimate_receiver {
    codec_rx rx[ESTIMATE_FRAMES]; /* position, motion, quality */
    codec_rx imu_rx;
    control_estimate estimate;   /* `valid` is left to estimate_receiver_get */
    float vertical_acceleration; /* m/s2, without gravity on level ground */
    uint8_t quality;             /* enum estimate_quality */
} estimate_receiver;

/* Take a frame from CAN-A or CAN-S; others are ignored. now_us: time of the tick, monotonic. */
void estimate_receiver_push(estimate_receiver *self, const can_frame *frame, uint64_t now_us);

/* True when all parts of the estimate are at most timeout_ms old. */
bool estimate_receiver_fresh(const estimate_receiver *self, uint32_t timeout_ms, uint64_t now_us);

/* The estimate; valid when it is fresh and its quality is not LOST. */
control_estimate estimate_receiver_get(const estimate_receiver *self, uint32_t timeout_ms, uint64_t now_us);

#endif
