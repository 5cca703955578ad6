#include "raptor/actuation_test.h"

#include <math.h>
#include <string.h>

#include "raptor/sys_state.h"

/* Brake pressure that a step asks for. */
enum brake_level { BRAKE_HOLD, BRAKE_RELEASE, BRAKE_PULSE };

typedef struct test_row {
    float steer_share; /* of config->test_steer */
    enum brake_level brake;
} test_row;

/* Steering under held brake first, then the brake with straight wheels. */
static const test_row rows[] = {
    {0.0f, BRAKE_HOLD},    {1.0f, BRAKE_HOLD},  {-1.0f, BRAKE_HOLD},   {0.0f, BRAKE_HOLD},
    {0.0f, BRAKE_RELEASE}, {0.0f, BRAKE_PULSE}, {0.0f, BRAKE_RELEASE}, {0.0f, BRAKE_PULSE},
};

enum { ROWS = sizeof rows / sizeof rows[0] };

static float brake_wanted(const raptor_config *config, enum brake_level level)
{
    switch (level) {
    case BRAKE_RELEASE:
        return config->test_brake_release;
    case BRAKE_PULSE:
        return config->test_brake;
    case BRAKE_HOLD:
    default:
        return config->brake_hold;
    }
}

static void enter(raptor_test *self, const raptor_config *config, uint8_t step, uint64_t now_us)
{
    self->step = step;
    self->fits = (debounce){0};
    self->entered_us = now_us;
    self->steer = rows[step].steer_share * config->test_steer;
    self->brake = brake_wanted(config, rows[step].brake);
}

void raptor_test_start(raptor_test *self, const raptor_config *config, uint64_t now_us)
{
    memset(self, 0, sizeof *self);
    enter(self, config, 0, now_us);
}

/* True when value is within tolerance of expected; NaN is not. */
static bool near(float value, float expected, float tolerance)
{
    return fabsf(value - expected) <= tolerance;
}

static bool step_fits(const raptor_test *self, const raptor_config *config, const raptor_test_input *input)
{
    /* What leaves must be what the test wants: a larger brake command of the onboard computer is let through. */
    bool fits =
        near(input->steer_request, self->steer, config->test_steer_tolerance) && input->brake_request >= self->brake;

    for (uint32_t i = 0; i < RAPTOR_GATEWAY_CHANNELS; i++) {
        const raptor_gateway_channel *steer = &input->gateway->steer.channels[i];
        const raptor_gateway_channel *brake = &input->gateway->brake.channels[i];
        fits = fits && steer->valid && near(steer->position, input->steer_request, config->test_steer_tolerance);
        fits = fits && brake->valid && near(brake->position, input->brake_request, config->test_brake_tolerance);
    }
    for (uint32_t i = 0; i < 2U; i++) {
        const float expected = input->brake_request * config->brake_axle_share[i];
        fits = fits && near(input->brake_lines[i], expected, config->test_brake_tolerance);
        if (rows[self->step].brake == BRAKE_PULSE) {
            fits = fits && input->brake_lines[i] >= config->test_brake_required;
        }
    }
    return fits;
}

void raptor_test_step(raptor_test *self, const raptor_config *config, const raptor_test_input *input, uint64_t now_us)
{
    if (self->result != RAPTOR_TEST_RUNNING) {
        return;
    }
    if (debounce_step(&self->fits, step_fits(self, config, input), config->test_settle_us, now_us)) {
        if (self->step + 1U < ROWS) {
            enter(self, config, (uint8_t)(self->step + 1U), now_us);
        } else {
            self->result = RAPTOR_TEST_PASSED;
            self->brake = config->brake_hold;
        }
    } else if (now_us - self->entered_us >= config->test_step_limit_us) {
        self->result = RAPTOR_TEST_FAILED;
    }
}
