#include "thermal.h"

#include <math.h>

#include "numeric.h"

static const double thermostat = 75.0;                    /* degC, opens above */
static const double oil_full_speed = 300.0;               /* rad/s, relief valve opens */
static const double transmission_pressure_top = 300000.0; /* Pa */
static const double transmission_full_speed = 60.0;       /* rad/s of the axle */
static const double pressure_time = 0.15;                 /* s */
static const double fuel_pressure_time = 0.3;             /* s */
static const double battery_time = 0.2;                   /* s */
static const double cranking_drop = 2.2;                  /* V */
static const double tyre_heat_share = 0.5;                /* of the slip loss; the rest stays on the road */
static const double tyre_wind_cooling = 0.05;             /* growth of cooling per m/s */
static const double absolute_zero = -273.15;              /* degC */

void thermal_start(struct thermal_state *state, const struct plant_vars *p)
{
    state->coolant = p->coolant_temperature0;
    state->oil = p->oil_temperature0;
    state->transmission = p->transmission_temperature0;
    for (int i = 0; i < WHEELS; ++i) {
        state->tyre[i] = p->tyre_temperature0;
    }
    state->fuel_pressure = 0.0;
    state->oil_pressure = 0.0;
    state->transmission_pressure = 0.0;
    state->battery = p->battery_voltage_rest;
}

void thermal_step(struct thermal_state *state, const struct plant_vars *p, const struct thermal_input *in, double dt)
{
    const double ambient = p->ambient_temperature;
    const double power = fmax(in->engine_power, 0.0);
    const double hot = in->running != 0 ? fmax(thermostat, ambient) : ambient;
    state->coolant = lag_step(state->coolant, hot + p->coolant_heat_gain * power, p->coolant_time_constant, dt);
    state->oil = lag_step(state->oil, hot + p->oil_heat_gain * power, p->oil_time_constant, dt);
    state->transmission = lag_step(state->transmission, ambient + p->transmission_heat_gain * in->driveline_power,
                                   p->transmission_time_constant, dt);
    for (int i = 0; i < WHEELS; ++i) {
        const double cooling = p->tyre_cooling * (1.0 + tyre_wind_cooling * fabs(in->speed));
        const double heat = tyre_heat_share * fmax(in->slip_power[i], 0.0) + in->rolling_power[i];
        state->tyre[i] = lag_step(state->tyre[i], ambient + heat / cooling, p->tyre_heat_capacity / cooling, dt);
    }

    const double oil = p->oil_pressure_max * fmin(in->engine_speed / oil_full_speed, 1.0);
    state->oil_pressure = lag_step(state->oil_pressure, oil, pressure_time, dt);
    const double gearbox = transmission_pressure_top * fmin(fabs(in->axle_speed) / transmission_full_speed, 1.0);
    state->transmission_pressure = lag_step(state->transmission_pressure, gearbox, pressure_time, dt);
    const double fuel = in->ignition != 0 ? p->fuel_pressure_nominal : 0.0;
    state->fuel_pressure = lag_step(state->fuel_pressure, fuel, fuel_pressure_time, dt);
    double volts = in->running != 0 ? p->battery_voltage_charging : p->battery_voltage_rest;
    if (in->cranking != 0) {
        volts -= cranking_drop;
    }
    state->battery = lag_step(state->battery, volts, battery_time, dt);
}

double thermal_tyre_pressure(const struct thermal_state *state, const struct plant_vars *p, enum wheel wheel)
{
    const double cold = wheel < RL ? p->tyre_cold_pressure_front : p->tyre_cold_pressure_rear;
    return cold * (state->tyre[wheel] - absolute_zero) / (p->ambient_temperature - absolute_zero);
}
