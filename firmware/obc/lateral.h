/* What every lateral controller works on: the car at the end of the steering's dead time, beside the path. */
#ifndef RACELOOP_OBC_LATERAL_H
#define RACELOOP_OBC_LATERAL_H

#include "obc/motion_predictor.h"
#include "obc/path_projection.h"

typedef struct lateral_state {
    const trajectory *plan;      /* not null */
    float speed;                 /* m/s, >= 0 */
    motion_prediction predicted; /* car and steering when a command of now takes effect */
    path_projection path;        /* of the predicted position */
    vehicle_cornering cornering; /* steady state on the path at its foot */
    float steer_ahead;           /* rad, steady-state angle one actuator lag further along the path */
    float heading_error;         /* rad, predicted yaw minus the path's */
} lateral_state;

/* Fill in the path side of a state.
 * plan: count >= 2. speed: m/s, >= 0. predicted: finite. */
void lateral_state_make(lateral_state *self, const trajectory *plan, float speed, const motion_prediction *predicted);

#endif
