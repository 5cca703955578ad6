#include "obc/pure_pursuit.h"

#include <math.h>

#include "obc/numeric.h"

static const float lookahead_time = 0.45f; /* s */
static const float lookahead_min = 8.0f;   /* m */
static const float lookahead_max = 50.0f;  /* m */

pursuit pure_pursuit_begin(const vehicle_motion *motion, const vehicle_cornering *cornering, float speed)
{
    return (pursuit){
        .x = motion->x - controller_table.cg_to_rear * cosf(motion->yaw),
        .y = motion->y - controller_table.cg_to_rear * sinf(motion->yaw),
        .course = motion->yaw - cornering->slip_rear,
        .lookahead = numeric_clamp(lookahead_time * speed, lookahead_min, lookahead_max),
    };
}

float pure_pursuit_towards(const pursuit *rear, const vehicle_cornering *cornering, float x, float y)
{
    const float wheelbase = controller_table.cg_to_front + controller_table.cg_to_rear;
    const float dx = x - rear->x;
    const float dy = y - rear->y;
    const float bearing = numeric_wrap_angle(atan2f(dy, dx) - rear->course);
    const float distance = fmaxf(sqrtf(dx * dx + dy * dy), lookahead_min);
    return atanf(2.0f * wheelbase * sinf(bearing) / distance) + cornering->slip_front - cornering->slip_rear;
}

float pure_pursuit_command(const lateral_state *state)
{
    const pursuit rear = pure_pursuit_begin(&state->predicted.motion, &state->cornering, state->speed);
    path_point target;
    path_at(state->plan, state->path.foot.s - controller_table.cg_to_rear + rear.lookahead, &target);
    return pure_pursuit_towards(&rear, &state->cornering, target.x, target.y);
}
