#include "obc/pure_pursuit.h"

#include <math.h>

#include "obc/numeric.h"

static const float lookahead_time = 0.45f; /* s */
static const float lookahead_min = 8.0f;   /* m */
static const float lookahead_max = 50.0f;  /* m */

float pure_pursuit_command(const lateral_state *state)
{
    const vehicle_motion *motion = &state->predicted.motion;
    const float wheelbase = controller_table.cg_to_front + controller_table.cg_to_rear;
    const float rear_x = motion->x - controller_table.cg_to_rear * cosf(motion->yaw);
    const float rear_y = motion->y - controller_table.cg_to_rear * sinf(motion->yaw);
    const float lookahead = numeric_clamp(lookahead_time * state->speed, lookahead_min, lookahead_max);
    path_point target;
    path_at(state->plan, state->path.foot.s - controller_table.cg_to_rear + lookahead, &target);

    /* The rear axle moves along the car's heading less its slip angle. */
    const float course = motion->yaw - state->cornering.slip_rear;
    const float bearing = numeric_wrap_angle(atan2f(target.y - rear_y, target.x - rear_x) - course);
    const float dx = target.x - rear_x;
    const float dy = target.y - rear_y;
    const float distance = fmaxf(sqrtf(dx * dx + dy * dy), lookahead_min);
    return atanf(2.0f * wheelbase * sinf(bearing) / distance) + state->cornering.slip_front -
           state->cornering.slip_rear;
}
