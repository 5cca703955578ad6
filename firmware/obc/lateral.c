#include "obc/lateral.h"

#include "obc/numeric.h"

void lateral_state_make(lateral_state *self, const trajectory *plan, float speed, const motion_prediction *predicted)
{
    path_point ahead;
    vehicle_cornering cornering_ahead;
    self->plan = plan;
    self->speed = speed;
    self->predicted = *predicted;
    path_project(plan, predicted->motion.x, predicted->motion.y, &self->path);
    const path_point *foot = &self->path.foot;
    vehicle_steady_cornering(speed, foot->curvature, foot->bank, &self->cornering);
    path_at(plan, foot->s + speed * controller_table.steer_lag, &ahead);
    vehicle_steady_cornering(speed, ahead.curvature, ahead.bank, &cornering_ahead);
    self->steer_ahead = cornering_ahead.steer;
    self->heading_error = numeric_wrap_angle(predicted->motion.yaw - foot->yaw);
}
