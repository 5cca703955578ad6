/* Brake hydraulics: one command, two line pressures, four brake torques. */
#ifndef RACELOOP_PLANT_BRAKES_H
#define RACELOOP_PLANT_BRAKES_H

#include "delay.h"
#include "variables.h"

struct brakes_state {
    struct delay_line delay;
    double pressure; /**< of the stronger axle, Pa */
};

/** No pressure. */
void brakes_start(struct brakes_state *state);

/** One inner step towards `demand` (Pa, finite; limited to 0..brake_pressure_max). */
void brakes_step(struct brakes_state *state, const struct plant_vars *p, double demand);

/** Line pressure of an axle, Pa. The axle with the larger share gets the commanded pressure, the
 * other one less, so that a command of brake_pressure_max is never exceeded on any line. */
double brakes_front_pressure(const struct brakes_state *state, const struct plant_vars *p);
double brakes_rear_pressure(const struct brakes_state *state, const struct plant_vars *p);

#endif
