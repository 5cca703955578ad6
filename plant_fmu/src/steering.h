/* Steering actuator: dead time, second-order lag, rate and angle limits, all at the motor. */
#ifndef RACELOOP_PLANT_STEERING_H
#define RACELOOP_PLANT_STEERING_H

#include "delay.h"
#include "variables.h"

struct steering_state {
    struct delay_line delay;
    double angle; /**< motor, rad */
    double rate;  /**< motor, rad/s */
};

/** Motor at rest at angle zero. */
void steering_start(struct steering_state *state);

/** One inner step towards `demand` (motor rad, finite). */
void steering_step(struct steering_state *state, const struct plant_vars *p, double demand);

/** Mean angle of the front road wheels, rad, positive left. */
double steering_road_angle(const struct steering_state *state, const struct plant_vars *p);

#endif
