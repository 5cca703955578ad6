#include "obc/emergency.h"

#include <math.h>
#include <stddef.h>

#include "obc/numeric.h"
#include "obc/pure_pursuit.h"

static const float period = 0.01f; /* s */

/* m/s2: the tyres slow the car no faster than this while it is steered; wheels that do are locking. */
static const float fastest_slowing = 15.0f;

static const float smoothing = 0.1f; /* share of a new acceleration: the wheels' speed comes in steps */

/* The bank is not known: the controller sees neither the road nor gravity. */
static const float level = 0.0f;

static void observe_speed(emergency *self, float wheel_speed)
{
    const float wheels = isfinite(wheel_speed) ? fmaxf(wheel_speed, 0.0f) : 0.0f;
    const float before = self->speed;
    self->speed = fmaxf(wheels, before - fastest_slowing * period);
    self->acceleration += smoothing * ((self->speed - before) / period - self->acceleration);
}

static bool finite_wall(const wall_polynomial *wall)
{
    bool finite = isfinite(wall->begin) && isfinite(wall->end);
    for (uint32_t i = 0U; i < WALL_COEFFICIENTS; i++) {
        finite = finite && isfinite(wall->coefficient[i]);
    }
    return finite;
}

static void reckon(emergency *self, const emergency_input *in, const vehicle_cornering *tyres)
{
    const float steer = isfinite(in->road_wheel_angle) ? in->road_wheel_angle : 0.0f;
    vehicle_motion_step(&self->car, tyres, self->speed, level, steer, period);
    if (in->wall != NULL && in->wall_count != self->wall_count && finite_wall(in->wall)) {
        self->wall_count = in->wall_count;
        self->wall = *in->wall;
        self->car.x = 0.0f;
        self->car.y = 0.0f;
        self->car.yaw = 0.0f;
    }
}

void emergency_step(emergency *self, const emergency_input *in, const motion_predictor *predictor,
                    emergency_output *out)
{
    vehicle_cornering tyres;
    wall_foot foot;
    observe_speed(self, in->wheel_speed);
    vehicle_steady_cornering(self->speed, self->curvature, level, &tyres);
    reckon(self, in, &tyres);

    const bool seen = in->wall != NULL && in->wall_count == self->wall_count;
    const bool fresh = seen && in->wall_age_ms <= in->wall_timeout_ms;
    const bool held = seen && in->engaged && in->wall_age_ms <= in->wall_timeout_ms + EMERGENCY_HOLD_MS;
    *out = (emergency_output){.speed = self->speed, .acceleration = self->acceleration};
    if (!fresh) {
        out->road_wheel_angle = tyres.steer;
        out->valid = held;
        return;
    }
    wall_path_foot(&self->wall, self->car.x, self->car.y, &foot);
    self->curvature = foot.curvature;
    if (!in->engaged) {
        self->distance = wall_path_distance(foot.distance);
    }

    motion_prediction ahead;
    motion_predictor_predict(predictor, &self->car, &tyres, self->speed, level, &ahead);
    const pursuit rear = pure_pursuit_begin(&ahead.motion, &tyres, self->speed);
    const wall_target target = wall_path_target(&self->wall, foot.side, self->distance, rear.x, rear.y, rear.lookahead);
    out->road_wheel_angle = pure_pursuit_towards(&rear, &tyres, target.x, target.y);
    out->valid = isfinite(out->road_wheel_angle);
}
