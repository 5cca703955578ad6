#include "raptor/command_monitor.h"

#include <math.h>
#include <string.h>

#include "generated/raptor.h"
#include "raptor/states.h"
#include "space_drive/space_drive.h"

enum {
    GEAR_MAX = 6,
    ALL_CT_STATES = 0xFFFF,
};

static const float pa_per_kpa = 1000.0f;
static const float rad_per_deg = 0.017453293f;

/* Bit of a ct_state in the rows below; 255, the state before anything, shares bit 0 with 0. */
#define CT(state) (1U << (state))

/* Which ct_states the onboard computer can be in while the Raptor is in a sys_state. Both follow each other with a
 * delay, so each row holds the states on either side of a step. CNTRL_SHUTDOWN and EMRG_SHUTDOWN are always right. */
static const uint16_t ct_states_of[RAPTOR_SYS_COUNT] = {
    [RAPTOR_SYS_NONE] = ALL_CT_STATES,
    [RAPTOR_SYS_PWR_ON] = CT(RAPTOR_CT_NONE) | CT(RAPTOR_CT_PWR_ON) | CT(RAPTOR_CT_INITIALIZED),
    [RAPTOR_SYS_SUBSYS_CON] = CT(RAPTOR_CT_NONE) | CT(RAPTOR_CT_PWR_ON) | CT(RAPTOR_CT_INITIALIZED),
    [RAPTOR_SYS_ACT_TESTING] = CT(RAPTOR_CT_NONE) | CT(RAPTOR_CT_PWR_ON) | CT(RAPTOR_CT_INITIALIZED),
    [RAPTOR_SYS_ACT_TEST_PASSED] =
        CT(RAPTOR_CT_NONE) | CT(RAPTOR_CT_PWR_ON) | CT(RAPTOR_CT_INITIALIZED) | CT(RAPTOR_CT_ACT_TEST),
    [RAPTOR_SYS_CRANKREADY] = CT(RAPTOR_CT_ACT_TEST) | CT(RAPTOR_CT_CRANKREADY),
    [RAPTOR_SYS_CRANK_CHECK_INIT] = CT(RAPTOR_CT_CRANKREADY),
    [RAPTOR_SYS_CRANK_CHECKS_PASSED] = CT(RAPTOR_CT_CRANKREADY) | CT(RAPTOR_CT_CRANKING),
    [RAPTOR_SYS_CRANKING] = CT(RAPTOR_CT_CRANKING),
    [RAPTOR_SYS_ENG_IDLE] = CT(RAPTOR_CT_CRANKING) | CT(RAPTOR_CT_RACEREADY) | CT(RAPTOR_CT_INIT_DRIVING),
    [RAPTOR_SYS_DRIVING] =
        CT(RAPTOR_CT_INIT_DRIVING) | CT(RAPTOR_CT_CAUTION) | CT(RAPTOR_CT_NOM_RACE) | CT(RAPTOR_CT_COORD_STOP),
    [RAPTOR_SYS_SHUT_ENG] = 0U,
    [RAPTOR_SYS_PWR_OFF] = ALL_CT_STATES,
    [RAPTOR_SYS_ACT_TEST_FAIL] = ALL_CT_STATES,
    [RAPTOR_SYS_CRANK_CHECKS_FAIL] = ALL_CT_STATES,
    [RAPTOR_SYS_EMERGENCY_SHUTDOWN] = ALL_CT_STATES,
    [RAPTOR_SYS_ENG_FAILED_TO_START] = ALL_CT_STATES,
};

bool raptor_ct_state_consistent(uint8_t sys_state, uint16_t ct_state)
{
    const uint16_t bit = ct_state == RAPTOR_CT_DEFAULT ? (uint16_t)RAPTOR_CT_NONE : ct_state;

    if (sys_state >= RAPTOR_SYS_COUNT || bit > RAPTOR_CT_EMRG_SHUTDOWN) {
        return false;
    }
    if (bit == RAPTOR_CT_CNTRL_SHUTDOWN || bit == RAPTOR_CT_EMRG_SHUTDOWN) {
        return true;
    }
    return (ct_states_of[sys_state] & CT(bit)) != 0U;
}

void raptor_command_monitor_init(raptor_command_monitor *self)
{
    memset(self, 0, sizeof *self);
    self->command.traction_aim = -1;
    self->command.traction_range = -1;
}

/* Count implausible frames in a row; returns `plausible`. */
static bool judge(bool plausible, uint16_t *in_a_row)
{
    if (plausible) {
        *in_a_row = 0;
    } else if (*in_a_row < UINT16_MAX) {
        (*in_a_row)++;
    }
    return plausible;
}

static void take_brake(raptor_command_monitor *self, const can_frame *frame)
{
    struct raptor_brake_pressure_cmd_t message;
    (void)raptor_brake_pressure_cmd_unpack(&message, frame->data, sizeof frame->data);
    const float pressure = (float)message.brake_pressure_cmd * pa_per_kpa;
    if (judge(pressure <= SPACE_DRIVE_BRAKE_STOP_PA, &self->brake_implausible)) {
        self->command.brake_pressure = pressure;
        self->brake_known = true;
    }
}

static void take_throttle(raptor_command_monitor *self, const can_frame *frame)
{
    struct raptor_accelerator_cmd_t message;
    (void)raptor_accelerator_cmd_unpack(&message, frame->data, sizeof frame->data);
    const float throttle = (float)message.acc_pedal_cmd * 1.0e-4f; /* 0.01 % */
    if (judge(throttle >= 0.0f && throttle <= 1.0f, &self->throttle_implausible)) {
        self->command.throttle = throttle;
        self->throttle_known = true;
    }
}

/* Before driving the steering command moves nothing. */
static bool steering_moves_wheels(uint8_t sys_state)
{
    return sys_state == RAPTOR_SYS_DRIVING || sys_state == RAPTOR_SYS_SHUT_ENG || sys_state == RAPTOR_SYS_PWR_OFF ||
           sys_state == RAPTOR_SYS_EMERGENCY_SHUTDOWN;
}

static void take_steering(raptor_command_monitor *self, const raptor_config *config, const can_frame *frame,
                          uint8_t sys_state)
{
    struct raptor_steering_cmd_t message;
    (void)raptor_steering_cmd_unpack(&message, frame->data, sizeof frame->data);
    const float angle = (float)message.steering_motor_ang_cmd * 0.5f * rad_per_deg;
    const bool steps = steering_moves_wheels(sys_state) && self->steering_known &&
                       fabsf(angle - self->command.steer_motor_angle) > config->steer_jump;
    /* The stop itself is 240 deg; a hair more is rounding. */
    const bool in_range = fabsf(angle) <= SPACE_DRIVE_STEER_STOP_RAD * 1.0001f;
    if (judge(in_range && !steps, &self->steering_implausible)) {
        self->command.steer_motor_angle = angle;
        self->steering_known = true;
    }
}

static void take_gear(raptor_command_monitor *self, const can_frame *frame)
{
    struct raptor_gear_shift_cmd_t message;
    (void)raptor_gear_shift_cmd_unpack(&message, frame->data, sizeof frame->data);
    if (judge(message.desired_gear <= GEAR_MAX, &self->gear_implausible)) {
        self->command.gear = message.desired_gear;
    }
}

static void take_ct_report(raptor_command_monitor *self, const can_frame *frame)
{
    struct raptor_ct_report_t message;
    (void)raptor_ct_report_unpack(&message, frame->data, sizeof frame->data);
    self->command.ct_state = message.ct_state;
}

static void take_switches(raptor_command_monitor *self, const can_frame *frame)
{
    struct raptor_dash_switches_cmd_t message;
    (void)raptor_dash_switches_cmd_unpack(&message, frame->data, sizeof frame->data);
    self->command.traction_aim = (int8_t)message.driver_traction_aim_switch;
    self->command.traction_range = (int8_t)message.driver_traction_range_switch;
}

void raptor_command_monitor_receive(raptor_command_monitor *self, const raptor_config *config, const can_frame *frame,
                                    uint8_t sys_state, uint64_t now_us)
{
    if (frame->bus != CAN_BUS_1 || (frame->flags & (CAN_FLAG_EXTENDED | CAN_FLAG_ERROR)) != 0) {
        return;
    }
    switch (frame->id) {
    case RAPTOR_BRAKE_PRESSURE_CMD_FRAME_ID:
        if (codec_receive(&self->brake_rx, frame, now_us) == CODEC_OK) {
            take_brake(self, frame);
        }
        break;
    case RAPTOR_ACCELERATOR_CMD_FRAME_ID:
        if (codec_receive(&self->throttle_rx, frame, now_us) == CODEC_OK) {
            take_throttle(self, frame);
        }
        break;
    case RAPTOR_STEERING_CMD_FRAME_ID:
        if (codec_receive(&self->steering_rx, frame, now_us) == CODEC_OK) {
            take_steering(self, config, frame, sys_state);
        }
        break;
    case RAPTOR_GEAR_SHIFT_CMD_FRAME_ID:
        if (codec_receive(&self->gear_rx, frame, now_us) == CODEC_OK) {
            take_gear(self, frame);
        }
        break;
    case RAPTOR_CT_REPORT_FRAME_ID:
        if (codec_receive(&self->ct_report_rx, frame, now_us) == CODEC_OK) {
            take_ct_report(self, frame);
        }
        break;
    case RAPTOR_DASH_SWITCHES_CMD_FRAME_ID:
        if (codec_receive(&self->switches_rx, frame, now_us) == CODEC_OK) {
            take_switches(self, frame);
        }
        break;
    default:
        break;
    }
}

/* The time-out's fault bit, with the reason added when frames still come but their counter stands. */
static uint16_t overdue(const raptor_command_monitor *self, const codec_rx *rx, uint16_t timeout_ms, uint16_t fault,
                        uint64_t now_us)
{
    if (!codec_timed_out(rx, timeout_ms, self->since_us, now_us)) {
        return 0;
    }
    return (uint16_t)(fault | (rx->last_status == CODEC_COUNTER_STUCK ? RAPTOR_COMMAND_COUNTER_STUCK : 0));
}

void raptor_command_monitor_step(raptor_command_monitor *self, const raptor_config *config, uint8_t sys_state,
                                 uint64_t now_us)
{
    const raptor_command *command = &self->command;
    const uint16_t limit = config->implausible_limit;
    unsigned faults = 0;

    if (!self->started) {
        self->started = true;
        self->since_us = now_us;
    }
    faults |= overdue(self, &self->brake_rx, config->command_timeout_ms, RAPTOR_COMMAND_BRAKE_TIMEOUT, now_us);
    faults |= overdue(self, &self->throttle_rx, config->command_timeout_ms, RAPTOR_COMMAND_THROTTLE_TIMEOUT, now_us);
    faults |= overdue(self, &self->steering_rx, config->command_timeout_ms, RAPTOR_COMMAND_STEERING_TIMEOUT, now_us);
    faults |=
        overdue(self, &self->ct_report_rx, config->ct_report_timeout_ms, RAPTOR_COMMAND_CT_REPORT_TIMEOUT, now_us);
    if (self->brake_implausible >= limit || self->throttle_implausible >= limit ||
        self->steering_implausible >= limit || self->gear_implausible >= limit) {
        faults |= RAPTOR_COMMAND_IMPLAUSIBLE;
    }
    if (debounce_step(&self->pedal_conflict,
                      command->throttle > config->pedal_conflict_throttle &&
                          command->brake_pressure > config->pedal_conflict_brake,
                      config->pedal_conflict_us, now_us)) {
        faults |= RAPTOR_COMMAND_PEDAL_CONFLICT;
    }
    if (debounce_step(&self->ct_inconsistent,
                      self->ct_report_rx.seen && !raptor_ct_state_consistent(sys_state, command->ct_state),
                      config->ct_inconsistent_us, now_us)) {
        faults |= RAPTOR_COMMAND_CT_STATE;
    }
    self->faults = (uint16_t)faults;
}

bool raptor_command_monitor_alive(const raptor_command_monitor *self)
{
    return self->faults == 0U && self->brake_known && self->throttle_known && self->steering_known &&
           self->ct_report_rx.seen;
}
