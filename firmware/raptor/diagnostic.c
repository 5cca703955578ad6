#include "raptor/diagnostic.h"

#include <math.h>

#include "raptor/states.h"

/* Brake lines are judged once the actuation test has shown that they work. */
static bool brakes_judged(uint8_t sys_state)
{
    switch (sys_state) {
    case RAPTOR_SYS_ACT_TEST_PASSED:
    case RAPTOR_SYS_CRANKREADY:
    case RAPTOR_SYS_CRANK_CHECK_INIT:
    case RAPTOR_SYS_CRANK_CHECKS_PASSED:
    case RAPTOR_SYS_CRANKING:
    case RAPTOR_SYS_ENG_IDLE:
    case RAPTOR_SYS_DRIVING:
        return true;
    default:
        return false;
    }
}

/* A line is out of spec when a request that has not moved for a while is not answered by its pressure. */
static uint32_t judge_brakes(raptor_diagnostic *self, const raptor_config *config, const raptor_diagnostic_input *input,
                             uint64_t now_us)
{
    static const uint32_t bits_of[2] = {RAPTOR_DIAG_EST1_FRONT_BRAKE, RAPTOR_DIAG_EST2_REAR_BRAKE};
    uint32_t bits = 0;

    const bool constant = fabsf(input->brake_request - self->settled_request) <= config->brake_settled_band;
    if (!constant) {
        self->settled_request = input->brake_request;
    }
    const bool settled = debounce_step(&self->settled, constant, config->brake_settle_us, now_us);
    for (uint32_t i = 0; i < 2U; i++) {
        const float expected = input->brake_request * config->brake_axle_share[i];
        const float allowed = config->brake_out_of_spec + config->brake_out_of_spec_share * expected;
        const bool fits = fabsf(input->brake_lines[i] - expected) <= allowed; /* NaN does not */
        if (debounce_step(&self->out_of_spec[i], settled && !fits && brakes_judged(input->sys_state),
                          config->brake_fault_us, now_us)) {
            bits |= bits_of[i];
        }
    }
    return bits;
}

/* Warnings of one axis: a channel whose position is wrong or overdue, or with an active error. */
static uint32_t judge_axis(const raptor_gateway_axis *axis, uint32_t first_warning)
{
    uint32_t bits = 0;

    for (uint32_t i = 0; i < RAPTOR_GATEWAY_CHANNELS; i++) {
        const raptor_gateway_channel *channel = &axis->channels[i];
        if (channel->faulty || channel->error) {
            bits |= (first_warning << i) | RAPTOR_DIAG_SD_WARNING;
        }
        if (channel->critical) {
            bits |= RAPTOR_DIAG_SD_FAILURE;
        }
    }
    return bits;
}

static uint32_t judge_space_drive(const raptor_gateway *gateway)
{
    uint32_t bits = judge_axis(&gateway->brake, RAPTOR_DIAG_SD_BRAKE_WARNING_1) |
                    judge_axis(&gateway->steer, RAPTOR_DIAG_SD_STEER_WARNING_1);

    if (gateway->lost) {
        bits |= RAPTOR_DIAG_EST4_SD_LOST | RAPTOR_DIAG_SD_FAILURE;
    }
    if (gateway->emergency_brake) {
        bits |= RAPTOR_DIAG_EST6_SD_EBRAKE | RAPTOR_DIAG_SD_FAILURE;
    }
    return bits;
}

void raptor_diagnostic_step(raptor_diagnostic *self, const raptor_config *config, const raptor_diagnostic_input *input,
                            uint64_t now_us)
{
    uint32_t bits = judge_brakes(self, config, input, now_us) | judge_space_drive(input->gateway);

    const bool low_engine = !input->engine_running || !(input->engine_speed >= config->engine_low_speed);
    if (debounce_step(&self->low_engine, input->sys_state == RAPTOR_SYS_DRIVING && low_engine, config->engine_low_us,
                      now_us)) {
        bits |= RAPTOR_DIAG_EST3_LOW_ENGINE;
    }
    if (input->obc_lost) {
        bits |= RAPTOR_DIAG_OBC_LOST;
    }
    if (!input->race_control_linked) {
        bits |= RAPTOR_DIAG_RC_LOST;
    }
    if (input->sys_state == RAPTOR_SYS_EMERGENCY_SHUTDOWN) {
        bits |= self->latched;
    } else {
        /* The step before the shutdown saw its cause. */
        self->latched = bits & (RAPTOR_DIAG_TRIGGERS | RAPTOR_DIAG_OBC_LOST);
    }
    self->bits = bits;
}
