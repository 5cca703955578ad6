#include "raptor/demand.h"

#include <math.h>
#include <string.h>

#include "raptor/states.h"
#include "space_drive/space_drive.h"

enum { SHIFT_READY = 1 };

void raptor_demand_init(raptor_demand *self)
{
    memset(self, 0, sizeof *self);
    self->brake = SPACE_DRIVE_FULL_BRAKE_PA;
}

/* Somebody sane steers, whatever is wrong with the other commands. */
static bool steered(const raptor_config *config, const raptor_command_monitor *commands)
{
    return commands->steering_known && (commands->faults & RAPTOR_COMMAND_STEERING_TIMEOUT) == 0U &&
           commands->steering_implausible < config->implausible_limit;
}

static float full_brake(const raptor_config *config, const raptor_command_monitor *commands)
{
    return steered(config, commands) ? SPACE_DRIVE_STEERED_BRAKE_PA : SPACE_DRIVE_FULL_BRAKE_PA;
}

/* The Raptor's own wish, whatever the onboard computer commands. */
static float own_brake(const raptor_config *config, const raptor_demand_input *input)
{
    if (!input->commands->brake_known || input->commands->faults != 0U) {
        return full_brake(config, input->commands);
    }
    switch (input->sys_state) {
    case RAPTOR_SYS_PWR_ON:
    case RAPTOR_SYS_SUBSYS_CON:
    case RAPTOR_SYS_ACT_TEST_PASSED:
    case RAPTOR_SYS_CRANKREADY:
    case RAPTOR_SYS_CRANK_CHECK_INIT:
    case RAPTOR_SYS_CRANK_CHECKS_PASSED:
    case RAPTOR_SYS_CRANKING:
    case RAPTOR_SYS_ENG_IDLE:
    case RAPTOR_SYS_SHUT_ENG:
        return config->brake_hold;
    case RAPTOR_SYS_ACT_TESTING:
        return input->test_brake;
    case RAPTOR_SYS_DRIVING:
        return 0.0f;
    case RAPTOR_SYS_PWR_OFF:
        return SPACE_DRIVE_FULL_BRAKE_PA; /* parked */
    default:
        return full_brake(config, input->commands);
    }
}

/* Steering that is to be used now, or the one held. */
static float choose_steer(const raptor_demand *self, const raptor_config *config, const raptor_demand_input *input)
{
    const raptor_command_monitor *commands = input->commands;

    switch (input->sys_state) {
    case RAPTOR_SYS_PWR_ON:
    case RAPTOR_SYS_SUBSYS_CON:
        /* Hold the wheels where they are found. */
        return self->steer_held || !input->steer_position_known ? self->steer : input->steer_position;
    case RAPTOR_SYS_ACT_TESTING:
        return input->test_steer;
    case RAPTOR_SYS_DRIVING:
        return commands->steering_known ? commands->command.steer_motor_angle : self->steer;
    case RAPTOR_SYS_SHUT_ENG:
    case RAPTOR_SYS_PWR_OFF:
    case RAPTOR_SYS_EMERGENCY_SHUTDOWN:
        /* A car that brakes in a turn still has to follow it, as long as somebody sane steers. At rest nothing
         * moves any more. */
        return steered(config, commands) && !(input->speed < config->standstill_speed)
                   ? commands->command.steer_motor_angle
                   : self->steer;
    default:
        return self->steer;
    }
}

static void choose_gear(raptor_demand *self, const raptor_config *config, const raptor_demand_input *input,
                        uint64_t now_us)
{
    const raptor_command_monitor *commands = input->commands;
    uint8_t target = self->gear;

    if (input->sys_state == RAPTOR_SYS_ENG_IDLE || input->sys_state == RAPTOR_SYS_DRIVING) {
        const bool fresh = commands->gear_rx.seen &&
                           !codec_timed_out(&commands->gear_rx, config->gear_timeout_ms, commands->since_us, now_us);
        target = fresh ? commands->command.gear : self->gear;
    } else if (input->speed < config->standstill_speed) {
        target = 0; /* neutral once the car stands; rolling, the gear stays in */
    }
    const bool ready = input->gear == self->gear && input->gear_shift_status == SHIFT_READY &&
                       (!self->shifted || now_us - self->last_shift_us >= config->shift_interval_us);
    if (target != self->gear && ready) {
        self->gear = (uint8_t)(target > self->gear ? self->gear + 1U : self->gear - 1U);
        self->last_shift_us = now_us;
        self->shifted = true;
    }
}

void raptor_demand_step(raptor_demand *self, const raptor_config *config, const raptor_demand_input *input,
                        uint64_t now_us)
{
    const uint8_t state = input->sys_state;
    const raptor_command_monitor *commands = input->commands;

    self->brake = fmaxf(own_brake(config, input), commands->command.brake_pressure);
    self->steer = choose_steer(self, config, input);
    self->steer_held = self->steer_held || input->steer_position_known;
    /* The brake wins at once: a lost frame can leave an old throttle beside a new brake. */
    const bool braked = self->brake > config->pedal_conflict_brake;
    self->throttle = state == RAPTOR_SYS_DRIVING && commands->faults == 0U && commands->throttle_known && !braked
                         ? commands->command.throttle
                         : 0.0f;
    self->ignition = state == RAPTOR_SYS_CRANKING || state == RAPTOR_SYS_ENG_IDLE || state == RAPTOR_SYS_DRIVING;
    self->starter = state == RAPTOR_SYS_CRANKING && !input->engine_running;
    choose_gear(self, config, input, now_us);
}
