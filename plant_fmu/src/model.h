/* The seam between the vehicle model and the FMI wrappers.
 *
 * A wrapper knows only this header: it allocates a struct plant, sets and gets variables by value
 * reference, starts and steps. The whole state of an instance is inside struct plant, which holds no
 * pointer, so copying its bytes saves and restores it exactly. No function here allocates, blocks,
 * does I/O or reads a clock. Instances are independent; one instance is for one thread at a time.
 */
#ifndef RACELOOP_PLANT_MODEL_H
#define RACELOOP_PLANT_MODEL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "brakes.h"
#include "chassis.h"
#include "driveline.h"
#include "engine.h"
#include "steering.h"
#include "thermal.h"
#include "tyre.h"
#include "variables.h"

/** Everything one instance holds. Zeroed bytes, then plant_reset(), make it usable. */
struct plant {
    struct plant_vars v; /**< parameters, inputs and outputs, by name */
    int64_t steps;       /**< inner steps since the start: time without rounding */
    double start_time;   /**< simulation time at step 0, s */
    struct steering_state steering;
    struct brakes_state brakes;
    struct engine_state engine;
    struct driveline_state driveline;
    struct tyre_state tyre[WHEELS];
    double wheel_speed[WHEELS]; /**< rad/s */
    struct chassis_state chassis;
    struct thermal_state thermal;
    struct energy_account energy;
};

/** Why a value was refused. */
enum plant_set_result {
    PLANT_SET_OK = 0,
    PLANT_SET_NOT_FINITE,  /**< NaN or infinite */
    PLANT_SET_OUT_OF_RANGE /**< a parameter outside the range in the variable table */
};

/** Restore every variable to its table start value and the state to standstill. O(1 KiB) work. */
void plant_reset(struct plant *plant);

/** Compute the start state and the outputs at `start_time` (s, finite) from the parameters.
 * May be called again as long as no step was taken. */
void plant_start(struct plant *plant, double start_time);

/** Advance by `inner_steps` steps of PLANT_INNER_STEP_S with constant inputs. Precondition:
 * plant_start() was called. Bounded work: about 1 us per inner step on a desktop core. */
void plant_advance(struct plant *plant, int64_t inner_steps);

/** Simulation time in seconds. */
double plant_time(const struct plant *plant);

/** Read a variable. Precondition: vr < PLANT_VARIABLE_COUNT and the type fits. */
double plant_get_real(const struct plant *plant, uint32_t vr);
int32_t plant_get_int(const struct plant *plant, uint32_t vr);

/** Write a variable. Precondition as for reading. Inputs take any finite value and saturate inside
 * the model; parameters outside their range are refused and keep their value. */
enum plant_set_result plant_set_real(struct plant *plant, uint32_t vr, double value);
enum plant_set_result plant_set_int(struct plant *plant, uint32_t vr, int32_t value);

#endif
