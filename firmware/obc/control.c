#include "obc/control.h"

#include <math.h>
#include <stddef.h>

#include "obc/numeric.h"
#include "obc/pure_pursuit.h"
#include "obc/stanley.h"

static const float steering_speed_min = 0.5f; /* m/s: the wheels are not turned on the spot */

/* Wheel speed is exact at walking pace, the estimate does not slip with the wheels: faded over this range. */
static const float wheel_speed_until = 2.0f;   /* m/s */
static const float estimate_speed_from = 5.0f; /* m/s */

static const float speed_preview_time = 0.05f; /* s */
static const float speed_preview_min = 1.0f;   /* m: a plan that starts at standstill sets the car in motion */
static const float landing_speed = 1.5f;       /* m/s, below it a stop within the preview is one for here */
static const float gradient_time = 0.3f;       /* s, over which the planned speed's gradient is taken */
static const float gradient_min = 2.0f;        /* m */

void control_init(control *self)
{
    *self = (control){0};
}

static bool estimate_usable(const control_estimate *e)
{
    return e->valid && isfinite(e->x) && isfinite(e->y) && isfinite(e->yaw) && isfinite(e->vx) && isfinite(e->vy) &&
           isfinite(e->yaw_rate) && isfinite(e->ax) && isfinite(e->ay);
}

static float finite_or_zero(float value)
{
    return isfinite(value) ? value : 0.0f;
}

static float car_speed(const control_input *in, bool usable)
{
    const float wheel = fmaxf(finite_or_zero(in->feedback.wheel_speed), 0.0f);
    if (!usable) {
        return wheel;
    }
    const float estimated = fmaxf(in->estimate.vx, 0.0f);
    const float part =
        numeric_clamp((wheel - wheel_speed_until) / (estimate_speed_from - wheel_speed_until), 0.0f, 1.0f);
    const float speed = wheel + part * (estimated - wheel);
    /* Where the two contradict each other, a wheel that locks or a source that hangs, the car is taken to be fast. */
    return fmaxf(speed, fmaxf(wheel, estimated) - CONTROL_SPEED_DISAGREEMENT);
}

/* Let every lateral controller see the car at the end of the dead time. */
static void lateral_step(control *self, const control_input *in, float speed, const vehicle_cornering *cornering,
                         float bank, lateral_state *state, control_output *out)
{
    const vehicle_motion now = {
        .x = in->estimate.x,
        .y = in->estimate.y,
        .yaw = in->estimate.yaw,
        .vy = in->estimate.vy,
        .yaw_rate = in->estimate.yaw_rate,
    };
    motion_prediction predicted;
    motion_predictor_predict(&self->predictor, &now, cornering, speed, bank, &predicted);
    lateral_state_make(state, in->plan, speed, &predicted);
    out->road_wheel_angle[CONTROL_LQR] = lateral_lqr_command(&self->lqr, state);
    out->road_wheel_angle[CONTROL_STANLEY] = stanley_command(state);
    out->road_wheel_angle[CONTROL_PURE_PURSUIT] = pure_pursuit_command(state);
}

/* The emergency controller looks at the wall in every state, so that it is warm. */
static void emergency_lateral_step(control *self, const control_input *in, emergency_output *result,
                                   control_output *out)
{
    const emergency_input wall = {
        .wall = in->wall,
        .wall_count = in->wall_count,
        .wall_age_ms = in->wall_age_ms,
        .wall_timeout_ms = in->wall_timeout_ms,
        .wheel_speed = in->feedback.wheel_speed,
        .road_wheel_angle = in->feedback.road_wheel_angle,
        .engaged = in->lateral == CONTROL_EMERGENCY,
    };
    emergency_step(&self->emergency, &wall, &self->predictor, result);
    if (result->valid) {
        out->road_wheel_angle[CONTROL_EMERGENCY] = result->road_wheel_angle;
    }
    out->emergency_valid = result->valid;
}

/* Round to the step of the wire; the rest is carried to the next command. */
static float round_to_wire(control *self, float command)
{
    const float step = controller_table.steer_step;
    const float wish = command + self->rounding;
    const float rounded = step * roundf(wish / step);
    self->rounding = numeric_clamp(wish - rounded, -step, step);
    return rounded;
}

static void steer(control *self, const control_input *in, float speed, const lateral_state *state, control_output *out)
{
    const float limit = controller_table.steer_max;
    const uint8_t chosen = in->lateral < CONTROL_LATERAL_COUNT ? in->lateral : (uint8_t)CONTROL_NONE;
    const bool valid = chosen == CONTROL_EMERGENCY ? out->emergency_valid : out->lateral_valid;
    if (speed < steering_speed_min) {
        self->lqr.integral = 0.0f;
    } else if (valid && isfinite(out->road_wheel_angle[chosen])) {
        const float wish = out->road_wheel_angle[chosen];
        if (chosen == CONTROL_LQR && fabsf(wish) < limit) {
            lateral_lqr_integrate(&self->lqr, state);
        }
        self->road_wheel_command = round_to_wire(self, numeric_clamp(wish, -limit, limit));
    }
    motion_predictor_update(&self->predictor, self->road_wheel_command, in->feedback.road_wheel_angle);
    out->road_wheel_command = self->road_wheel_command;
}

/* Speed that the plan and the limits ask for, and the plan's acceleration. */
static void speed_target(const control_input *in, float s, float speed, longitudinal_input *out)
{
    const float max_speed = fmaxf(finite_or_zero(in->max_speed), 0.0f);
    const float span = fmaxf(gradient_time * speed, gradient_min);
    path_point here;
    path_point beyond;
    path_point preview;
    path_at(in->plan, s, &here);
    path_at(in->plan, s + span, &beyond);
    path_at(in->plan, s + fmaxf(speed_preview_time * speed, speed_preview_min), &preview);
    const bool landing = preview.speed <= 0.0f && speed < landing_speed;
    out->target_speed = landing ? 0.0f : fmaxf(here.speed, preview.speed);
    /* Over a span the rounding of the speeds does not count; before a stop only the place itself does. */
    out->target_acceleration = beyond.speed > 0.0f
                                   ? (beyond.speed * beyond.speed - here.speed * here.speed) / (2.0f * span)
                                   : here.acceleration;
    if (out->target_speed >= max_speed) {
        out->target_speed = max_speed;
        out->target_acceleration = fminf(out->target_acceleration, 0.0f);
    }
}

static void drive(control *self, const control_input *in, float speed, const path_projection *now, bool usable,
                  const vehicle_cornering *cornering, control_output *out)
{
    longitudinal_output result;
    if (!in->drive_enabled) {
        longitudinal_hold(&self->speed, speed, &result);
    } else {
        longitudinal_input wish = {
            .speed = speed,
            .acceleration = usable ? in->estimate.ax : 0.0f,
            .max_acceleration = fmaxf(finite_or_zero(in->max_acceleration), 0.0f),
            .max_deceleration = fmaxf(finite_or_zero(in->max_deceleration), 0.0f),
            .road = *cornering,
            .engine_speed = finite_or_zero(in->feedback.engine_speed),
            .gear = in->feedback.gear,
            .shifting = in->feedback.gear_shift_status != GEAR_SHIFT_READY,
        };
        /* Nobody planned what comes after the last point: a car that is beyond it stops. */
        const bool beyond = now->outside && now->foot.s > 0.0f;
        if (out->lateral_valid && !in->safe_stop && !beyond) {
            speed_target(in, now->foot.s, speed, &wish);
        }
        longitudinal_step(&self->speed, &wish, &result);
    }
    out->throttle = result.throttle;
    out->brake_pressure = result.brake_pressure;
    out->speed_error = result.speed_error;
}

/* Standstill by a way that leaves the wheels turning, by what they tell of speed and acceleration. */
static void emergency_drive(control *self, const control_input *in, const emergency_output *motion,
                            const vehicle_cornering *cornering, control_output *out)
{
    longitudinal_output result;
    const float deceleration = numeric_clamp(finite_or_zero(in->max_deceleration), 0.0f, EMERGENCY_DECELERATION);
    const longitudinal_input wish = {
        .speed = motion->speed,
        .acceleration = motion->acceleration,
        .max_deceleration = deceleration,
        .road = *cornering,
        .engine_speed = finite_or_zero(in->feedback.engine_speed),
        .gear = in->feedback.gear,
        .shifting = in->feedback.gear_shift_status != GEAR_SHIFT_READY,
    };
    longitudinal_step(&self->speed, &wish, &result);
    out->throttle = 0.0f;
    out->brake_pressure = result.brake_pressure;
    out->speed_error = result.speed_error;
}

void control_step(control *self, const control_input *in, control_output *out)
{
    const bool usable = estimate_usable(&in->estimate);
    const bool blind = in->lateral == CONTROL_EMERGENCY;
    path_projection now = {0};
    lateral_state state = {0};
    vehicle_cornering cornering;
    emergency_output rolling;

    *out = (control_output){0};
    for (uint32_t i = 0; i < CONTROL_LATERAL_COUNT; i++) {
        out->road_wheel_angle[i] = self->road_wheel_command;
    }
    emergency_lateral_step(self, in, &rolling, out);
    const float speed = blind ? rolling.speed : car_speed(in, usable);
    out->lateral_valid = usable && in->plan != NULL;
    if (out->lateral_valid) {
        path_project(in->plan, in->estimate.x, in->estimate.y, &now);
        out->cross_track_error = now.lateral;
        out->heading_error = numeric_wrap_angle(in->estimate.yaw - now.foot.yaw);
    }
    vehicle_steady_cornering(speed, now.foot.curvature, now.foot.bank, &cornering);
    if (out->lateral_valid) {
        lateral_step(self, in, speed, &cornering, now.foot.bank, &state, out);
    }
    steer(self, in, speed, &state, out);
    if (blind && in->drive_enabled) {
        emergency_drive(self, in, &rolling, &cornering, out);
    } else {
        drive(self, in, speed, &now, usable, &cornering, out);
    }
    out->gear = gear_shift_step(&self->gear, speed, in->feedback.gear, in->feedback.gear_shift_status,
                                in->feedback.engine_running, in->drive_enabled);
}
