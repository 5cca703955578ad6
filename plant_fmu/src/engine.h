/* Turbocharged engine: torque map, throttle actuator, idle and rev limiter, starter. */
#ifndef RACELOOP_PLANT_ENGINE_H
#define RACELOOP_PLANT_ENGINE_H

#include <stdint.h>

#include "variables.h"

/** What the gearbox asks of the engine while it shifts. */
enum engine_request { ENGINE_FOLLOW_THROTTLE, ENGINE_MATCH_SPEED };

struct engine_state {
    double speed;         /**< rad/s, >= 0 */
    double throttle;      /**< actual opening, 0..1 */
    double boost_torque;  /**< indicated torque behind the rise limit, N m */
    double idle_integral; /**< of the idle controller, N m */
    double torque;        /**< at the crankshaft in this step, N m */
    int32_t running;      /**< 0 or 1 */
};

struct engine_command {
    double throttle; /**< 0..1 */
    int32_t ignition;
    int32_t starter;
    enum engine_request request;
    double match_speed; /**< rad/s, for ENGINE_MATCH_SPEED */
};

/** Full-load torque at `speed` (rad/s), N m, rev limiter not included. */
double engine_full_torque(const struct plant_vars *p, double speed);

/** Share of the full-load torque at `throttle` (0..1) and `speed` (rad/s). */
double engine_throttle_share(const struct plant_vars *p, double throttle, double speed);

/** Drag torque at `speed` (rad/s) with the throttle shut, N m, >= 0. */
double engine_drag(const struct plant_vars *p, double speed);

/** Engine off, or running at `speed` (rad/s). */
void engine_start(struct engine_state *state, int32_t running, double speed);

/** One inner step of throttle, combustion and starter. Sets state->torque and state->running; the
 * driveline integrates the speed. */
void engine_step(struct engine_state *state, const struct plant_vars *p, const struct engine_command *command);

#endif
