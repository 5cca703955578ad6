#include "obc/dbw_command.h"

#include <math.h>
#include <stddef.h>

#include "common/codec.h"
#include "generated/codec_table.h"
#include "generated/raptor.h"

#define CYCLE_S          0.01f
#define STANDARD_GRAVITY 9.80665f /* m/s2 */
#define RAD_TO_DEGREE    (180.0f / 3.14159265f)
#define PA_TO_KPA        0.001f
#define TO_PERCENT       100.0f

/* Ends of the fields on the wire. */
#define STEERING_MOTOR_MIN_DEG (-512.0f)
#define STEERING_MOTOR_MAX_DEG 511.5f
#define BRAKE_MAX_KPA          8191.0f
#define ACCELERATION_MAX_G     327.67f

enum {
    GEAR_MAX = 6,
    GEAR_REPEAT_CYCLES = 10,
};

/* Commands after the gate. */
typedef struct setpoint {
    float throttle;       /* 0..1 */
    float brake_pressure; /* Pa */
} setpoint;

static float clamp(float value, float minimum, float maximum)
{
    codec_status status = CODEC_OK;
    return codec_clamp(value, minimum, maximum, &status);
}

/* Bits for the commands that are to be followed and are not finite. */
static uint8_t find_violations(const dbw_demand *demand)
{
    uint8_t violations = 0U;
    if (demand->steer && !isfinite(demand->road_wheel_angle)) {
        violations |= DBW_VIOLATION_STEERING;
    }
    if (demand->mode == DBW_DRIVE && !isfinite(demand->throttle)) {
        violations |= DBW_VIOLATION_THROTTLE;
    }
    if (demand->mode == DBW_DRIVE && !isfinite(demand->brake_pressure)) {
        violations |= DBW_VIOLATION_BRAKE;
    }
    return violations;
}

/* The limit, or the other pressure when it is none: zero, negative or not finite. */
static float pressure_or(float limit, float other)
{
    return limit > 0.0f && isfinite(limit) ? limit : other;
}

static setpoint gate(const dbw_demand *demand, const dbw_limits *limits, uint8_t mode, bool steered)
{
    /* Limits that were never filled in must not make nothing of a brake. */
    const float full_brake_pressure = pressure_or(limits->full_brake_pressure, DBW_FULL_BRAKE_PA);
    const float steered_brake_pressure = pressure_or(limits->steered_brake_pressure, full_brake_pressure);
    switch (mode) {
    case DBW_DRIVE: {
        const float brake = clamp(demand->brake_pressure, 0.0f, full_brake_pressure);
        const float throttle = clamp(demand->throttle, 0.0f, limits->throttle_limit);
        return (setpoint){.throttle = brake > 0.0f ? 0.0f : throttle, .brake_pressure = brake};
    }
    case DBW_HOLD:
        return (setpoint){.throttle = 0.0f,
                          .brake_pressure = pressure_or(limits->holding_brake_pressure, full_brake_pressure)};
    default:
        return (setpoint){.throttle = 0.0f, .brake_pressure = steered ? steered_brake_pressure : full_brake_pressure};
    }
}

/* A computer that starts anew in a turn leaves the wheels where they are: straight ahead would be a jump. */
static void take_over_wheels(dbw_command *self, const dbw_demand *demand, const dbw_limits *limits)
{
    if (!self->wheels_taken_over && demand->wheels_known && isfinite(demand->wheels_found)) {
        self->road_wheel_angle = clamp(demand->wheels_found, -limits->steering_limit, limits->steering_limit);
        self->wheels_taken_over = true;
    }
}

/* Follow the wanted angle within limit and slew rate, or hold. */
static float steer(float last, const dbw_demand *demand, const dbw_limits *limits, bool follow)
{
    if (!follow) {
        return last;
    }
    const float step = limits->steering_slew * CYCLE_S;
    const float wanted = clamp(demand->road_wheel_angle, -limits->steering_limit, limits->steering_limit);
    return clamp(wanted, last - step, last + step);
}

static void send_brake(dbw_command *self, float pressure, can_outbox *out)
{
    can_frame *frame =
        can_outbox_add(out, CAN_BUS_1, RAPTOR_BRAKE_PRESSURE_CMD_FRAME_ID, 0U, RAPTOR_BRAKE_PRESSURE_CMD_LENGTH);
    if (frame == NULL) {
        return;
    }
    const float kpa = clamp(pressure * PA_TO_KPA, 0.0f, BRAKE_MAX_KPA);
    const struct raptor_brake_pressure_cmd_t command = {
        .brake_pressure_cmd = raptor_brake_pressure_cmd_brake_pressure_cmd_encode((double)kpa),
    };
    (void)raptor_brake_pressure_cmd_pack(frame->data, &command, CAN_DATA_MAX);
    codec_finish(frame, &codec_table[CODEC_RAPTOR_BRAKE_PRESSURE_CMD], &self->brake_counter);
}

static void send_throttle(dbw_command *self, float throttle, can_outbox *out)
{
    can_frame *frame =
        can_outbox_add(out, CAN_BUS_1, RAPTOR_ACCELERATOR_CMD_FRAME_ID, 0U, RAPTOR_ACCELERATOR_CMD_LENGTH);
    if (frame == NULL) {
        return;
    }
    const struct raptor_accelerator_cmd_t command = {
        .acc_pedal_cmd = raptor_accelerator_cmd_acc_pedal_cmd_encode((double)(throttle * TO_PERCENT)),
    };
    (void)raptor_accelerator_cmd_pack(frame->data, &command, CAN_DATA_MAX);
    codec_finish(frame, &codec_table[CODEC_RAPTOR_ACCELERATOR_CMD], &self->throttle_counter);
}

static void send_steering(dbw_command *self, float ratio, can_outbox *out)
{
    can_frame *frame = can_outbox_add(out, CAN_BUS_1, RAPTOR_STEERING_CMD_FRAME_ID, 0U, RAPTOR_STEERING_CMD_LENGTH);
    if (frame == NULL) {
        return;
    }
    const float motor_deg =
        clamp(self->road_wheel_angle * ratio * RAD_TO_DEGREE, STEERING_MOTOR_MIN_DEG, STEERING_MOTOR_MAX_DEG);
    const struct raptor_steering_cmd_t command = {
        .steering_motor_ang_cmd = raptor_steering_cmd_steering_motor_ang_cmd_encode((double)motor_deg),
    };
    (void)raptor_steering_cmd_pack(frame->data, &command, CAN_DATA_MAX);
    codec_finish(frame, &codec_table[CODEC_RAPTOR_STEERING_CMD], &self->steering_counter);
}

static void send_gear(dbw_command *self, uint8_t gear, can_outbox *out)
{
    self->gear_age++;
    if (self->gear_sent && gear == self->gear && self->gear_age < GEAR_REPEAT_CYCLES) {
        return;
    }
    can_frame *frame = can_outbox_add(out, CAN_BUS_1, RAPTOR_GEAR_SHIFT_CMD_FRAME_ID, 0U, RAPTOR_GEAR_SHIFT_CMD_LENGTH);
    if (frame == NULL) {
        return;
    }
    const struct raptor_gear_shift_cmd_t command = {.desired_gear = gear};
    (void)raptor_gear_shift_cmd_pack(frame->data, &command, CAN_DATA_MAX);
    self->gear = gear;
    self->gear_age = 0U;
    self->gear_sent = true;
}

static void send_flag_acknowledgement(const dbw_demand *demand, can_outbox *out)
{
    can_frame *frame = can_outbox_add(out, CAN_BUS_1, RAPTOR_CT_REPORT_2_FRAME_ID, 0U, RAPTOR_CT_REPORT_2_LENGTH);
    if (frame == NULL) {
        return;
    }
    const struct raptor_ct_report_2_t report = {
        .marelli_track_flag_ack = demand->marelli_track_flag,
        .marelli_vehicle_flag_ack = demand->marelli_vehicle_flag,
        .marelli_sector_flag_ack = demand->marelli_sector_flag,
    };
    (void)raptor_ct_report_2_pack(frame->data, &report, CAN_DATA_MAX);
}

static void send_switches(const dbw_limits *limits, can_outbox *out)
{
    can_frame *frame =
        can_outbox_add(out, CAN_BUS_1, RAPTOR_DASH_SWITCHES_CMD_FRAME_ID, 0U, RAPTOR_DASH_SWITCHES_CMD_LENGTH);
    if (frame == NULL) {
        return;
    }
    const struct raptor_dash_switches_cmd_t command = {
        .driver_traction_aim_switch = limits->traction_aim,
        .driver_traction_range_switch = limits->traction_range,
    };
    (void)raptor_dash_switches_cmd_pack(frame->data, &command, CAN_DATA_MAX);
}

static double to_g(float acceleration)
{
    return (double)clamp(acceleration / STANDARD_GRAVITY, -ACCELERATION_MAX_G, ACCELERATION_MAX_G);
}

static void send_acceleration(const dbw_demand *demand, can_outbox *out)
{
    can_frame *frame = can_outbox_add(out, CAN_BUS_1, RAPTOR_CT_VEHICLE_ACC_FEEDBACK_FRAME_ID, 0U,
                                      RAPTOR_CT_VEHICLE_ACC_FEEDBACK_LENGTH);
    if (frame == NULL) {
        return;
    }
    const float *a = demand->acceleration;
    const struct raptor_ct_vehicle_acc_feedback_t feedback = {
        .long_ct_vehicle_acc_fbk = raptor_ct_vehicle_acc_feedback_long_ct_vehicle_acc_fbk_encode(to_g(a[0])),
        .lat_ct_vehicle_acc_fbk = raptor_ct_vehicle_acc_feedback_lat_ct_vehicle_acc_fbk_encode(to_g(a[1])),
        .vertical_ct_vehicle_acc_fbk = raptor_ct_vehicle_acc_feedback_vertical_ct_vehicle_acc_fbk_encode(to_g(a[2])),
    };
    (void)raptor_ct_vehicle_acc_feedback_pack(frame->data, &feedback, CAN_DATA_MAX);
}

/* Control shifts while it drives; a car that brakes to a halt keeps its gear, a standing one is in neutral. */
static uint8_t choose_gear(const dbw_command *self, const dbw_demand *demand, uint8_t mode)
{
    if (mode == DBW_DRIVE) {
        return demand->gear < GEAR_MAX ? demand->gear : (uint8_t)GEAR_MAX;
    }
    return demand->standing_still ? 0U : self->gear;
}

uint8_t dbw_command_step(dbw_command *self, const dbw_demand *demand, const dbw_limits *limits, can_outbox *out)
{
    const uint8_t violations = find_violations(demand);
    const uint8_t mode = violations == 0U ? demand->mode : (uint8_t)DBW_FULL_BRAKE;
    const bool follow = demand->steer && (violations & DBW_VIOLATION_STEERING) == 0U;
    const setpoint command = gate(demand, limits, mode, follow && demand->wheels_follow);
    take_over_wheels(self, demand, limits);
    self->road_wheel_angle = steer(self->road_wheel_angle, demand, limits, follow);
    self->throttle = command.throttle;
    self->brake_pressure = command.brake_pressure;

    send_brake(self, command.brake_pressure, out);
    send_throttle(self, command.throttle, out);
    send_steering(self, limits->steering_ratio, out);
    send_gear(self, choose_gear(self, demand, mode), out);
    send_flag_acknowledgement(demand, out);
    send_switches(limits, out);
    send_acceleration(demand, out);
    return violations;
}

void dbw_command_ct_report(dbw_command *self, const dbw_ct_report *report, can_outbox *out)
{
    can_frame *frame = can_outbox_add(out, CAN_BUS_1, RAPTOR_CT_REPORT_FRAME_ID, 0U, RAPTOR_CT_REPORT_LENGTH);
    if (frame == NULL) {
        return;
    }
    const struct raptor_ct_report_t content = {
        .veh_sig_ack = report->vehicle_flag,
        .track_cond_ack = report->track_flag,
        .ct_state = report->ct_state,
        .veh_num = report->vehicle_number,
    };
    (void)raptor_ct_report_pack(frame->data, &content, CAN_DATA_MAX);
    codec_finish(frame, &codec_table[CODEC_RAPTOR_CT_REPORT], &self->ct_counter);
}
