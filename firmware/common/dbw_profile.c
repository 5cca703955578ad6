#include "common/dbw_profile.h"

#include <stddef.h>
#include <string.h>

#include "generated/codec_table.h"
#include "generated/raptor.h"
#include "generated/raptor_v26.h"

enum {
    PRESSURE_MAX_KPA = 8191,
    BALANCE_INDEPENDENT = 9, /* both pressures of brake_pressure_cmd as they are commanded */
};

static const float deg_per_rad = 57.2957795f;
static const float rate_max = 3276.7f; /* deg/s */

static const codec_profile *table(const dbw_profile *self)
{
    return &codec_profiles[self->index];
}

/* Rear pressure that goes with a front one, to the nearest kPa. */
static uint16_t rear_of(uint16_t front)
{
    const uint32_t scaled = (uint32_t)front * DBW_PROFILE_REAR_PERCENT;
    return (uint16_t)((scaled + DBW_PROFILE_FRONT_PERCENT / 2U) / DBW_PROFILE_FRONT_PERCENT);
}

/* Least front pressure whose rear one is at least this; the field's maximum, which is no plausible pressure, where it
 * would be more. */
static uint16_t front_for(uint16_t rear)
{
    const uint32_t scaled = (uint32_t)rear * DBW_PROFILE_FRONT_PERCENT;
    const uint32_t front = (scaled + DBW_PROFILE_REAR_PERCENT - 1U) / DBW_PROFILE_REAR_PERCENT;
    return (uint16_t)(front < PRESSURE_MAX_KPA ? front : PRESSURE_MAX_KPA);
}

static int16_t rate_raw(float rate)
{
    codec_status status;
    const float degrees = codec_clamp(rate * deg_per_rad, -rate_max, rate_max, &status);
    return raptor_v26_steering_report_primary_steering_angular_rate_encode((double)degrees);
}

/* Start a frame with the data of another: same address, other length, no data. */
static void begin(can_frame *frame, uint8_t dlc)
{
    frame->dlc = dlc;
    memset(frame->data, 0, sizeof frame->data);
}

/* --- receive: V26 into V14, in place; false: nothing to hand on --- */

static void join_brake(can_frame *frame)
{
    struct raptor_v26_brake_pressure_cmd_t axles;
    (void)raptor_v26_brake_pressure_cmd_unpack(&axles, frame->data, CAN_DATA_MAX);
    const uint16_t front = axles.f_brake_pressure_cmd;
    const uint16_t rear = axles.r_brake_pressure_cmd;
    const struct raptor_brake_pressure_cmd_t command = {
        .brake_pressure_cmd = rear > rear_of(front) ? front_for(rear) : front,
        .brk_pressure_cmd_counter = axles.brk_pressure_cmd_counter,
    };
    begin(frame, RAPTOR_BRAKE_PRESSURE_CMD_LENGTH);
    (void)raptor_brake_pressure_cmd_pack(frame->data, &command, CAN_DATA_MAX);
}

static void keep_counter(dbw_profile *self, const can_frame *frame)
{
    struct raptor_v26_steering_report_t report;
    (void)raptor_v26_steering_report_unpack(&report, frame->data, CAN_DATA_MAX);
    self->report_counter = report.steering_motor_fdbk_counter;
    self->counter_pending = true;
}

/* The angles' frame becomes the V14 report, which has the counter. */
static bool join_steering(dbw_profile *self, can_frame *frame)
{
    if (!self->counter_pending) {
        return false;
    }
    self->counter_pending = false;
    struct raptor_v26_steering_report_extd_t angles;
    (void)raptor_v26_steering_report_extd_unpack(&angles, frame->data, CAN_DATA_MAX);
    const struct raptor_steering_report_t report = {
        .steering_motor_ang_avg_fdbk = angles.average_steering_ang_fdbk,
        .steering_motor_fdbk_counter = self->report_counter,
    };
    frame->id = RAPTOR_STEERING_REPORT_FRAME_ID;
    begin(frame, RAPTOR_STEERING_REPORT_LENGTH);
    (void)raptor_steering_report_pack(frame->data, &report, CAN_DATA_MAX);
    return true;
}

static bool into_v14(dbw_profile *self, can_frame *frame)
{
    switch (frame->id) {
    case RAPTOR_V26_BRAKE_PRESSURE_CMD_FRAME_ID:
        join_brake(frame);
        return true;
    case RAPTOR_V26_STEERING_REPORT_FRAME_ID:
        keep_counter(self, frame);
        return false;
    case RAPTOR_V26_STEERING_REPORT_EXTD_FRAME_ID:
        return join_steering(self, frame);
    default: {
        /* What V26 has added lies in bits that V14 does not read. */
        const codec_message *message = codec_find(CAN_BUS_1, frame->id, false);
        if (message != NULL) {
            frame->dlc = message->dlc;
        }
        return message != NULL;
    }
    }
}

/* --- send: V14 into V26, in place; false: it stays away --- */

static void split_brake(can_frame *frame)
{
    struct raptor_brake_pressure_cmd_t command;
    (void)raptor_brake_pressure_cmd_unpack(&command, frame->data, CAN_DATA_MAX);
    const struct raptor_v26_brake_pressure_cmd_t axles = {
        .f_brake_pressure_cmd = command.brake_pressure_cmd,
        .r_brake_pressure_cmd = rear_of(command.brake_pressure_cmd),
        .brk_pressure_cmd_counter = command.brk_pressure_cmd_counter,
    };
    begin(frame, RAPTOR_V26_BRAKE_PRESSURE_CMD_LENGTH);
    (void)raptor_v26_brake_pressure_cmd_pack(frame->data, &axles, CAN_DATA_MAX);
}

static void split_steering(dbw_profile *self, can_frame *frame)
{
    struct raptor_steering_report_t report;
    (void)raptor_steering_report_unpack(&report, frame->data, CAN_DATA_MAX);
    const struct raptor_v26_steering_report_t rates = {
        .primary_steering_angular_rate = rate_raw(self->rates.primary),
        .steering_motor_fdbk_counter = report.steering_motor_fdbk_counter,
        .commanded_steering_rate = rate_raw(self->rates.commanded),
    };
    self->average_angle = report.steering_motor_ang_avg_fdbk;
    self->average_pending = true;
    begin(frame, RAPTOR_V26_STEERING_REPORT_LENGTH);
    (void)raptor_v26_steering_report_pack(frame->data, &rates, CAN_DATA_MAX);
}

/* Of the three sensors V26 has two; the third one's place is the average's. */
static bool add_average(dbw_profile *self, can_frame *frame)
{
    if (!self->average_pending) {
        return false;
    }
    self->average_pending = false;
    struct raptor_steering_report_extd_t sensors;
    (void)raptor_steering_report_extd_unpack(&sensors, frame->data, CAN_DATA_MAX);
    const struct raptor_v26_steering_report_extd_t angles = {
        .primary_steering_angle_fbk = sensors.steering_motor_ang_1_fdbk,
        .secondary_steering_ang_fdbk = sensors.steering_motor_ang_2_fdbk,
        .average_steering_ang_fdbk = self->average_angle,
    };
    begin(frame, RAPTOR_V26_STEERING_REPORT_EXTD_LENGTH);
    (void)raptor_v26_steering_report_extd_pack(frame->data, &angles, CAN_DATA_MAX);
    return true;
}

static void add_balance(can_frame *frame)
{
    struct raptor_v26_dash_switches_cmd_t switches;
    (void)raptor_v26_dash_switches_cmd_unpack(&switches, frame->data, CAN_DATA_MAX);
    switches.brake_bias_aim_switch = BALANCE_INDEPENDENT;
    (void)raptor_v26_dash_switches_cmd_pack(frame->data, &switches, CAN_DATA_MAX);
}

static bool out_of_v14(dbw_profile *self, can_frame *frame)
{
    switch (frame->id) {
    case RAPTOR_BRAKE_PRESSURE_CMD_FRAME_ID:
        split_brake(frame);
        return true;
    case RAPTOR_STEERING_REPORT_FRAME_ID:
        split_steering(self, frame);
        return true;
    case RAPTOR_STEERING_REPORT_EXTD_FRAME_ID:
        return add_average(self, frame);
    case RAPTOR_DASH_SWITCHES_CMD_FRAME_ID:
        add_balance(frame);
        return true;
    default: {
        /* A frame that has grown is 0 where V14 has nothing to say: an outbox hands out zeroed frames. */
        const codec_message *message = codec_find_in(table(self), CAN_BUS_1, frame->id, false);
        if (message != NULL) {
            frame->dlc = message->dlc;
        }
        return message != NULL;
    }
    }
}

bool dbw_profile_select(dbw_profile *self, uint8_t index)
{
    if (index >= CODEC_PROFILE_COUNT) {
        return false;
    }
    memset(self, 0, sizeof *self);
    self->index = index;
    return true;
}

dbw_profile_verdict dbw_profile_receive(dbw_profile *self, const can_frame *frame, can_frame *v14)
{
    *v14 = *frame;
    if (self->index == CODEC_PROFILE_V14 || frame->bus != CAN_BUS_1) {
        return DBW_PROFILE_FRAME;
    }
    const codec_message *message = NULL;
    const codec_status status = codec_accept_in(table(self), frame, &message);
    if (status != CODEC_OK) {
        self->refused[-status]++;
        return DBW_PROFILE_REFUSED;
    }
    return into_v14(self, v14) ? DBW_PROFILE_FRAME : DBW_PROFILE_NOTHING;
}

void dbw_profile_send(dbw_profile *self, can_outbox *out, uint32_t first)
{
    if (self->index == CODEC_PROFILE_V14) {
        return;
    }
    uint32_t kept = first;
    for (uint32_t i = first; i < out->count; i++) {
        can_frame frame = out->frames[i];
        if (frame.bus != CAN_BUS_1 || out_of_v14(self, &frame)) {
            out->frames[kept++] = frame;
        }
    }
    out->count = kept;
}
