#include "steering.h"

#include "numeric.h"

void steering_start(struct steering_state *state)
{
    delay_fill(&state->delay, 0.0);
    state->angle = 0.0;
    state->rate = 0.0;
}

void steering_step(struct steering_state *state, const struct plant_vars *p, double demand)
{
    const double dt = PLANT_INNER_STEP_S;
    const double limit = p->steer_motor_limit;
    const double target = delay_step(&state->delay, clamp(demand, -limit, limit), p->steer_delay);
    const double omega = 2.0 * PLANT_PI * p->steer_bandwidth;

    /* Damping is taken implicitly: it stays stable for any bandwidth the table allows. */
    double rate =
        (state->rate + dt * omega * omega * (target - state->angle)) / (1.0 + 2.0 * p->steer_damping * omega * dt);
    rate = clamp(rate, -p->steer_motor_rate_limit, p->steer_motor_rate_limit);
    double angle = state->angle + dt * rate;
    if (angle > limit || angle < -limit) {
        angle = clamp(angle, -limit, limit);
        rate = 0.0; /* at the mechanical stop */
    }
    state->angle = angle;
    state->rate = rate;
}

double steering_road_angle(const struct steering_state *state, const struct plant_vars *p)
{
    return state->angle / p->steer_ratio + p->steer_offset;
}
