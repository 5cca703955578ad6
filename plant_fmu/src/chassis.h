/* Rigid body on the road: wheel loads, planar motion on a banked road, energy account. */
#ifndef RACELOOP_PLANT_CHASSIS_H
#define RACELOOP_PLANT_CHASSIS_H

#include "variables.h"

struct chassis_state {
    double x; /**< plan, m */
    double y;
    double z;   /**< gained on the grade, m */
    double yaw; /**< plan heading, rad, (-pi, pi] */
    double vx;  /**< in the road plane, m/s */
    double vy;
    double yaw_rate; /**< about the road normal, rad/s */
    double load_fx;  /**< lagged specific forces that set load transfer, roll and pitch, m/s2 */
    double load_fy;
    double fx; /**< specific force of the last step, m/s2 */
    double fy;
    double fz;
    double ax; /**< acceleration of the last step, m/s2 */
    double ay;
    double distance; /**< m */
};

struct energy_account {
    double kinetic_start; /**< J */
    double engine;
    double gravity;
    double aero;
    double tyre;
    double wheel_friction;
    double clutch;
    double tyre_power[4]; /**< slip loss of the last step, W */
};

/** Road under the car, already limited to what the model takes. */
struct road {
    double sin_bank;
    double cos_bank;
    double sin_grade;
    double cos_grade;
    double friction[4]; /**< under each wheel */
};

/** Speeds of the wheel centres along and across each wheel, m/s. */
struct wheel_motion {
    double along[4];
    double across[4];
};

/** Body at the start pose with load transfer settled. */
void chassis_start(struct chassis_state *state, const struct plant_vars *p, const struct road *road);

/** Normal loads of the four wheels, N, >= 0. */
void chassis_wheel_loads(const struct chassis_state *state, const struct plant_vars *p, const struct road *road,
                         double load[4]);

/** Wheel centre speeds for body speeds vx, vy, yaw_rate and road-wheel angle given by its sine and
 * cosine. */
void chassis_wheel_motion(const struct plant_vars *p, double vx, double vy, double yaw_rate, double sin_steer,
                          double cos_steer, struct wheel_motion *motion);

/** One inner step. `tyre_x`, `tyre_y` are wheel-frame forces, `wheel_mid` the mean wheel speeds of
 * the step; adds to the energy account. */
void chassis_step(struct chassis_state *state, struct energy_account *energy, const struct plant_vars *p,
                  const struct road *road, double sin_steer, double cos_steer, const double tyre_x[4],
                  const double tyre_y[4], const double wheel_mid[4]);

#endif
