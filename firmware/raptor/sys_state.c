#include "raptor/sys_state.h"

#include <string.h>

enum {
    SWITCH_ACTUATION_TEST = 3, /* safety switch: actuators may move */
    SWITCH_ENGINE = 4,         /* safety switch: the engine may run */
};

void raptor_sys_init(raptor_sys_machine *self)
{
    memset(self, 0, sizeof *self);
    self->state = RAPTOR_SYS_PWR_ON;
}

/* States in which a trigger or a lost onboard computer is an emergency. */
static bool supervised(uint8_t state)
{
    return state != RAPTOR_SYS_NONE && state != RAPTOR_SYS_PWR_ON && state != RAPTOR_SYS_SUBSYS_CON;
}

/* States in which the engine may turn or is about to: the safety switch must stay at the engine position. */
static bool engine_enabled(uint8_t state)
{
    return state == RAPTOR_SYS_CRANKREADY || state == RAPTOR_SYS_CRANK_CHECK_INIT ||
           state == RAPTOR_SYS_CRANK_CHECKS_PASSED || state == RAPTOR_SYS_CRANKING || state == RAPTOR_SYS_ENG_IDLE ||
           state == RAPTOR_SYS_DRIVING;
}

static bool flag_is(const raptor_sys_input *input, uint8_t flag)
{
    return input->track_flag_valid && input->track_flag == flag;
}

static uint8_t after_act_testing(const raptor_sys_input *input)
{
    if (input->safety_switch < SWITCH_ACTUATION_TEST) {
        return RAPTOR_SYS_SUBSYS_CON; /* interrupted: it starts anew */
    }
    if (input->test_result == RAPTOR_TEST_FAILED) {
        return RAPTOR_SYS_ACT_TEST_FAIL;
    }
    return input->test_result == RAPTOR_TEST_PASSED ? RAPTOR_SYS_ACT_TEST_PASSED : RAPTOR_SYS_ACT_TESTING;
}

static uint8_t after_act_test_passed(const raptor_sys_input *input)
{
    if (input->safety_switch < SWITCH_ACTUATION_TEST) {
        return RAPTOR_SYS_SUBSYS_CON;
    }
    return input->ct_state == RAPTOR_CT_ACT_TEST && input->safety_switch == SWITCH_ENGINE ? RAPTOR_SYS_CRANKREADY
                                                                                          : RAPTOR_SYS_ACT_TEST_PASSED;
}

/* The ordinary way on from a state; emergencies and shutdown were looked at before. */
static uint8_t next_state(raptor_sys_machine *self, const raptor_config *config, const raptor_sys_input *input,
                          uint64_t now_us)
{
    const uint64_t age_us = now_us - self->entered_us;

    switch (self->state) {
    case RAPTOR_SYS_PWR_ON:
        return age_us >= config->power_on_us ? RAPTOR_SYS_SUBSYS_CON : RAPTOR_SYS_PWR_ON;
    case RAPTOR_SYS_SUBSYS_CON:
        return input->subsystems_ready && input->safety_switch >= SWITCH_ACTUATION_TEST ? RAPTOR_SYS_ACT_TESTING
                                                                                        : RAPTOR_SYS_SUBSYS_CON;
    case RAPTOR_SYS_ACT_TESTING:
        return after_act_testing(input);
    case RAPTOR_SYS_ACT_TEST_PASSED:
        return after_act_test_passed(input);
    case RAPTOR_SYS_CRANKREADY:
        return input->ct_state == RAPTOR_CT_CRANKREADY ? RAPTOR_SYS_CRANK_CHECK_INIT : RAPTOR_SYS_CRANKREADY;
    case RAPTOR_SYS_CRANK_CHECK_INIT:
        if (debounce_step(&self->conditions, input->crank_conditions, config->crank_check_us, now_us)) {
            return RAPTOR_SYS_CRANK_CHECKS_PASSED;
        }
        return age_us >= config->crank_check_limit_us ? RAPTOR_SYS_CRANK_CHECKS_FAIL : RAPTOR_SYS_CRANK_CHECK_INIT;
    case RAPTOR_SYS_CRANK_CHECKS_PASSED:
        if (!input->crank_conditions) {
            return RAPTOR_SYS_CRANK_CHECKS_FAIL;
        }
        return input->ct_state == RAPTOR_CT_CRANKING && flag_is(input, RAPTOR_TRACK_ORANGE)
                   ? RAPTOR_SYS_CRANKING
                   : RAPTOR_SYS_CRANK_CHECKS_PASSED;
    case RAPTOR_SYS_CRANKING:
        if (debounce_step(&self->conditions, input->engine_running, config->engine_settle_us, now_us)) {
            return RAPTOR_SYS_ENG_IDLE;
        }
        return age_us >= config->crank_limit_us ? RAPTOR_SYS_ENG_FAILED_TO_START : RAPTOR_SYS_CRANKING;
    case RAPTOR_SYS_ENG_IDLE:
        if (debounce_step(&self->conditions, !input->engine_running, config->engine_low_us, now_us)) {
            return RAPTOR_SYS_ENG_FAILED_TO_START;
        }
        return input->ct_state == RAPTOR_CT_INIT_DRIVING &&
                       (flag_is(input, RAPTOR_TRACK_YELLOW) || flag_is(input, RAPTOR_TRACK_GREEN))
                   ? RAPTOR_SYS_DRIVING
                   : RAPTOR_SYS_ENG_IDLE;
    case RAPTOR_SYS_SHUT_ENG:
        return input->engine_stopped ? RAPTOR_SYS_PWR_OFF : RAPTOR_SYS_SHUT_ENG;
    default:
        return self->state;
    }
}

static uint8_t choose_state(raptor_sys_machine *self, const raptor_config *config, const raptor_sys_input *input,
                            uint64_t now_us)
{
    const uint8_t state = self->state;

    if (state == RAPTOR_SYS_PWR_OFF || state == RAPTOR_SYS_EMERGENCY_SHUTDOWN) {
        return state;
    }
    if (input->stopping || input->ct_state == RAPTOR_CT_EMRG_SHUTDOWN || (supervised(state) && input->emergency) ||
        (engine_enabled(state) && input->safety_switch != SWITCH_ENGINE)) {
        return RAPTOR_SYS_EMERGENCY_SHUTDOWN;
    }
    if (input->ct_state == RAPTOR_CT_CNTRL_SHUTDOWN && engine_enabled(state)) {
        return RAPTOR_SYS_SHUT_ENG;
    }
    return next_state(self, config, input, now_us);
}

void raptor_sys_step(raptor_sys_machine *self, const raptor_config *config, const raptor_sys_input *input,
                     uint64_t now_us)
{
    if (!self->started) {
        self->started = true;
        self->entered_us = now_us;
    }
    const uint8_t next = choose_state(self, config, input, now_us);
    if (next != self->state) {
        self->state = next;
        self->entered_us = now_us;
        self->conditions = (debounce){0};
    }
}
