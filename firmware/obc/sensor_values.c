#include "obc/sensor_values.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "common/codec.h"
#include "generated/sensors.h"

#define DEGREE       (3.14159265f / 180.0f)
#define EARTH_RADIUS 6378137.0f /* m, equatorial, WGS 84 */
#define RAW_DEGREE   1.0e-7f    /* step of latitude and longitude */

enum {
    GNSS_POSITION = 0,
    GNSS_VELOCITY = 1,
    IMU_RATES = 0,
    EAST = 0,
    NORTH = 1,
};

/* Remember a message's content, and when it last changed. */
static void take_content(sensor_content *self, const can_frame *frame, uint64_t now_us)
{
    uint8_t data[CAN_DATA_MAX];
    memcpy(data, frame->data, sizeof data);
    const codec_message *message = codec_find(frame->bus, frame->id, false);
    if (message != NULL) {
        for (uint32_t i = 0U; i < message->counter_length; i++) {
            const uint32_t bit = (uint32_t)message->counter_start + i;
            data[bit / 8U] &= (uint8_t)~(1U << (bit % 8U));
        }
    }
    if (!self->seen || memcmp(self->data, data, sizeof data) != 0) {
        memcpy(self->data, data, sizeof data);
        self->changed_us = now_us;
        self->seen = true;
    }
}

/* Distance between a position and the one that the last sample leads to, m. Differences of raw positions are small and
 * exact, so single precision will do. */
static float position_step(const sensor_values *self, const struct sensors_gnss_a_position_t *position, float seconds)
{
    const float metres = RAW_DEGREE * DEGREE * EARTH_RADIUS;
    const int64_t north = (int64_t)position->gnss_a_latitude - self->latitude;
    const int64_t east = (int64_t)position->gnss_a_longitude - self->longitude;
    const float narrowing = cosf((float)self->latitude * RAW_DEGREE * DEGREE);
    return hypotf((float)east * metres * narrowing - self->axes[0][EAST] * seconds,
                  (float)north * metres - self->axes[0][NORTH] * seconds);
}

static void start_sample(sensor_values *self, uint64_t now_us)
{
    self->gap_us = now_us - self->sample_us;
    self->sample_us = now_us;
    self->sampled = true;
}

static void take_position(sensor_values *self, const uint8_t *data, uint64_t now_us)
{
    struct sensors_gnss_a_position_t position;
    (void)sensors_gnss_a_position_unpack(&position, data, CAN_DATA_MAX);
    const float seconds = (float)(now_us - self->sample_us) * 1.0e-6f;
    self->step[0] = self->sampled && self->content[GNSS_VELOCITY].seen ? position_step(self, &position, seconds) : 0.0f;
    self->latitude = position.gnss_a_latitude;
    self->longitude = position.gnss_a_longitude;
    start_sample(self, now_us);
}

static void take_velocity(sensor_values *self, const uint8_t *data)
{
    struct sensors_gnss_a_velocity_t velocity;
    (void)sensors_gnss_a_velocity_unpack(&velocity, data, CAN_DATA_MAX);
    self->axes[0][EAST] = (float)sensors_gnss_a_velocity_gnss_a_velocity_east_decode(velocity.gnss_a_velocity_east);
    self->axes[0][NORTH] = (float)sensors_gnss_a_velocity_gnss_a_velocity_north_decode(velocity.gnss_a_velocity_north);
}

void sensor_values_take_gnss(sensor_values *self, uint32_t index, const can_frame *frame, uint64_t now_us)
{
    if (index == GNSS_POSITION) {
        take_position(self, frame->data, now_us);
    } else if (index == GNSS_VELOCITY) {
        take_velocity(self, frame->data);
    }
    take_content(&self->content[index], frame, now_us);
}

/* Largest change of an axis since the sample before; 0 for the first one. */
static float axes_step(float *last, const float *axes, bool first)
{
    float step = 0.0f;
    for (uint32_t i = 0U; i < SENSOR_AXES; i++) {
        step = first ? 0.0f : fmaxf(step, fabsf(axes[i] - last[i]));
        last[i] = axes[i];
    }
    return step;
}

static void take_rates(const uint8_t *data, float *axes)
{
    struct sensors_imu_rates_t rates;
    (void)sensors_imu_rates_unpack(&rates, data, CAN_DATA_MAX);
    axes[0] = (float)sensors_imu_rates_imu_roll_rate_decode(rates.imu_roll_rate);
    axes[1] = (float)sensors_imu_rates_imu_pitch_rate_decode(rates.imu_pitch_rate);
    axes[2] = (float)sensors_imu_rates_imu_yaw_rate_decode(rates.imu_yaw_rate);
}

static void take_force(const uint8_t *data, float *axes)
{
    struct sensors_imu_specific_force_t force;
    (void)sensors_imu_specific_force_unpack(&force, data, CAN_DATA_MAX);
    axes[0] = (float)sensors_imu_specific_force_imu_specific_force_x_decode(force.imu_specific_force_x);
    axes[1] = (float)sensors_imu_specific_force_imu_specific_force_y_decode(force.imu_specific_force_y);
    axes[2] = (float)sensors_imu_specific_force_imu_specific_force_z_decode(force.imu_specific_force_z);
}

void sensor_values_take_imu(sensor_values *self, uint32_t index, const can_frame *frame, uint64_t now_us)
{
    float axes[SENSOR_AXES];
    if (index == IMU_RATES) {
        take_rates(frame->data, axes);
        start_sample(self, now_us);
    } else {
        take_force(frame->data, axes);
    }
    self->step[index] = axes_step(self->axes[index], axes, !self->content[index].seen);
    take_content(&self->content[index], frame, now_us);
}

uint64_t sensor_values_still_us(const sensor_values *self, uint32_t messages, uint64_t now_us)
{
    uint64_t longest = 0U;
    for (uint32_t i = 0U; i < messages; i++) {
        const sensor_content *content = &self->content[i];
        if (content->seen && now_us - content->changed_us > longest) {
            longest = now_us - content->changed_us;
        }
    }
    return longest;
}

float sensor_values_ground_speed(const sensor_values *self)
{
    return hypotf(self->axes[0][EAST], self->axes[0][NORTH]);
}
