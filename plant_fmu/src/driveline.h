/* Gearbox, automatic clutch, limited-slip differential, and the rotation of engine and wheels. */
#ifndef RACELOOP_PLANT_DRIVELINE_H
#define RACELOOP_PLANT_DRIVELINE_H

#include <stdint.h>

#include "engine.h"
#include "variables.h"

/** Codes of the output gear_shift_status. */
enum shift_status { SHIFT_UNINITIALISED = 0, SHIFT_READY = 1, SHIFT_LOCKED_OUT = 2, SHIFT_UP = 3, SHIFT_DOWN = 4 };

struct driveline_state {
    int32_t gear;         /**< engaged, or the one being left during a shift */
    int32_t next_gear;    /**< target of the running shift */
    int32_t status;       /**< enum shift_status */
    double shift_left;    /**< s until the shift ends, 0 when none runs */
    double clutch_ramp;   /**< 0..1, closing of the clutch after a shift */
    int32_t matching;     /**< 1 while a shift waits for the engine to fall in step with the new gear */
    double engagement;    /**< 0..1, share of the clutch capacity in this step */
    double clutch_torque; /**< in the last step, N m at the crankshaft */
    double wheel_torque;  /**< in the last step, N m at both driven wheels */
    double loss_torque;   /**< of the driveline in the last step, N m at both wheels */
};

/** Torques on one inner step of all rotating parts. */
struct rotation_input {
    double tyre_force_x[4];   /**< N */
    double wheel_friction[4]; /**< bound of brake and rolling torque, N m, >= 0 */
    double engine_torque;     /**< N m */
};

/** Work done in the step by what is inside the driveline, J, losses positive. */
struct rotation_work {
    double engine;         /**< put in by the engine */
    double wheel_friction; /**< brakes, rolling, driveline losses */
    double clutch;         /**< clutch and differential slip */
    double wheel_mid[4];   /**< mean wheel speeds of the step, rad/s */
};

/** Ratio engine speed over wheel speed of `gear`; 0 for neutral or an unknown gear. */
double driveline_ratio(const struct plant_vars *p, int32_t gear);

/** Standing in `gear` with the clutch ready. */
void driveline_start(struct driveline_state *state, int32_t gear);

/** One inner step of the shift logic. `demand` saturates to 0..6. Writes what the engine is asked
 * to do into `command`: between two gears it is brought to the speed of the new one, and until it is
 * there the clutch closes slowly. Shifts go one gear at a time and need `powered`; a downshift that
 * would drive the engine beyond its limit is locked out while it is demanded. */
void driveline_shift_step(struct driveline_state *state, const struct plant_vars *p, int32_t demand, int32_t powered,
                          const double wheel_speed[4], double engine_speed, struct engine_command *command);

/** One inner step of the speeds of the four wheels and the engine. Friction, clutch and differential
 * are exact stick-slip elements: what sticks has zero relative speed, what slips has its full
 * torque. */
void driveline_rotate(struct driveline_state *state, const struct plant_vars *p, const struct rotation_input *in,
                      double wheel_speed[4], double *engine_speed, struct rotation_work *work);

#endif
