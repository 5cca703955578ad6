/* Fault monitor and SSM, on the generated fault table: one step from any state that a step can leave behind. That the
 * step leaves such a state again, and that a zeroed one is such a state, makes the proofs hold for runs of any length.
 */
#include <string.h>

#include "obc/control.h"
#include "obc/parameters.h"
#include "obc/ssm.h"
#include "proofs/proof.h"

static bool sound_fault(const fault_state *state, const fault_row *row)
{
    return state->present_cycles <= row->debounce_cycles && state->absent_cycles <= row->clear_cycles;
}

static bool sound_events(const fault_monitor *self)
{
    return self->event_first < FAULT_EVENTS_MAX && self->event_count <= FAULT_EVENTS_MAX;
}

static fault_monitor any_monitor(void)
{
    fault_monitor self;
    ASSUME(sound_events(&self));
    for (uint32_t id = 0U; id < FAULT_COUNT; id++) {
        self.faults[id].active = nondet_bool();
        ASSUME(sound_fault(&self.faults[id], &fault_table[id]));
    }
    return self;
}

static uint32_t any_fault(void)
{
    const uint32_t id = nondet_uint32();
    ASSUME(id > FAULT_NONE && id < FAULT_COUNT);
    return id;
}

/* Debounce, latch and clear of every fault. */
void proof_fault_step(void)
{
    static const fault_monitor zeroed;
    fault_monitor self = any_monitor();
    const fault_monitor before = self;
    fault_conditions conditions;
    const uint8_t scope = nondet_uint8();
    const bool reset = nondet_bool();
    fault_monitor_step(&self, &conditions, scope, reset, nondet_uint64());

    PROVE(sound_events(&zeroed) && sound_events(&self), "the events stay inside their ring");
    for (uint32_t id = FAULT_NONE + 1U; id < FAULT_COUNT; id++) {
        const fault_row *row = &fault_table[id];
        const fault_state *was = &before.faults[id];
        const fault_state *is = &self.faults[id];
        const bool present = conditions.present[id] && row->scope <= scope;
        const bool cleared = was->active && !is->active;
        PROVE(sound_fault(&zeroed.faults[id], row) && sound_fault(is, row), "the cycles stay below their limits");
        PROVE(!is->active || was->active || (present && is->present_cycles == row->debounce_cycles),
              "active only when debounced");
        PROVE(!present || was->present_cycles + 1U < row->debounce_cycles || is->active, "and then at once");
        PROVE(!cleared || row->latch != FAULT_LATCH_UNTIL_RESTART, "a latch until restart holds");
        PROVE(!cleared || row->latch != FAULT_LATCH_UNTIL_RESET || reset, "one until reset, too");
        PROVE(!cleared || (!present && is->absent_cycles == row->clear_cycles),
              "nothing clears while its condition is there");
    }
}

/* Arbitration. */
void proof_worst(void)
{
    const fault_monitor self = any_monitor();
    const uint8_t worst = fault_monitor_worst(&self);
    const uint32_t id = any_fault();
    PROVE(worst < FAULT_COUNT, "a row of the table");
    PROVE(worst == FAULT_NONE || self.faults[worst].active, "that is active");
    PROVE(!self.faults[id].active || fault_table[worst].reaction >= fault_table[id].reaction, "the most severe wins");
    PROVE(fault_monitor_active_count(&self) < FAULT_COUNT, "never more than there are");
    PROVE(!self.faults[id].active || fault_monitor_demands(&self, fault_table[id].reaction), "what is active demands");
    const uint8_t reaction = nondet_uint8();
    PROVE(!fault_monitor_demands(&self, reaction) || fault_table[worst].reaction >= reaction, "and nothing else does");
}

/* Limits while degraded. */
void proof_share(void)
{
    const fault_monitor self = any_monitor();
    const fault_share least = fault_monitor_share(&self);
    const uint32_t id = any_fault();
    const fault_row *row = &fault_table[id];
    PROVE(!self.faults[id].active || least.speed <= row->share.speed, "no more speed than each active fault leaves");
    PROVE(!self.faults[id].active || least.acceleration <= row->share.acceleration, "no more acceleration");
    PROVE(least.speed <= 100U && least.acceleration <= 100U, "never more than the degraded limits");
    const bool degrades = row->reaction == FAULT_REACTION_DEGRADE || row->reaction == FAULT_REACTION_SWITCH_CONTROLLER;
    PROVE(!degrades || (row->share.speed > 0U && row->share.acceleration > 0U), "a fault that degrades leaves some");
    PROVE(row->reaction < FAULT_REACTION_SAFE_STOP || (row->share.speed == 0U && row->share.acceleration == 0U),
          "one that stops the car nothing");
}

/* Before the launch no fault is active that stops the car on a path: none is looked for, and a reset has let go. */
static bool sound_launch(const ssm *self)
{
    for (uint32_t id = FAULT_NONE + 1U; id < FAULT_COUNT; id++) {
        if (self->state <= SSM_LAUNCHING && self->faults.faults[id].active &&
            (fault_table[id].reaction == FAULT_REACTION_SAFE_STOP ||
             fault_table[id].reaction == FAULT_REACTION_EMERGENCY_STOP)) {
            return false;
        }
    }
    return true;
}

/* The state machine. */
void proof_ssm(void)
{
    ssm self;
    self.faults = any_monitor();
    self.state = nondet_uint8();
    self.launch_was_wanted = nondet_bool();
    ASSUME(sound_launch(&self));
    fault_conditions conditions;
    ssm_input input;
    ssm_output output;
    input.conditions = &conditions;
    const uint8_t before = self.state;
    ssm_step(&self, &input, &output);

    const uint8_t state = self.state;
    const uint32_t id = any_fault();
    const bool active = self.faults.faults[id].active;
    PROVE(sound_launch(&self), "no safe or emergency stop is active before the launch");
    PROVE(output.state == state && state <= SSM_FULL_BRAKE, "a state of the enum");
    PROVE(before != SSM_FULL_BRAKE || state == SSM_FULL_BRAKE, "FULL_BRAKE is absorbing");
    PROVE(before <= SSM_FULL_BRAKE || state == SSM_FULL_BRAKE, "what is no state becomes FULL_BRAKE");
    PROVE(!active || output.reaction >= fault_table[id].reaction, "the most severe active reaction is in force");
    PROVE(!active || fault_table[id].reaction != FAULT_REACTION_FULL_BRAKE || state == SSM_FULL_BRAKE,
          "a full brake at once");
    PROVE(!active || fault_table[id].reaction < FAULT_REACTION_SAFE_STOP || state < SSM_NOMINAL ||
              state >= SSM_EMERGENCY,
          "no driving with a safe stop active");
    const bool lost = active && fault_table[id].reaction == FAULT_REACTION_EMERGENCY_STOP;
    PROVE(!lost || state < SSM_NOMINAL || state == SSM_FULL_BRAKE || output.controller == CONTROL_EMERGENCY,
          "a car that is lost moves under the emergency controller only");
    PROVE(output.controller != CONTROL_EMERGENCY || input.wall_followed, "which has a wall");
    PROVE(!active || fault_table[id].disables == CONTROL_NONE || output.controller != fault_table[id].disables,
          "no controller that a fault disables");
    const bool drives = state == SSM_NOMINAL || state == SSM_DEGRADED || state == SSM_EMERGENCY;
    PROVE(output.drive_allowed == drives, "driving in three states only");
    PROVE(drives || (output.limits.max_speed == 0.0f && output.limits.max_acceleration == 0.0f),
          "else no limit is above zero");
    PROVE(state != SSM_EMERGENCY || (output.safe_stop && output.limits.max_speed == 0.0f), "EMERGENCY stops the car");
    PROVE(!drives || before >= SSM_LAUNCHING, "no way around the launch");
    PROVE(state != SSM_NOMINAL || before != SSM_LAUNCHING || input.launch_wanted, "no launch that nobody wants");
    PROVE(state != SSM_LAUNCHING || before != SSM_CONFIG_CHECK || input.verdict == PARAMETER_VERDICT_ACCEPTED,
          "no launch without an accepted configuration");
    PROVE(before != SSM_EMERGENCY || state != SSM_LAUNCHING || input.standing_still,
          "no way out of EMERGENCY at speed");
    PROVE(before != SSM_EMERGENCY || state == SSM_EMERGENCY || state == SSM_LAUNCHING || state == SSM_FULL_BRAKE,
          "nor straight back to driving");
}
