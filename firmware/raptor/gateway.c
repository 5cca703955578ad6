#include "raptor/gateway.h"

#include <math.h>
#include <stddef.h>

#include "common/voter.h"
#include "generated/space_drive.h"
#include "space_drive/space_drive.h"

enum {
    ID_STRIDE = 2, /* steering and brake channels alternate */
    FRAME_BYTES = 8,
    SHUTDOWN_NOW = 1,
};

static const float kmh_per_mps = 3.6f;

static float steer_of(uint16_t counts)
{
    return ((float)counts - (float)SPACE_DRIVE_NEUTRAL) / (float)SPACE_DRIVE_NEUTRAL * SPACE_DRIVE_STEER_STOP_RAD;
}

static float brake_of(uint16_t counts)
{
    return (1.0f - (float)counts / (float)SPACE_DRIVE_NEUTRAL) * SPACE_DRIVE_BRAKE_STOP_PA;
}

/* The three channels' messages of one family have one layout, also across the axes: see space_drive/reports.c. */
static void take_position(raptor_gateway_channel *channel, const can_frame *frame, bool steer, uint64_t now_us)
{
    struct space_drive_calb_steer_pos_1_t message;

    if (codec_receive(&channel->position_rx, frame, now_us) != CODEC_OK) {
        return;
    }
    (void)space_drive_calb_steer_pos_1_unpack(&message, frame->data, sizeof frame->data);
    const uint16_t counts = message.cur_steer_pos_steering_pos_1;
    const uint16_t counts_max = steer ? SPACE_DRIVE_STOP : SPACE_DRIVE_NEUTRAL;
    channel->plausible = message.plausibity == SPACE_DRIVE_PLAUSIBLE && counts <= counts_max;
    if (channel->plausible) {
        channel->position = steer ? steer_of(counts) : brake_of(counts);
    }
}

static void take_status(raptor_gateway_channel *channel, const can_frame *frame, uint64_t now_us)
{
    struct space_drive_stat_steer_1_t message; /* emr_brk has the same place in the brake's status */

    if (codec_receive(&channel->status_rx, frame, now_us) != CODEC_OK) {
        return;
    }
    (void)space_drive_stat_steer_1_unpack(&message, frame->data, sizeof frame->data);
    channel->emergency_brake = message.emr_brk != 0U;
}

static void take_errors(raptor_gateway_channel *channel, const can_frame *frame, uint64_t now_us)
{
    struct space_drive_act_err_steer_1_t message;

    if (codec_receive(&channel->error_rx, frame, now_us) != CODEC_OK) {
        return;
    }
    (void)space_drive_act_err_steer_1_unpack(&message, frame->data, sizeof frame->data);
    channel->critical = message.crtcl_err_recognzd != 0U;
    channel->error = false;
    for (uint32_t i = 0; i < FRAME_BYTES; i++) {
        channel->error = channel->error || frame->data[i] != 0U;
    }
}

/* Channel that `id` belongs to within the family that starts at first_id, or null. */
static raptor_gateway_channel *find_channel(raptor_gateway *self, uint32_t id, uint32_t first_id, bool *steer)
{
    const uint32_t offset = id - first_id; /* wraps to a large number below first_id */

    if (offset >= ID_STRIDE * RAPTOR_GATEWAY_CHANNELS) {
        return NULL;
    }
    *steer = offset % ID_STRIDE == 0U;
    return *steer ? &self->steer.channels[offset / ID_STRIDE] : &self->brake.channels[offset / ID_STRIDE];
}

void raptor_gateway_receive(raptor_gateway *self, const can_frame *frame, uint64_t now_us)
{
    bool steer = false;
    raptor_gateway_channel *channel;

    if (frame->bus != CAN_BUS_3 || (frame->flags & (CAN_FLAG_EXTENDED | CAN_FLAG_ERROR)) != 0) {
        return;
    }
    if ((channel = find_channel(self, frame->id, SPACE_DRIVE_CALB_STEER_POS_1_FRAME_ID, &steer)) != NULL) {
        take_position(channel, frame, steer, now_us);
    } else if ((channel = find_channel(self, frame->id, SPACE_DRIVE_STAT_STEER_1_FRAME_ID, &steer)) != NULL) {
        take_status(channel, frame, now_us);
    } else if ((channel = find_channel(self, frame->id, SPACE_DRIVE_ACT_ERR_STEER_1_FRAME_ID, &steer)) != NULL) {
        take_errors(channel, frame, now_us);
    }
}

static void judge_axis(raptor_gateway_axis *axis, const raptor_config *config, uint64_t since_us, uint64_t now_us)
{
    float positions[VOTER_CHANNELS];
    bool usable[VOTER_CHANNELS] = {false};

    axis->valid_count = 0;
    for (uint32_t i = 0; i < RAPTOR_GATEWAY_CHANNELS; i++) {
        raptor_gateway_channel *channel = &axis->channels[i];
        const bool overdue = codec_timed_out(&channel->position_rx, config->position_timeout_ms, since_us, now_us);
        const bool status_overdue = codec_timed_out(&channel->status_rx, config->status_timeout_ms, since_us, now_us);
        const bool errors_overdue = codec_timed_out(&channel->error_rx, config->error_timeout_ms, since_us, now_us);
        channel->valid = channel->position_rx.seen && channel->plausible && !overdue;
        channel->faulty =
            overdue || (channel->position_rx.seen && !channel->plausible) || status_overdue || errors_overdue;
        if (status_overdue) {
            channel->emergency_brake = false;
        }
        axis->valid_count = (uint8_t)(axis->valid_count + (channel->valid ? 1U : 0U));
        usable[i] = channel->valid;
        positions[i] = channel->position;
    }
    /* The Space Drive has judged deviations itself, so no tolerance matters here. */
    const voter_ballot ballot = voter_vote(positions, usable, INFINITY);
    if (ballot.valid) {
        axis->position = ballot.value;
        axis->known = true;
    }
}

void raptor_gateway_step(raptor_gateway *self, const raptor_config *config, uint64_t now_us)
{
    uint32_t braking = 0;

    if (!self->started) {
        self->started = true;
        self->since_us = now_us;
    }
    judge_axis(&self->steer, config, self->since_us, now_us);
    judge_axis(&self->brake, config, self->since_us, now_us);
    for (uint32_t i = 0; i < RAPTOR_GATEWAY_CHANNELS; i++) {
        braking += self->steer.channels[i].emergency_brake ? 1U : 0U;
        braking += self->brake.channels[i].emergency_brake ? 1U : 0U;
    }
    self->emergency_brake = braking >= RAPTOR_GATEWAY_TRUSTED;
    self->lost = debounce_step(&self->lost_timer,
                               self->steer.valid_count < RAPTOR_GATEWAY_TRUSTED ||
                                   self->brake.valid_count < RAPTOR_GATEWAY_TRUSTED,
                               config->space_drive_lost_us, now_us);
}

bool raptor_gateway_ready(const raptor_gateway *self)
{
    return self->steer.valid_count == RAPTOR_GATEWAY_CHANNELS && self->brake.valid_count == RAPTOR_GATEWAY_CHANNELS;
}

static void finish(can_frame *frame, uint8_t *counter)
{
    codec_finish(frame, codec_find((uint8_t)CAN_BUS_3, frame->id, false), counter);
}

void raptor_gateway_send_requests(raptor_gateway *self, float steer_motor_angle, float brake_pressure, float speed,
                                  can_outbox *out)
{
    codec_status status;

    /* The brake first: should the outbox be full, it is not the one that is lost. */
    can_frame *frame = can_outbox_add(out, (uint8_t)CAN_BUS_3, SPACE_DRIVE_REQ_BRAKE_POS_FRAME_ID, 0, FRAME_BYTES);
    if (frame != NULL) {
        /* Clamping the released share gives 0, full brake, for NaN. */
        const float released = codec_clamp(1.0f - brake_pressure / SPACE_DRIVE_BRAKE_STOP_PA, 0.0f, 1.0f, &status);
        const struct space_drive_req_brake_pos_t message = {
            .contrl_pos_brk = (uint16_t)lroundf(released * (float)SPACE_DRIVE_NEUTRAL),
        };
        (void)space_drive_req_brake_pos_pack(frame->data, &message, sizeof frame->data);
        finish(frame, &self->brake_counter);
    }
    if (self->steer.known) {
        frame = can_outbox_add(out, (uint8_t)CAN_BUS_3, SPACE_DRIVE_REQ_STEER_POS_FRAME_ID, 0, FRAME_BYTES);
        if (frame != NULL) {
            float share = codec_clamp(steer_motor_angle / SPACE_DRIVE_STEER_STOP_RAD, -1.0f, 1.0f, &status);
            if (status == CODEC_NOT_FINITE) {
                share = 0.0f;
            }
            const float kmh = codec_clamp(speed * kmh_per_mps, 0.0f, (float)UINT16_MAX, &status);
            const struct space_drive_req_steer_pos_t message = {
                .cntrl_pos = (uint16_t)lroundf((1.0f + share) * (float)SPACE_DRIVE_NEUTRAL),
                .veh_speed = (uint16_t)lroundf(kmh), /* km/h: the public file gives no unit, this one is ours */
            };
            (void)space_drive_req_steer_pos_pack(frame->data, &message, sizeof frame->data);
            finish(frame, &self->steer_counter);
        }
    }
}

void raptor_gateway_send_shutdown(can_outbox *out)
{
    can_frame *frame = can_outbox_add(out, (uint8_t)CAN_BUS_3, SPACE_DRIVE_SHUTDOWN_SEQ_FRAME_ID, 0, FRAME_BYTES);
    if (frame != NULL) {
        const struct space_drive_shutdown_seq_t message = {.shutdown = SHUTDOWN_NOW, .shutdown_2 = SHUTDOWN_NOW};
        (void)space_drive_shutdown_seq_pack(frame->data, &message, sizeof frame->data);
    }
}
