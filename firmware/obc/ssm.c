#include "obc/ssm.h"

#include <string.h>

#include "obc/control.h"
#include "obc/parameters.h"

static bool running(uint8_t state)
{
    return state >= SSM_NOMINAL && state <= SSM_EMERGENCY;
}

static uint8_t scope_of(const ssm *self, const ssm_input *input)
{
    if (!running(self->state)) {
        return FAULT_SCOPE_ALWAYS;
    }
    return input->driving ? FAULT_SCOPE_DRIVING : FAULT_SCOPE_RUNNING;
}

/* The best controller that no fault disables, in the order LQR, Stanley, pure pursuit; CONTROL_NONE when none is left.
 * Where a fault says that the car does not know where it is, only the one that follows the wall counts, if it can. */
static uint8_t choose_controller(const fault_monitor *faults, bool wall_followed)
{
    if (fault_monitor_demands(faults, FAULT_REACTION_EMERGENCY_STOP)) {
        return wall_followed ? (uint8_t)CONTROL_EMERGENCY : (uint8_t)CONTROL_NONE;
    }
    for (uint32_t controller = CONTROL_LQR; controller <= CONTROL_PURE_PURSUIT; controller++) {
        if (fault_monitor_allows(faults, (uint8_t)controller)) {
            return (uint8_t)controller;
        }
    }
    return CONTROL_NONE;
}

/* Reaction of the worst active fault, raised where it cannot be had: degraded driving that the configuration does not
 * allow becomes a safe stop; the switch of a controller that has no successor a full brake, and so does the emergency
 * stop without a wall. */
static uint8_t reaction_in_force(uint8_t worst, uint8_t controller, bool degraded_allowed)
{
    const uint8_t reaction = fault_table[worst].reaction;
    if (controller == CONTROL_NONE) {
        return FAULT_REACTION_FULL_BRAKE;
    }
    if (!degraded_allowed && (reaction == FAULT_REACTION_DEGRADE || reaction == FAULT_REACTION_SWITCH_CONTROLLER)) {
        return FAULT_REACTION_SAFE_STOP;
    }
    return reaction;
}

static uint8_t running_state(uint8_t reaction)
{
    if (reaction >= FAULT_REACTION_SAFE_STOP) {
        return SSM_EMERGENCY;
    }
    return reaction >= FAULT_REACTION_DEGRADE ? SSM_DEGRADED : SSM_NOMINAL;
}

/* Next state for every reaction but the full brake. */
static uint8_t next_state(const ssm *self, const ssm_input *input, uint8_t reaction, bool reset)
{
    switch (self->state) {
    case SSM_BOOT:
        return SSM_CONFIG_CHECK;
    case SSM_CONFIG_CHECK:
        return input->verdict == PARAMETER_VERDICT_ACCEPTED ? SSM_LAUNCHING : SSM_CONFIG_CHECK;
    case SSM_LAUNCHING:
        return input->launch_wanted && fault_monitor_launch_clear(input->conditions) ? SSM_NOMINAL : SSM_LAUNCHING;
    case SSM_EMERGENCY:
        /* A reset leads back through the checks of a launch. */
        return reset && reaction < FAULT_REACTION_SAFE_STOP ? SSM_LAUNCHING : SSM_EMERGENCY;
    case SSM_NOMINAL:
    case SSM_DEGRADED:
        return running_state(reaction);
    default:
        return SSM_FULL_BRAKE;
    }
}

/* Each fault leaves its share of what a degraded car may do. */
static ssm_limits shared_limits(const ssm_limits *degraded, fault_share share)
{
    return (ssm_limits){
        .max_speed = degraded->max_speed * (float)share.speed / 100.0f,
        .max_acceleration = degraded->max_acceleration * (float)share.acceleration / 100.0f,
        .max_deceleration = degraded->max_deceleration,
    };
}

static ssm_limits limits_in_force(const ssm *self, const ssm_input *input)
{
    switch (self->state) {
    case SSM_NOMINAL:
        return input->nominal;
    case SSM_DEGRADED:
        return shared_limits(&input->degraded, fault_monitor_share(&self->faults));
    case SSM_EMERGENCY:
        return (ssm_limits){.max_deceleration = input->nominal.max_deceleration};
    default:
        return (ssm_limits){0};
    }
}

void ssm_step(ssm *self, const ssm_input *input, ssm_output *output)
{
    /* The operator resets by withdrawing the request and asking again; a drop-out of the request is no reset. */
    const bool reset = input->standing_still && input->launch_wanted && !self->launch_was_wanted;
    self->launch_was_wanted = input->launch_wanted;

    fault_monitor_step(&self->faults, input->conditions, scope_of(self, input), reset, input->now_us);
    const uint8_t worst = fault_monitor_worst(&self->faults);
    const uint8_t controller = choose_controller(&self->faults, input->wall_followed);
    const uint8_t reaction = reaction_in_force(worst, controller, input->degraded_allowed);
    self->state = reaction == FAULT_REACTION_FULL_BRAKE ? SSM_FULL_BRAKE : next_state(self, input, reaction, reset);

    memset(output, 0, sizeof *output);
    output->limits = limits_in_force(self, input);
    output->state = self->state;
    output->reaction = self->state == SSM_FULL_BRAKE ? (uint8_t)FAULT_REACTION_FULL_BRAKE : reaction;
    output->worst_fault = worst;
    output->active_faults = fault_monitor_active_count(&self->faults);
    output->controller = self->state >= SSM_NOMINAL ? controller : (uint8_t)CONTROL_NONE;
    output->drive_allowed = running(self->state);
    output->safe_stop = self->state == SSM_EMERGENCY;
}
