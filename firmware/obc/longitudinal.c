#include "obc/longitudinal.h"

#include <math.h>

#include "obc/controller_tables.h"
#include "obc/engine_map.h"
#include "obc/numeric.h"

static const float period = 0.01f; /* s */

static const float proportional_gain = 1.2f; /* 1/s */
static const float integral_gain = 0.25f;    /* 1/s2 */
static const float derivative_gain = 0.1f;   /* of the difference of accelerations */
static const float integral_max = 2.0f;      /* m/s2 */

static const float integrated_max = 1.0f; /* m/s: a larger error is one the engine or the tyres cannot follow */

static const float reference_lead_max = 2.0f; /* m/s: the reference does not run away from a car that cannot follow */
static const float grip_used = 1.2f;          /* tyre force over wheel load that control asks for at most */
static const float switch_band = 150.0f;      /* N around the force of the closed throttle */
static const float throttle_rise = 1.5f;      /* 1/s */

/* Standstill */
static const float stand_speed = 0.3f;     /* m/s: below this with a reference of zero the car is held */
static const float start_speed = 0.5f;     /* m/s: a target or a speed above this is motion, a lower target a stop */
static const float soft_stop_slope = 2.0f; /* 1/s: deceleration allowed per speed at the end of a stop */
static const float soft_stop_least = 0.6f; /* m/s2 */
static const float hold_rise = 1.0e6f;     /* Pa/s */

static const float pressure_max = 6.0e6f; /* Pa */

/* Move the reference towards the target. Returns the acceleration that goes with it. */
static float advance_reference(longitudinal *self, const longitudinal_input *in)
{
    const float up = in->max_acceleration * period;
    const float down = in->max_deceleration * period;
    const float target = in->target_speed > start_speed ? in->target_speed : 0.0f;
    const float step = target - self->reference;
    const float low = fmaxf(in->speed - reference_lead_max, 0.0f);
    const float high = in->speed + reference_lead_max;
    self->reference = numeric_clamp(self->reference + numeric_clamp(step, -down, up), low, high);
    if (step > up) {
        return in->max_acceleration;
    }
    if (step < -down) {
        return -in->max_deceleration;
    }
    return numeric_clamp(in->target_acceleration, -in->max_deceleration, in->max_acceleration);
}

/* Largest drive force that the rear tyres give beside their side force. */
static float traction(const vehicle_cornering *road)
{
    const float grip = grip_used * road->load_rear;
    const float side = road->slip_rear * road->stiffness_rear;
    return sqrtf(fmaxf(grip * grip - side * side, 0.04f * grip * grip));
}

static float resistance(const longitudinal_input *in)
{
    const controller_tables *car = &controller_table;
    return car->drag_factor * in->speed * in->speed + car->rolling_resistance * in->road.load + in->road.drag;
}

/* Force at the driven wheels per N m of the engine, 1/m; 0 in neutral. */
static float lever(uint8_t gear)
{
    return gear < CONTROLLER_GEARS ? controller_table.gear_ratio[gear] / controller_table.driven_radius : 0.0f;
}

/* Force of the closed throttle, N, zero or negative. The automatic clutch frees the wheels from a slow engine. */
static float coasting_force(float engine_speed, float per_torque)
{
    if (engine_speed < controller_table.clutch_engage_speed) {
        return 0.0f;
    }
    return per_torque * fminf(engine_map_torque(engine_speed, 0.0f), 0.0f);
}

static void stand(longitudinal *self, longitudinal_output *out)
{
    self->integral = 0.0f;
    self->reference = 0.0f;
    self->throttle = 0.0f;
    self->braking = true;
    if (self->pressure < LONGITUDINAL_HOLD_PRESSURE_PA) {
        self->pressure = fminf(self->pressure + hold_rise * period, LONGITUDINAL_HOLD_PRESSURE_PA);
    }
    out->throttle = 0.0f;
    out->brake_pressure = self->pressure;
}

/* Share the force (N, at the wheels) between throttle and brake. Returns false when the command is at its limit in
 * the direction of the force. */
static bool apply(longitudinal *self, const longitudinal_input *in, float force)
{
    const float per_torque = lever(in->gear);
    const float coasting = coasting_force(in->engine_speed, per_torque);
    if (self->braking ? force > coasting + switch_band : force < coasting - switch_band) {
        self->braking = !self->braking;
    }
    if (self->braking) {
        const float wanted = fmaxf(coasting - force, 0.0f);
        const float most = fminf(grip_used * in->road.load, pressure_max * controller_table.brake_gain);
        self->throttle = 0.0f;
        self->pressure = fminf(wanted, most) / controller_table.brake_gain;
        return wanted < most;
    }
    const float most = traction(&in->road);
    const float torque =
        per_torque > 0.0f ? fminf(force, most) / (per_torque * controller_table.driveline_efficiency) : 0.0f;
    const float wanted = per_torque > 0.0f ? engine_map_throttle(in->engine_speed, torque) : 0.0f;
    self->pressure = 0.0f;
    self->throttle = fminf(wanted, self->throttle + throttle_rise * period);
    return force < most && wanted < 1.0f && wanted <= self->throttle;
}

void longitudinal_step(longitudinal *self, const longitudinal_input *in, longitudinal_output *out)
{
    if (in->target_speed > start_speed || in->speed > start_speed) {
        self->moving = true;
    }
    const float planned = advance_reference(self, in);
    const float error = self->reference - in->speed;
    out->speed_error = error;
    if (self->reference <= 0.0f && in->speed < stand_speed) {
        self->moving = false;
    }
    if (!self->moving) {
        stand(self, out);
        return;
    }

    float acceleration =
        planned + proportional_gain * error + self->integral + derivative_gain * (planned - in->acceleration);
    if (in->target_speed <= start_speed) {
        acceleration = fmaxf(acceleration, -fmaxf(soft_stop_slope * in->speed, soft_stop_least));
    }
    const uint8_t gear = in->gear < CONTROLLER_GEARS ? in->gear : 0u;
    const float force = controller_table.effective_mass[gear] * acceleration + resistance(in);
    const bool free = apply(self, in, force);
    if (!in->shifting && fabsf(error) < integrated_max && (free || (error > 0.0f) == self->braking)) {
        self->integral = numeric_clamp(self->integral + integral_gain * error * period, -integral_max, integral_max);
    }
    out->throttle = self->throttle;
    out->brake_pressure = self->pressure;
}

void longitudinal_hold(longitudinal *self, float speed, longitudinal_output *out)
{
    self->reference = fmaxf(speed, 0.0f);
    self->integral = 0.0f;
    self->throttle = 0.0f;
    self->pressure = LONGITUDINAL_HOLD_PRESSURE_PA;
    self->braking = true;
    self->moving = speed > stand_speed;
    out->throttle = 0.0f;
    out->brake_pressure = self->pressure;
    out->speed_error = 0.0f;
}
