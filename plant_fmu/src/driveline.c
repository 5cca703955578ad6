#include "driveline.h"

#include <math.h>
#include <stdbool.h>

#include "numeric.h"

/* The clutch stays open when closing it would spin the engine beyond this multiple of its limit. */
static const double overspeed_factor = 1.03;

/* Sweeps of the impulse solver. Saturated elements are right after one sweep, and at most one pair
 * of sticking elements is coupled, so a few are enough; the count is fixed for a fixed run time. */
#define SWEEPS 4

/* An engine this near to the speed of its gear is in step with it. */
static const double match_tolerance = 3.0; /* rad/s */

double driveline_ratio(const struct plant_vars *p, int32_t gear)
{
    const double ratio[] = {
        0.0, p->gear_ratio_1, p->gear_ratio_2, p->gear_ratio_3, p->gear_ratio_4, p->gear_ratio_5, p->gear_ratio_6};
    return (gear >= 0 && gear <= 6) ? ratio[gear] * p->final_drive_ratio : 0.0;
}

void driveline_start(struct driveline_state *state, int32_t gear)
{
    state->gear = gear;
    state->next_gear = gear;
    state->status = SHIFT_UNINITIALISED;
    state->shift_left = 0.0;
    state->clutch_ramp = 1.0;
    state->matching = 0;
    state->engagement = 0.0;
    state->clutch_torque = 0.0;
    state->wheel_torque = 0.0;
    state->loss_torque = 0.0;
}

static void shift_begin(struct driveline_state *state, const struct plant_vars *p, int32_t next, double axle_speed)
{
    const double limit = overspeed_factor * p->engine_speed_limit;
    if (next > 0 && next < state->gear && driveline_ratio(p, next) * axle_speed > limit) {
        state->status = SHIFT_LOCKED_OUT;
        return;
    }
    state->next_gear = next;
    state->matching = state->gear > 0 && next > 0 ? 1 : 0; /* from neutral the car is launched or coasts */
    state->status = next > state->gear ? SHIFT_UP : SHIFT_DOWN;
    state->shift_left = p->shift_time;
}

/* In a gear with the clutch still closing after a shift. */
static bool shift_closing(const struct driveline_state *state)
{
    return (state->status == SHIFT_UP || state->status == SHIFT_DOWN) && state->gear > 0 && state->clutch_ramp > 0.0 &&
           state->clutch_ramp < 1.0;
}

void driveline_shift_step(struct driveline_state *state, const struct plant_vars *p, int32_t demand, int32_t powered,
                          const double wheel_speed[4], double engine_speed, struct engine_command *command)
{
    const double dt = PLANT_INNER_STEP_S;
    const double axle_speed = 0.5 * (wheel_speed[RL] + wheel_speed[RR]);
    const int32_t target = demand < 0 ? 0 : (demand > 6 ? 6 : demand);

    if (state->shift_left > 0.0) {
        state->shift_left -= dt;
        if (state->shift_left <= 0.5 * dt) {
            state->shift_left = 0.0;
            state->gear = state->next_gear;
            state->clutch_ramp = 0.0;
        }
    } else if (shift_closing(state)) {
        /* The shift is not over until the clutch has closed: another one would find the engine out
         * of step. */
    } else if (powered == 0) {
        state->status = SHIFT_UNINITIALISED;
    } else if (target == state->gear) {
        state->status = SHIFT_READY;
    } else {
        shift_begin(state, p, state->gear + (target > state->gear ? 1 : -1), axle_speed);
    }

    command->request = ENGINE_FOLLOW_THROTTLE;
    command->match_speed = 0.0;
    state->engagement = 0.0;
    if (state->matching != 0) {
        command->request = ENGINE_MATCH_SPEED;
        command->match_speed = fmax(driveline_ratio(p, state->next_gear) * axle_speed, p->engine_idle_speed);
    }
    if (state->shift_left > 0.0) {
        return; /* the driveline is open */
    }
    const double ratio = driveline_ratio(p, state->gear);
    if (state->gear == 0 || ratio * axle_speed > overspeed_factor * p->engine_speed_limit) {
        state->clutch_ramp = 0.0;
        state->matching = 0;
        return;
    }
    const bool in_step = state->matching == 0 || fabs(engine_speed - command->match_speed) < match_tolerance;
    state->clutch_ramp = fmin(1.0, state->clutch_ramp + dt / (in_step ? p->clutch_close_time : p->clutch_match_time));
    if (state->clutch_ramp >= 1.0) {
        state->matching = 0;
    }
    const double span = fmax(p->clutch_closed_speed - p->clutch_engage_speed, 1.0);
    /* Capacity follows engine speed at once, so the engine cannot be dragged below idle. */
    state->engagement = fmin(state->clutch_ramp, clamp((engine_speed - p->clutch_engage_speed) / span, 0.0, 1.0));
}

void driveline_rotate(struct driveline_state *state, const struct plant_vars *p, const struct rotation_input *in,
                      double wheel_speed[4], double *engine_speed, struct rotation_work *work)
{
    const double dt = PLANT_INNER_STEP_S;
    const double inertia[4] = {p->wheel_inertia_front, p->wheel_inertia_front, p->wheel_inertia_rear,
                               p->wheel_inertia_rear};
    const double radius[4] = {p->tyre_radius_front, p->tyre_radius_front, p->tyre_radius_rear, p->tyre_radius_rear};
    const double ratio = state->shift_left > 0.0 ? 0.0 : driveline_ratio(p, state->gear);

    double speed[4];
    double bound[4];
    double friction[4] = {0.0, 0.0, 0.0, 0.0};
    for (int i = 0; i < WHEELS; ++i) {
        speed[i] = wheel_speed[i] - dt * in->tyre_force_x[i] * radius[i] / inertia[i];
        bound[i] = dt * (in->wheel_friction[i] + (i >= RL ? 0.5 * state->loss_torque : 0.0));
    }
    double engine = *engine_speed + dt * in->engine_torque / p->engine_inertia;

    const double rear = p->wheel_inertia_rear;
    const double clutch_mass = 1.0 / (1.0 / p->engine_inertia + ratio * ratio / (2.0 * rear));
    const double clutch_bound = dt * p->clutch_torque_max * state->engagement;
    const double lock_bound = dt * (p->differential_preload + p->differential_lock_ratio * fabs(state->wheel_torque));
    double clutch = 0.0;
    double lock = 0.0;
    for (int sweep = 0; sweep < SWEEPS; ++sweep) {
        for (int i = 0; i < WHEELS; ++i) {
            const double wanted = friction[i] - speed[i] * inertia[i];
            const double next = clamp(wanted, -bound[i], bound[i]);
            if (next == wanted) {
                speed[i] = 0.0; /* sticks, with no remainder of rounding */
            } else {
                speed[i] += (next - friction[i]) / inertia[i];
            }
            friction[i] = next;
        }
        const double lock_next = clamp(lock - 0.5 * rear * (speed[RL] - speed[RR]), -lock_bound, lock_bound);
        speed[RL] += (lock_next - lock) / rear;
        speed[RR] -= (lock_next - lock) / rear;
        lock = lock_next;

        const double slip = engine - ratio * 0.5 * (speed[RL] + speed[RR]);
        const double clutch_next = clamp(clutch + slip * clutch_mass, -clutch_bound, clutch_bound);
        const double change = clutch_next - clutch;
        engine -= change / p->engine_inertia;
        speed[RL] += 0.5 * change * ratio / rear;
        speed[RR] += 0.5 * change * ratio / rear;
        clutch = clutch_next;
    }

    work->wheel_friction = 0.0;
    for (int i = 0; i < WHEELS; ++i) {
        work->wheel_mid[i] = 0.5 * (wheel_speed[i] + speed[i]);
        work->wheel_friction -= friction[i] * work->wheel_mid[i];
        wheel_speed[i] = speed[i];
    }
    const double engine_mid = 0.5 * (*engine_speed + engine);
    const double axle_mid = 0.5 * (work->wheel_mid[RL] + work->wheel_mid[RR]);
    work->engine = dt * in->engine_torque * engine_mid;
    work->clutch = clutch * (engine_mid - ratio * axle_mid) - lock * (work->wheel_mid[RL] - work->wheel_mid[RR]);
    *engine_speed = engine;
    state->clutch_torque = clutch / dt;
    const double gross = ratio * state->clutch_torque;
    state->loss_torque = (1.0 - p->driveline_efficiency) * fabs(gross);
    state->wheel_torque = gross - (axle_mid >= 0.0 ? state->loss_torque : -state->loss_torque);
}
