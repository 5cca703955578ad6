#include "brakes.h"

#include <math.h>

#include "numeric.h"

void brakes_start(struct brakes_state *state)
{
    delay_fill(&state->delay, 0.0);
    state->pressure = 0.0;
}

void brakes_step(struct brakes_state *state, const struct plant_vars *p, double demand)
{
    const double dt = PLANT_INNER_STEP_S;
    const double target = delay_step(&state->delay, clamp(demand, 0.0, p->brake_pressure_max), p->brake_delay);
    const double lagged = lag_step(state->pressure, target, 1.0 / (2.0 * PLANT_PI * p->brake_bandwidth), dt);
    const double step = p->brake_pressure_rate_limit * dt;
    state->pressure += clamp(lagged - state->pressure, -step, step);
}

double brakes_front_pressure(const struct brakes_state *state, const struct plant_vars *p)
{
    return state->pressure * fmin(1.0, p->brake_front_share / (1.0 - p->brake_front_share));
}

double brakes_rear_pressure(const struct brakes_state *state, const struct plant_vars *p)
{
    return state->pressure * fmin(1.0, (1.0 - p->brake_front_share) / p->brake_front_share);
}
