#include "engine.h"

#include <math.h>

#include "numeric.h"

static const double rpm_per_rad_s = 30.0 / PLANT_PI;

/* The limiter fades fuel over this range below the limit, so that it does not chatter. */
static const double limiter_range = 10.0; /* rad/s */

/* Idle controller, N m per rad/s and N m per rad. */
static const double idle_gain = 2.0;
static const double idle_integral_gain = 4.0;

/* Drag fades to nothing below this speed: a standing engine stays where it is. */
static const double drag_fade_speed = 10.0; /* rad/s */

/* Speed matching at a shift, N m per rad/s: the engine follows within about 10 ms. */
static const double match_gain = 20.0;

/* Torque falls with the air path, much faster than the turbo lets it rise. */
static const double fall_rate_factor = 20.0;

/* Linear interpolation in a table with unit spacing, constant beyond its ends. */
static double interpolate(const double *table, int count, double position)
{
    if (position <= 0.0) {
        return table[0];
    }
    if (position >= (double)(count - 1)) {
        return table[count - 1];
    }
    const int i = (int)position;
    const double part = position - (double)i;
    return table[i] + part * (table[i + 1] - table[i]);
}

double engine_full_torque(const struct plant_vars *p, double speed)
{
    const double table[] = {p->engine_torque_500,  p->engine_torque_1000, p->engine_torque_1500, p->engine_torque_2000,
                            p->engine_torque_2500, p->engine_torque_3000, p->engine_torque_3500, p->engine_torque_4000,
                            p->engine_torque_4500, p->engine_torque_5000, p->engine_torque_5500, p->engine_torque_6000,
                            p->engine_torque_6500, p->engine_torque_7000, p->engine_torque_7500};
    return p->engine_torque_scale * interpolate(table, 15, speed * rpm_per_rad_s / 500.0 - 1.0);
}

double engine_throttle_share(const struct plant_vars *p, double throttle, double speed)
{
    const double table[] = {0.0,
                            p->throttle_fraction_10,
                            p->throttle_fraction_20,
                            p->throttle_fraction_30,
                            p->throttle_fraction_40,
                            p->throttle_fraction_50,
                            p->throttle_fraction_60,
                            p->throttle_fraction_70,
                            p->throttle_fraction_80,
                            p->throttle_fraction_90,
                            1.0};
    const double on_boost = interpolate(table, 11, throttle * 10.0);
    const double span = fmax(p->throttle_boost_speed_high - p->throttle_boost_speed_low, 1.0);
    const double boost = clamp((speed - p->throttle_boost_speed_low) / span, 0.0, 1.0);
    if (boost >= 1.0) {
        return on_boost;
    }
    const double off_boost = 1.0 - pow(1.0 - clamp(throttle, 0.0, 1.0), p->throttle_low_speed_exponent);
    return off_boost + boost * (on_boost - off_boost);
}

double engine_drag(const struct plant_vars *p, double speed)
{
    return (p->engine_brake_torque + p->engine_brake_slope * speed) * clamp(speed / drag_fade_speed, 0.0, 1.0);
}

void engine_start(struct engine_state *state, int32_t running, double speed)
{
    state->speed = running != 0 ? speed : 0.0;
    state->throttle = 0.0;
    state->boost_torque = 0.0;
    state->idle_integral = 0.0;
    state->torque = 0.0;
    state->running = running;
}

/* Torque of the idle controller: it only ever helps, and its integral is bounded. */
static double idle_torque(struct engine_state *state, const struct plant_vars *p)
{
    const double error = p->engine_idle_speed - state->speed;
    state->idle_integral =
        clamp(state->idle_integral + idle_integral_gain * error * PLANT_INNER_STEP_S, 0.0, p->engine_idle_torque_max);
    return clamp(idle_gain * error + state->idle_integral, 0.0, p->engine_idle_torque_max);
}

/* Indicated torque for the throttle, behind the limit on its rise. */
static double throttle_torque(struct engine_state *state, const struct plant_vars *p)
{
    const double dt = PLANT_INNER_STEP_S;
    const double demand = engine_full_torque(p, state->speed) * engine_throttle_share(p, state->throttle, state->speed);
    const double rise = p->engine_torque_rise_limit * dt;
    state->boost_torque += clamp(demand - state->boost_torque, -fall_rate_factor * rise, rise);
    return state->boost_torque;
}

void engine_step(struct engine_state *state, const struct plant_vars *p, const struct engine_command *command)
{
    const double dt = PLANT_INNER_STEP_S;
    state->throttle = lag_step(state->throttle, command->throttle, p->throttle_time_constant, dt);

    if (command->ignition == 0) {
        state->running = 0;
    } else if (state->running == 0) {
        state->running = (command->starter != 0 && state->speed >= p->engine_fire_speed) ? 1 : 0;
    } else if (state->speed < p->engine_stall_speed && command->starter == 0) {
        state->running = 0;
    }

    double drive = 0.0;
    double drag = engine_drag(p, state->speed);
    if (state->running != 0) {
        drag *= clamp(1.0 - state->throttle / p->engine_brake_throttle_span, 0.0, 1.0);
        const double fuel = throttle_torque(state, p);
        const double idle = idle_torque(state, p);
        const double ceiling = engine_full_torque(p, state->speed);
        const double limiter = clamp((p->engine_speed_limit - state->speed) / limiter_range, 0.0, 1.0);
        switch (command->request) {
        case ENGINE_MATCH_SPEED:
            /* a blip for a lower gear, a cut for a higher one */
            drag = engine_drag(p, state->speed);
            drive = clamp(drag + match_gain * (command->match_speed - state->speed), 0.0, ceiling);
            break;
        case ENGINE_FOLLOW_THROTTLE:
        default:
            drive = fmin(fuel + idle, fmax(ceiling, idle));
            break;
        }
        drive *= limiter;
        if (limiter < 1.0) {
            drag = fmax(drag, (1.0 - limiter) * engine_drag(p, state->speed));
        }
    } else {
        state->boost_torque = 0.0;
        state->idle_integral = 0.0;
    }
    if (command->starter != 0 && state->running == 0) {
        drive += p->starter_torque * clamp(1.0 - state->speed / p->starter_speed, 0.0, 1.0);
    }
    state->torque = drive - drag;
}
