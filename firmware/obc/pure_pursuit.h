/* Second backup: pure pursuit (R. C. Coulter, CMU-RI-TR-92-01) from the rear axle, with the slip angles of steady
 * cornering added. Stateless. Its parts serve any path in any plane frame. */
#ifndef RACELOOP_OBC_PURE_PURSUIT_H
#define RACELOOP_OBC_PURE_PURSUIT_H

#include "obc/lateral.h"

/* Where a pursuit begins: the rear axle. */
typedef struct pursuit {
    float x; /* m */
    float y;
    float course;    /* rad, in which it moves: the car's heading less the axle's slip angle */
    float lookahead; /* m, to the target */
} pursuit;

/* The rear axle of a car that corners, and the look-ahead at a speed in m/s. */
pursuit pure_pursuit_begin(const vehicle_motion *motion, const vehicle_cornering *cornering, float speed);

/* Road wheel angle that leads the rear axle on an arc to a target, rad, not limited. x, y: m, in the axle's frame. */
float pure_pursuit_towards(const pursuit *rear, const vehicle_cornering *cornering, float x, float y);

/* Road wheel angle wished, rad, not limited. */
float pure_pursuit_command(const lateral_state *state);

#endif
