/* Where the car will be when a command given now first takes effect.
 *
 * The steering chain has a dead time of CONTROLLER_DEAD_TICKS control periods. The commands inside it are known, so
 * the state at its end is predicted with the models of steering actuator and car, and the controllers work on that
 * state: the dead time leaves the loop (Smith's idea; here as finite-horizon state prediction).
 */
#ifndef RACELOOP_OBC_MOTION_PREDICTOR_H
#define RACELOOP_OBC_MOTION_PREDICTOR_H

#include "obc/controller_tables.h"
#include "obc/vehicle_model.h"

/* Zero it to start: straight wheels. */
typedef struct motion_predictor {
    float commands[CONTROLLER_DEAD_TICKS]; /* rad, commands on their way, oldest first */
    float angle;                           /* rad, observed road wheel angle */
    float rate;                            /* rad/s */
} motion_predictor;

/* State at the end of the dead time. */
typedef struct motion_prediction {
    vehicle_motion motion;
    float steer;      /* rad, road wheel angle */
    float steer_rate; /* rad/s */
} motion_prediction;

/* Predict from the car's present motion. tyres, speed, bank: as for vehicle_motion_step, held over the dead time. */
void motion_predictor_predict(const motion_predictor *self, const vehicle_motion *now, const vehicle_cornering *tyres,
                              float speed, float bank, motion_prediction *out);

/* Close the period: the oldest command reaches the actuator, `command` (rad) enters the dead time.
 * measured: rad, road wheel angle reported, which pulls the observed angle; not finite: not used. */
void motion_predictor_update(motion_predictor *self, float command, float measured);

#endif
