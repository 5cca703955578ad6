/* Slow states that a driver's display shows: temperatures, pressures, battery. They follow the
 * machine but do not act back on it. */
#ifndef RACELOOP_PLANT_THERMAL_H
#define RACELOOP_PLANT_THERMAL_H

#include "engine.h"
#include "variables.h"

struct thermal_state {
    double coolant; /**< degC */
    double oil;
    double transmission;
    double tyre[4];
    double fuel_pressure; /**< Pa */
    double oil_pressure;
    double transmission_pressure;
    double battery; /**< V */
};

struct thermal_input {
    double engine_power;     /**< of combustion, W */
    double engine_speed;     /**< rad/s */
    double driveline_power;  /**< lost in clutch and gearbox, W */
    double axle_speed;       /**< rad/s */
    double speed;            /**< m/s */
    double slip_power[4];    /**< lost in the slip of each tyre, W */
    double rolling_power[4]; /**< lost in the rolling of each tyre, W */
    int32_t ignition;
    int32_t cranking;
    int32_t running;
};

/** Start temperatures from the parameters, no pressure. */
void thermal_start(struct thermal_state *state, const struct plant_vars *p);

/** One step of `dt` seconds (0 < dt <= 0.1). */
void thermal_step(struct thermal_state *state, const struct plant_vars *p, const struct thermal_input *in, double dt);

/** Absolute pressure of a tyre, Pa: an ideal gas of constant volume, filled at ambient temperature. */
double thermal_tyre_pressure(const struct thermal_state *state, const struct plant_vars *p, enum wheel wheel);

#endif
