/* What the values of one sensor do: whether they move at all, and whether they jump.
 *
 * A sensor that works is never still, because its noise reaches the last bits; one whose values repeat bit for bit
 * under a counter that goes on has frozen. A jump is what the sensor's own last sample cannot explain: a GNSS position
 * off the one that position and velocity before it lead to, and an IMU's rate or specific force off the one before.
 */
#ifndef RACELOOP_OBC_SENSOR_VALUES_H
#define RACELOOP_OBC_SENSOR_VALUES_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"

enum {
    SENSOR_FRAMES_MAX = 4, /* messages per sensor */
    SENSOR_AXES = 3,
    SENSOR_STEPS = 2, /* GNSS: position, m. IMU: angular rate, rad/s; specific force, m/s2 */
};

/* Newest content of one message. */
typedef struct sensor_content {
    uint8_t data[CAN_DATA_MAX]; /* without the counter */
    uint64_t changed_us;
    bool seen;
} sensor_content;

/* Values of one sensor: zero it to start. */
typedef struct sensor_values {
    sensor_content content[SENSOR_FRAMES_MAX];
    float axes[SENSOR_STEPS][SENSOR_AXES]; /* GNSS: [0] velocity east, north, up; IMU: rates, specific force */
    float step[SENSOR_STEPS];              /* of the newest sample, not negative */
    int32_t latitude;                      /* 1e-7 degree */
    int32_t longitude;
    uint64_t sample_us; /* of the newest sample */
    uint64_t gap_us;    /* between the newest sample and the one before it */
    bool sampled;
} sensor_values;

/* Take a valid frame of a GNSS receiver. index: of its message, in the order position, velocity, attitude, quality.
 * frame: A's or B's, which are laid out alike. now_us: time of the tick, monotonic. */
void sensor_values_take_gnss(sensor_values *self, uint32_t index, const can_frame *frame, uint64_t now_us);

/* Take a valid frame of the IMU. index: of its message, in the order rates, specific force. */
void sensor_values_take_imu(sensor_values *self, uint32_t index, const can_frame *frame, uint64_t now_us);

/* Longest time for which one of the first `messages` messages has repeated itself, microseconds; 0 for one that was
 * never seen. messages: at most SENSOR_FRAMES_MAX. */
uint64_t sensor_values_still_us(const sensor_values *self, uint32_t messages, uint64_t now_us);

/* Speed over ground by a GNSS receiver, m/s. */
float sensor_values_ground_speed(const sensor_values *self);

#endif
