#include "space_drive/reports.h"

#include <math.h>
#include <stddef.h>

#include "generated/space_drive.h"

enum {
    ID_STRIDE = 2, /* steering and brake channels alternate: 0x80 steer 1, 0x81 brake 1, 0x82 steer 2 ... */
    FRAME_BYTES = 8,
    MILLIVOLTS = 1000, /* batteries in mV: the public file gives no scale, this one is ours */
};

/* The braking light comes on above this demand, Pa. */
static const float brake_light_pressure = 1.0e5f;

static can_frame *add(can_outbox *out, uint32_t first_id, uint32_t channel)
{
    return can_outbox_add(out, (uint8_t)CAN_BUS_3, first_id + ID_STRIDE * channel, 0, FRAME_BYTES);
}

static bool axis_disturbed(const space_drive_axis *axis)
{
    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        if (axis->channels[i].excluded) {
            return true;
        }
    }
    return axis->failed || axis->requests_lost;
}

/* The position messages of all channels and both axes have one layout; so have the error messages and, per axis,
 * the status messages. One pack function serves each family; a contract test holds the layouts together. */
static void send_positions(const space_drive_axis *axis, const space_drive_axis_config *config, uint32_t first_id,
                           uint8_t counters[SPACE_DRIVE_CHANNELS], can_outbox *out)
{
    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        const space_drive_channel *channel = &axis->channels[i];
        can_frame *frame = add(out, first_id, i);
        if (frame == NULL) {
            return;
        }
        const bool plausible = channel->sensor_valid && !channel->excluded;
        const struct space_drive_calb_steer_pos_1_t message = {
            .cur_steer_pos_steering_pos_1 = channel->sensor_valid ? space_drive_axis_counts(config, channel->position)
                                                                  : (uint16_t)SPACE_DRIVE_INVALID,
            .plausibity = (uint8_t)(plausible ? SPACE_DRIVE_PLAUSIBLE : SPACE_DRIVE_NOT_PLAUSIBLE),
        };
        (void)space_drive_calb_steer_pos_1_pack(frame->data, &message, sizeof frame->data);
        codec_finish(frame, codec_find((uint8_t)CAN_BUS_3, frame->id, false), &counters[i]);
    }
}

void space_drive_send_positions(space_drive *self, can_outbox *out)
{
    send_positions(&self->steer, &self->config.steer, SPACE_DRIVE_CALB_STEER_POS_1_FRAME_ID, self->steer_counter, out);
    send_positions(&self->brake, &self->config.brake, SPACE_DRIVE_CALB_BRAKE_POS_1_FRAME_ID, self->brake_counter, out);
}

void space_drive_send_steer_status(const space_drive *self, can_outbox *out)
{
    const bool starting = !(self->steer.ready && self->brake.ready);
    const bool disturbed = axis_disturbed(&self->steer);

    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        const space_drive_channel *channel = &self->steer.channels[i];
        can_frame *frame = add(out, SPACE_DRIVE_STAT_STEER_1_FRAME_ID, i);
        if (frame == NULL) {
            return;
        }
        const struct space_drive_stat_steer_1_t message = {
            .strt_initial = starting,
            .ign_actv = 1,
            .ip_sgnl_vald = channel->request.state == SPACE_DRIVE_REQUEST_FRESH,
            .str_ctrl_act = self->steer.ready && !self->steer.failed,
            .err_led_act = disturbed,
            .warn_ton_actv = self->emergency != 0,
            .emr_brk = self->emergency != 0,
            .brk_lit_actv = self->brake_demand > brake_light_pressure,
            .veh_in_motn = channel->request.speed_kmh > 0,
        };
        (void)space_drive_stat_steer_1_pack(frame->data, &message, sizeof frame->data);
    }
}

static uint16_t millivolts(float volts)
{
    codec_status status;
    return (uint16_t)lroundf(codec_clamp(volts * (float)MILLIVOLTS, 0.0f, (float)UINT16_MAX, &status));
}

void space_drive_send_brake_status(const space_drive *self, can_outbox *out)
{
    const bool starting = !(self->steer.ready && self->brake.ready);
    const bool disturbed = axis_disturbed(&self->brake);

    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        const space_drive_channel *channel = &self->brake.channels[i];
        can_frame *frame = add(out, SPACE_DRIVE_STAT_BRK_1_FRAME_ID, i);
        if (frame == NULL) {
            return;
        }
        const struct space_drive_stat_brk_1_t message = {
            .strt_initial = starting,
            .ign_actv = 1,
            .ip_sgnl_vald = channel->request.state == SPACE_DRIVE_REQUEST_FRESH,
            .brk_crtlr_actv = self->brake_demand > 0.0f,
            .err_led_act = disturbed,
            .warn_ton_actv = self->emergency != 0,
            .emr_brk = self->emergency != 0,
            .main_batt_curr_volt_val = millivolts(self->main_battery),
            .bkp_batt_curr_vol_val = millivolts(self->backup_battery),
            .curr_ip_dvc_pos = channel->request.counts,
        };
        (void)space_drive_stat_brk_1_pack(frame->data, &message, sizeof frame->data);
    }
}

/* Errors of one axis: every channel's frame tells of its own sensor and receiver, and of the supplies it shares. */
static void send_errors(const space_drive *self, const space_drive_axis *axis, uint8_t emergency_bits,
                        uint32_t first_id, can_outbox *out)
{
    const space_drive_config *config = &self->config;

    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        const space_drive_channel *channel = &axis->channels[i];
        can_frame *frame = add(out, first_id, i);
        if (frame == NULL) {
            return;
        }
        const struct space_drive_act_err_steer_1_t message = {
            .err_srv_mtr_pos_sen_1 = i == 0U && channel->excluded,
            .err_srv_mtr_pos_sen_2 = i == 1U && channel->excluded,
            .err_srv_mtr_pos_sen_3 = i == 2U && channel->excluded,
            .psn_sen_srv_mtr_implausible = channel->implausible,
            .vol_main_batt_hi = self->main_battery > config->battery_maximum,
            .vol_main_batt_lo = !(self->main_battery >= config->battery_minimum),
            .vol_bkp_batt_hi = self->backup_battery > config->battery_maximum,
            .vol_bkp_batt_lo = !(self->backup_battery >= config->battery_minimum),
            .err_can_1 = channel->request.state == SPACE_DRIVE_REQUEST_LOST,
            .crtcl_err_recognzd = (self->emergency & emergency_bits) != 0,
        };
        (void)space_drive_act_err_steer_1_pack(frame->data, &message, sizeof frame->data);
    }
}

void space_drive_send_steer_errors(const space_drive *self, can_outbox *out)
{
    send_errors(self, &self->steer, SPACE_DRIVE_EMERGENCY_STEER_REQUESTS | SPACE_DRIVE_EMERGENCY_STEER_SENSORS,
                SPACE_DRIVE_ACT_ERR_STEER_1_FRAME_ID, out);
}

void space_drive_send_brake_errors(const space_drive *self, can_outbox *out)
{
    send_errors(self, &self->brake, SPACE_DRIVE_EMERGENCY_BRAKE_REQUESTS | SPACE_DRIVE_EMERGENCY_BRAKE_SENSORS,
                SPACE_DRIVE_ACT_ERR_BRAKE_1_FRAME_ID, out);
}
