/* One tyre: Magic Formula with load dependence and combined slip, on an elastic contact patch.
 *
 * The contact patch deflects like a spring that slides off over the relaxation length. At speed this
 * is the usual first-order lag of slip; at standstill it is a spring that holds the car, so slip is
 * never divided by a speed and the car truly stands still. */
#ifndef RACELOOP_PLANT_TYRE_H
#define RACELOOP_PLANT_TYRE_H

#include "variables.h"

struct tyre_state {
    double deflection_x; /**< m */
    double deflection_y; /**< m */
};

struct tyre_input {
    double load;            /**< N, >= 0 */
    double speed_x;         /**< of the wheel centre along the wheel, m/s */
    double speed_y;         /**< of the wheel centre to the left of the wheel, m/s */
    double rim_speed;       /**< wheel speed times radius, m/s */
    double friction;        /**< road friction, 1 is nominal */
    double stiffness_scale; /**< of cornering stiffness */
    double slip_offset;     /**< lateral slip that camber adds, rad, positive pushes left */
};

struct tyre_force {
    double x;      /**< N, along the wheel */
    double y;      /**< N, to the left of the wheel */
    double slip_x; /**< lagged slips */
    double slip_y;
};

/** Cornering stiffness at `load` (N, >= 0), N/rad. */
double tyre_cornering_stiffness(const struct plant_vars *p, double load);

/** One inner step: update the deflection and return the force on the wheel. */
struct tyre_force tyre_step(struct tyre_state *state, const struct plant_vars *p, const struct tyre_input *in);

#endif
