#include "obc/estimate_receiver.h"

#include "generated/autonomy.h"
#include "generated/sensors.h"

#define STANDARD_GRAVITY 9.80665f /* m/s2 */

static void take_position(control_estimate *estimate, const uint8_t *data)
{
    struct autonomy_estimate_position_t position;
    (void)autonomy_estimate_position_unpack(&position, data, CAN_DATA_MAX);
    estimate->x = (float)autonomy_estimate_position_estimate_x_decode(position.estimate_x);
    estimate->y = (float)autonomy_estimate_position_estimate_y_decode(position.estimate_y);
}

static void take_motion(control_estimate *estimate, const uint8_t *data)
{
    struct autonomy_estimate_motion_t motion;
    (void)autonomy_estimate_motion_unpack(&motion, data, CAN_DATA_MAX);
    estimate->vx = (float)autonomy_estimate_motion_estimate_vx_decode(motion.estimate_vx);
    estimate->vy = (float)autonomy_estimate_motion_estimate_vy_decode(motion.estimate_vy);
    estimate->yaw = (float)autonomy_estimate_motion_estimate_yaw_decode(motion.estimate_yaw);
    estimate->yaw_rate = (float)autonomy_estimate_motion_estimate_yaw_rate_decode(motion.estimate_yaw_rate);
}

static void take_quality(estimate_receiver *self, const uint8_t *data)
{
    struct autonomy_estimate_quality_t quality;
    (void)autonomy_estimate_quality_unpack(&quality, data, CAN_DATA_MAX);
    self->estimate.ax = (float)autonomy_estimate_quality_estimate_ax_decode(quality.estimate_ax);
    self->estimate.ay = (float)autonomy_estimate_quality_estimate_ay_decode(quality.estimate_ay);
    self->quality = quality.estimate_quality_level;
}

static void take_specific_force(estimate_receiver *self, const uint8_t *data)
{
    struct sensors_imu_specific_force_t imu;
    (void)sensors_imu_specific_force_unpack(&imu, data, CAN_DATA_MAX);
    const double up = sensors_imu_specific_force_imu_specific_force_z_decode(imu.imu_specific_force_z);
    self->vertical_acceleration = (float)up - STANDARD_GRAVITY;
}

void estimate_receiver_push(estimate_receiver *self, const can_frame *frame, uint64_t now_us)
{
    switch (frame->id) {
    case AUTONOMY_ESTIMATE_POSITION_FRAME_ID:
        if (codec_receive(&self->rx[0], frame, now_us) == CODEC_OK) {
            take_position(&self->estimate, frame->data);
        }
        break;
    case AUTONOMY_ESTIMATE_MOTION_FRAME_ID:
        if (codec_receive(&self->rx[1], frame, now_us) == CODEC_OK) {
            take_motion(&self->estimate, frame->data);
        }
        break;
    case AUTONOMY_ESTIMATE_QUALITY_FRAME_ID:
        if (codec_receive(&self->rx[2], frame, now_us) == CODEC_OK) {
            take_quality(self, frame->data);
        }
        break;
    case SENSORS_IMU_SPECIFIC_FORCE_FRAME_ID:
        if (codec_receive(&self->imu_rx, frame, now_us) == CODEC_OK) {
            take_specific_force(self, frame->data);
        }
        break;
    default:
        break;
    }
}

bool estimate_receiver_fresh(const estimate_receiver *self, uint32_t timeout_ms, uint64_t now_us)
{
    for (uint32_t i = 0U; i < ESTIMATE_FRAMES; i++) {
        if (!self->rx[i].seen || now_us - self->rx[i].last_valid_us > (uint64_t)timeout_ms * 1000U) {
            return false;
        }
    }
    return true;
}

control_estimate estimate_receiver_get(const estimate_receiver *self, uint32_t timeout_ms, uint64_t now_us)
{
    control_estimate estimate = self->estimate;
    estimate.valid = self->quality != ESTIMATE_LOST && estimate_receiver_fresh(self, timeout_ms, now_us);
    return estimate;
}
