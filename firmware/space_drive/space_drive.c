#include "space_drive/space_drive.h"

#include <string.h>

#include "generated/space_drive.h"
#include "space_drive/reports.h"

const space_drive_config space_drive_config_default = {
    .steer =
        {
            .position_at_zero = -SPACE_DRIVE_STEER_STOP_RAD,
            .position_at_max = SPACE_DRIVE_STEER_STOP_RAD,
            .sensor_minimum = -4.363323f, /* 250 deg: behind the stop no sensor can be */
            .sensor_maximum = 4.363323f,
            .deviation = 0.087266f,     /* 5 deg at the motor, a third of a degree at the wheel */
            .lead = 1.047198f,          /* 60 deg: more than the motor can make up within its delay */
            .safe_demand_valid = false, /* stay where the wheels are */
            .counts_max = SPACE_DRIVE_STOP,
            .bad_limit = 3,
            .timeout_us = 50000,
            .deviation_us = 50000,
        },
    .brake =
        {
            .position_at_zero = SPACE_DRIVE_BRAKE_STOP_PA,
            .position_at_max = 0.0f,
            .sensor_minimum = -2.0e5f, /* a little below zero: offset of a sound sensor */
            .sensor_maximum = 7.0e6f,
            .deviation = 3.0e5f,
            .lead = SPACE_DRIVE_BRAKE_STOP_PA, /* pressure builds up behind the demand; nothing to bound */
            .safe_demand = SPACE_DRIVE_FULL_BRAKE_PA,
            .safe_demand_valid = true,
            .counts_max = SPACE_DRIVE_NEUTRAL, /* above neutral would be gas, which this car does not use */
            .bad_limit = 3,
            .timeout_us = 50000,
            .deviation_us = 50000,
        },
    .battery_minimum = 10.0f,
    .battery_maximum = 16.0f,
};

/* What the tasks of one tick work on. */
typedef struct tick_context {
    space_drive *self;
    uint64_t now_us;
    const space_drive_wired_in *wired;
    const can_frame *in;
    uint32_t in_count;
    space_drive_wired_out *drive;
    can_outbox *out;
} tick_context;

/* An orderly shutdown counts only at standstill, when both bytes say so: the frame has no CRC. */
static void receive_shutdown(space_drive *self, const can_frame *frame)
{
    const codec_message *message = NULL;
    struct space_drive_shutdown_seq_t sequence;

    if (codec_accept(frame, &message) != CODEC_OK) {
        return;
    }
    (void)space_drive_shutdown_seq_unpack(&sequence, frame->data, sizeof frame->data);
    bool standing = true;
    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        standing = standing && self->steer.channels[i].request.speed_kmh == 0U;
    }
    if (sequence.shutdown == 1U && sequence.shutdown_2 == 1U && standing) {
        self->shutdown = true;
    }
}

static void receive(void *context)
{
    const tick_context *tick = context;
    space_drive *self = tick->self;

    for (uint32_t i = 0; i < tick->in_count; i++) {
        const can_frame *frame = &tick->in[i];
        if (frame->bus != CAN_BUS_3 || (frame->flags & (CAN_FLAG_EXTENDED | CAN_FLAG_ERROR)) != 0) {
            continue;
        }
        switch (frame->id) {
        case SPACE_DRIVE_REQ_STEER_POS_FRAME_ID:
            space_drive_axis_receive(&self->steer, &self->config.steer, frame, tick->now_us);
            break;
        case SPACE_DRIVE_REQ_BRAKE_POS_FRAME_ID:
            space_drive_axis_receive(&self->brake, &self->config.brake, frame, tick->now_us);
            break;
        case SPACE_DRIVE_SHUTDOWN_SEQ_FRAME_ID:
            receive_shutdown(self, frame);
            break;
        default:
            break;
        }
    }
}

static uint8_t find_emergency(const space_drive *self)
{
    uint8_t causes = 0;

    if (!self->shutdown && self->steer.requests_lost) {
        causes |= SPACE_DRIVE_EMERGENCY_STEER_REQUESTS;
    }
    if (!self->shutdown && self->brake.requests_lost) {
        causes |= SPACE_DRIVE_EMERGENCY_BRAKE_REQUESTS;
    }
    if (self->steer.failed) {
        causes |= SPACE_DRIVE_EMERGENCY_STEER_SENSORS;
    }
    if (self->brake.failed) {
        causes |= SPACE_DRIVE_EMERGENCY_BRAKE_SENSORS;
    }
    return causes;
}

/* Brake by itself. While only the brake is what failed, the steering goes on following its requests. */
static float own_brake(const space_drive *self)
{
    const uint8_t steered = SPACE_DRIVE_EMERGENCY_BRAKE_REQUESTS | SPACE_DRIVE_EMERGENCY_BRAKE_SENSORS;
    return self->emergency != 0 && (self->emergency & ~steered) == 0 ? SPACE_DRIVE_STEERED_BRAKE_PA
                                                                     : SPACE_DRIVE_FULL_BRAKE_PA;
}

static void control(void *context)
{
    const tick_context *tick = context;
    space_drive *self = tick->self;

    self->main_battery = tick->wired->main_battery;
    self->backup_battery = tick->wired->backup_battery;
    space_drive_axis_step(&self->steer, &self->config.steer, tick->wired->steer_motor_angle, tick->now_us);
    space_drive_axis_step(&self->brake, &self->config.brake, tick->wired->brake_pressure, tick->now_us);
    self->emergency |= find_emergency(self);

    const bool released =
        self->emergency == 0 && !self->shutdown && self->steer.ready && self->brake.ready && self->brake.demand_valid;
    self->brake_demand = released ? self->brake.demand : own_brake(self);
    tick->drive->brake_pressure_demand = self->brake_demand;
    tick->drive->steer_motor_demand = self->steer.demand;
}

static void send_positions(void *context)
{
    const tick_context *tick = context;
    space_drive_send_positions(tick->self, tick->out);
}

static void send_steer_status(void *context)
{
    const tick_context *tick = context;
    space_drive_send_steer_status(tick->self, tick->out);
}

static void send_brake_status(void *context)
{
    const tick_context *tick = context;
    space_drive_send_brake_status(tick->self, tick->out);
}

static void send_steer_errors(void *context)
{
    const tick_context *tick = context;
    space_drive_send_steer_errors(tick->self, tick->out);
}

static void send_brake_errors(void *context)
{
    const tick_context *tick = context;
    space_drive_send_brake_errors(tick->self, tick->out);
}

static const executive_task schedule[] = {
    {.run = receive, .period = 1, .offset = 0, .budget_us = 1000},
    {.run = control, .period = 1, .offset = 0, .budget_us = 1000},
    {.run = send_positions, .period = 1, .offset = 0, .budget_us = 500},
    {.run = send_steer_status, .period = 2, .offset = 0, .budget_us = 300},
    {.run = send_brake_status, .period = 2, .offset = 1, .budget_us = 300},
    {.run = send_steer_errors, .period = 10, .offset = 2, .budget_us = 300},
    {.run = send_brake_errors, .period = 10, .offset = 7, .budget_us = 300},
};

enum { SCHEDULE_TASKS = sizeof schedule / sizeof schedule[0] };

const executive_task *space_drive_schedule(uint32_t *count)
{
    *count = SCHEDULE_TASKS;
    return schedule;
}

void space_drive_init(space_drive *self, const space_drive_config *config)
{
    memset(self, 0, sizeof *self);
    self->config = config != NULL ? *config : space_drive_config_default;
    self->brake_demand = SPACE_DRIVE_FULL_BRAKE_PA;
}

void space_drive_stop(space_drive *self)
{
    if (!self->shutdown) {
        self->emergency |= SPACE_DRIVE_EMERGENCY_STOPPING;
    }
}

void space_drive_tick(space_drive *self, uint64_t now_us, const space_drive_wired_in *wired, const can_frame *in,
                      uint32_t in_count, space_drive_wired_out *drive, can_outbox *out)
{
    tick_context tick = {
        .self = self,
        .now_us = now_us,
        .wired = wired,
        .in = in,
        .in_count = in_count,
        .drive = drive,
        .out = out,
    };
    executive_run(&self->schedule, schedule, SCHEDULE_TASKS, &tick, now_us);
}
