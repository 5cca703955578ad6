#include "obc/stanley.h"

#include <math.h>

#include "obc/numeric.h"

static const float error_gain = 1.2f;   /* 1/s: rate at which the front axle comes back to the path */
static const float softening = 2.0f;    /* m/s: keeps the law calm at walking speed */
static const float yaw_damping = 0.05f; /* s */

float stanley_command(const lateral_state *state)
{
    const vehicle_motion *motion = &state->predicted.motion;
    const float lf = controller_table.cg_to_front;
    path_projection front;
    path_project(state->plan, motion->x + lf * cosf(motion->yaw), motion->y + lf * sinf(motion->yaw), &front);
    const float heading_error = numeric_wrap_angle(motion->yaw - front.foot.yaw);
    const float lead = state->steer_ahead - state->cornering.steer; /* what the path asks for an actuator lag later */
    return state->cornering.slip_front + lead - heading_error -
           atanf(error_gain * front.lateral / (softening + state->speed)) -
           yaw_damping * (motion->yaw_rate - state->cornering.yaw_rate);
}
