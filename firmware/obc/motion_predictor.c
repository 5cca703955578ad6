#include "obc/motion_predictor.h"

#include <math.h>

#include "obc/numeric.h"

static const float period = 0.01f; /* s */

/* Share of the difference to the reported angle that is taken over per period: the report is one period old and
 * rounded to 0.033 degrees, the model is neither. */
static const float observer_gain = 0.2f;

static void actuator_step(float *angle, float *rate, float command)
{
    const controller_tables *car = &controller_table;
    const float next_angle =
        car->steer_transition[0][0] * *angle + car->steer_transition[0][1] * *rate + car->steer_input[0] * command;
    const float next_rate =
        car->steer_transition[1][0] * *angle + car->steer_transition[1][1] * *rate + car->steer_input[1] * command;
    const float step_max = car->steer_rate_max * period;
    *angle = numeric_clamp(next_angle, *angle - step_max, *angle + step_max);
    *rate = numeric_clamp(next_rate, -car->steer_rate_max, car->steer_rate_max);
}

void motion_predictor_predict(const motion_predictor *self, const vehicle_motion *now, const vehicle_cornering *tyres,
                              float speed, float bank, motion_prediction *out)
{
    out->motion = *now;
    out->steer = self->angle;
    out->steer_rate = self->rate;
    for (uint32_t i = 0; i < CONTROLLER_DEAD_TICKS; i++) {
        const float before = out->steer;
        actuator_step(&out->steer, &out->steer_rate, self->commands[i]);
        vehicle_motion_step(&out->motion, tyres, speed, bank, 0.5f * (before + out->steer), period);
    }
}

void motion_predictor_update(motion_predictor *self, float command, float measured)
{
    if (isfinite(measured)) {
        self->angle += observer_gain * (measured - self->angle);
    }
    actuator_step(&self->angle, &self->rate, self->commands[0]);
    for (uint32_t i = 0; i + 1u < CONTROLLER_DEAD_TICKS; i++) {
        self->commands[i] = self->commands[i + 1u];
    }
    self->commands[CONTROLLER_DEAD_TICKS - 1] = command;
}
