/* Primary lateral controller: linear quadratic regulator on the error model of the bicycle (R. Rajamani, Vehicle
 * Dynamics and Control, ch. 2), with gains indexed by speed.
 *
 * States: e_y, de_y/dt, e_psi, de_psi/dt of the predicted car, steering angle and rate relative to the feed-forward,
 * integral of e_y. Errors are taken from steady cornering: its sideslip is not a heading error, its yaw rate no yaw
 * rate error. So feed-forward carries curvature and bank, and what the model does not know (the oval set-up) is left
 * to the integral.
 */
#ifndef RACELOOP_OBC_LATERAL_LQR_H
#define RACELOOP_OBC_LATERAL_LQR_H

#include <stdbool.h>

#include "obc/lateral.h"

/* Zero it to start. */
typedef struct lateral_lqr {
    float integral; /* rad, steering angle that the integral action has found */
} lateral_lqr;

/* Road wheel angle wished, rad, not limited. */
float lateral_lqr_command(const lateral_lqr *self, const lateral_state *state);

/* Integrate one period of the error. Call it only while this controller's command leaves unlimited. */
void lateral_lqr_integrate(lateral_lqr *self, const lateral_state *state);

#endif
