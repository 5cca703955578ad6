#include "model.h"

#include <math.h>
#include <string.h>

#include "numeric.h"

/* Slow states are stepped once per this many inner steps. */
#define THERMAL_DIVIDER 10

static const double road_angle_limit = 1.0; /* rad; tan stays finite */
static const double slip_angle_min_speed = 0.5;

static void *variable_at(struct plant_vars *vars, uint32_t vr)
{
    return (char *)vars + plant_variables[vr].offset;
}

static const void *variable_in(const struct plant_vars *vars, uint32_t vr)
{
    return (const char *)vars + plant_variables[vr].offset;
}

double plant_get_real(const struct plant *plant, uint32_t vr)
{
    return *(const double *)variable_in(&plant->v, vr);
}

int32_t plant_get_int(const struct plant *plant, uint32_t vr)
{
    return *(const int32_t *)variable_in(&plant->v, vr);
}

static bool outside_range(uint32_t vr, double value)
{
    const struct plant_variable *info = &plant_variables[vr];
    return value < info->min || value > info->max;
}

enum plant_set_result plant_set_real(struct plant *plant, uint32_t vr, double value)
{
    if (!isfinite(value)) {
        return PLANT_SET_NOT_FINITE;
    }
    if (outside_range(vr, value)) {
        return PLANT_SET_OUT_OF_RANGE;
    }
    *(double *)variable_at(&plant->v, vr) = value;
    return PLANT_SET_OK;
}

enum plant_set_result plant_set_int(struct plant *plant, uint32_t vr, int32_t value)
{
    if (outside_range(vr, (double)value)) {
        return PLANT_SET_OUT_OF_RANGE;
    }
    const bool boolean = plant_variables[vr].type == PLANT_BOOL;
    *(int32_t *)variable_at(&plant->v, vr) = boolean ? (value != 0 ? 1 : 0) : value;
    return PLANT_SET_OK;
}

void plant_reset(struct plant *plant)
{
    memset(plant, 0, sizeof *plant);
    for (uint32_t vr = 0; vr < PLANT_VARIABLE_COUNT; ++vr) {
        const struct plant_variable *info = &plant_variables[vr];
        if (info->type == PLANT_REAL) {
            *(double *)variable_at(&plant->v, vr) = info->start;
        } else {
            *(int32_t *)variable_at(&plant->v, vr) = (int32_t)info->start;
        }
    }
    plant_start(plant, 0.0);
}

double plant_time(const struct plant *plant)
{
    return plant->start_time + (double)plant->steps * PLANT_INNER_STEP_S;
}

static struct road road_from_inputs(const struct plant_vars *p)
{
    const double bank = clamp(p->road_bank, -road_angle_limit, road_angle_limit);
    const double grade = clamp(p->road_grade, -road_angle_limit, road_angle_limit);
    const double grip[WHEELS] = {
        [FL] = p->wheel_grip_fl, [FR] = p->wheel_grip_fr, [RL] = p->wheel_grip_rl, [RR] = p->wheel_grip_rr};
    struct road road = {.sin_bank = sin(bank), .cos_bank = cos(bank), .sin_grade = sin(grade), .cos_grade = cos(grade)};
    for (int i = 0; i < WHEELS; ++i) {
        road.friction[i] = clamp(p->road_friction * grip[i], 0.01, 2.0);
    }
    return road;
}

static double kinetic_energy(const struct plant *plant)
{
    const struct plant_vars *p = &plant->v;
    const struct chassis_state *c = &plant->chassis;
    const double *w = plant->wheel_speed;
    return 0.5 * (p->mass * (c->vx * c->vx + c->vy * c->vy) + p->yaw_inertia * c->yaw_rate * c->yaw_rate +
                  p->wheel_inertia_front * (w[FL] * w[FL] + w[FR] * w[FR]) +
                  p->wheel_inertia_rear * (w[RL] * w[RL] + w[RR] * w[RR]) +
                  p->engine_inertia * plant->engine.speed * plant->engine.speed);
}

static void write_motion_outputs(struct plant *plant)
{
    struct plant_vars *v = &plant->v;
    const struct chassis_state *c = &plant->chassis;
    v->time = plant_time(plant);
    v->x = c->x;
    v->y = c->y;
    v->z = c->z;
    v->yaw = c->yaw;
    v->vx = c->vx;
    v->vy = c->vy;
    v->yaw_rate = c->yaw_rate;
    /* Centre of roll and pitch on the road: the moment is the specific force at the CG height. */
    v->body_roll = v->mass * v->cg_height * c->load_fy / v->roll_stiffness;
    v->body_pitch = -v->mass * v->cg_height * c->load_fx / v->pitch_stiffness;
    v->roll = v->body_roll - clamp(v->road_bank, -road_angle_limit, road_angle_limit);
    v->pitch = v->body_pitch - clamp(v->road_grade, -road_angle_limit, road_angle_limit);
    v->ax = c->ax;
    v->ay = c->ay;
    v->specific_force_x = c->fx;
    v->specific_force_y = c->fy;
    v->specific_force_z = c->fz;
    v->slip_angle = fabs(c->vx) > slip_angle_min_speed ? atan(c->vy / fabs(c->vx)) : 0.0;
    v->distance = c->distance;
}

static void write_wheel_outputs(struct plant *plant, const double load[4], const struct tyre_force force[4])
{
    struct plant_vars *v = &plant->v;
    v->wheel_speed_fl = plant->wheel_speed[FL];
    v->wheel_speed_fr = plant->wheel_speed[FR];
    v->wheel_speed_rl = plant->wheel_speed[RL];
    v->wheel_speed_rr = plant->wheel_speed[RR];
    v->wheel_load_fl = load[FL];
    v->wheel_load_fr = load[FR];
    v->wheel_load_rl = load[RL];
    v->wheel_load_rr = load[RR];
    v->tyre_force_x_fl = force[FL].x;
    v->tyre_force_x_fr = force[FR].x;
    v->tyre_force_x_rl = force[RL].x;
    v->tyre_force_x_rr = force[RR].x;
    v->tyre_force_y_fl = force[FL].y;
    v->tyre_force_y_fr = force[FR].y;
    v->tyre_force_y_rl = force[RL].y;
    v->tyre_force_y_rr = force[RR].y;
    v->tyre_slip_x_fl = force[FL].slip_x;
    v->tyre_slip_x_fr = force[FR].slip_x;
    v->tyre_slip_x_rl = force[RL].slip_x;
    v->tyre_slip_x_rr = force[RR].slip_x;
    v->tyre_slip_y_fl = force[FL].slip_y;
    v->tyre_slip_y_fr = force[FR].slip_y;
    v->tyre_slip_y_rl = force[RL].slip_y;
    v->tyre_slip_y_rr = force[RR].slip_y;
    v->tyre_temperature_fl = plant->thermal.tyre[FL];
    v->tyre_temperature_fr = plant->thermal.tyre[FR];
    v->tyre_temperature_rl = plant->thermal.tyre[RL];
    v->tyre_temperature_rr = plant->thermal.tyre[RR];
    v->tyre_pressure_fl = thermal_tyre_pressure(&plant->thermal, v, FL);
    v->tyre_pressure_fr = thermal_tyre_pressure(&plant->thermal, v, FR);
    v->tyre_pressure_rl = thermal_tyre_pressure(&plant->thermal, v, RL);
    v->tyre_pressure_rr = thermal_tyre_pressure(&plant->thermal, v, RR);
}

static void write_machine_outputs(struct plant *plant)
{
    struct plant_vars *v = &plant->v;
    v->engine_speed = plant->engine.speed;
    v->engine_torque = plant->engine.torque;
    v->wheel_torque = plant->driveline.wheel_torque;
    v->throttle_position = plant->engine.throttle;
    v->gear = plant->driveline.gear;
    v->gear_shift_status = plant->driveline.status;
    v->engine_running = plant->engine.running;
    v->clutch_engagement = plant->driveline.engagement;
    v->brake_pressure_front = brakes_front_pressure(&plant->brakes, v);
    v->brake_pressure_rear = brakes_rear_pressure(&plant->brakes, v);
    v->steer_motor_angle = plant->steering.angle;
    v->steer_wheel_angle = steering_road_angle(&plant->steering, v);
    v->fuel_pressure = plant->thermal.fuel_pressure;
    v->oil_pressure = plant->thermal.oil_pressure;
    v->transmission_pressure = plant->thermal.transmission_pressure;
    v->coolant_temperature = plant->thermal.coolant;
    v->oil_temperature = plant->thermal.oil;
    v->transmission_temperature = plant->thermal.transmission;
    v->battery_voltage = plant->thermal.battery;
}

static void write_energy_outputs(struct plant *plant)
{
    struct plant_vars *v = &plant->v;
    const struct energy_account *e = &plant->energy;
    v->energy_kinetic = kinetic_energy(plant);
    v->energy_engine = e->engine;
    v->energy_gravity = e->gravity;
    v->energy_aero = e->aero;
    v->energy_tyre = e->tyre;
    v->energy_wheel_friction = e->wheel_friction;
    v->energy_clutch = e->clutch;
    v->energy_error = e->engine + e->gravity - e->aero - e->tyre - e->wheel_friction - e->clutch -
                      (v->energy_kinetic - e->kinetic_start);
}

static void write_outputs(struct plant *plant, const double load[4], const struct tyre_force force[4])
{
    write_motion_outputs(plant);
    write_wheel_outputs(plant, load, force);
    write_machine_outputs(plant);
    write_energy_outputs(plant);
}

void plant_start(struct plant *plant, double start_time)
{
    const struct plant_vars *p = &plant->v;
    const struct road road = road_from_inputs(p);
    plant->steps = 0;
    plant->start_time = start_time;
    steering_start(&plant->steering);
    brakes_start(&plant->brakes);
    driveline_start(&plant->driveline, p->gear0);
    const double axle_speed = p->v0 / p->tyre_radius_rear;
    const double geared = driveline_ratio(p, p->gear0) * axle_speed;
    engine_start(&plant->engine, p->engine_running0, fmax(geared, p->engine_idle_speed));
    plant->wheel_speed[FL] = p->v0 / p->tyre_radius_front;
    plant->wheel_speed[FR] = plant->wheel_speed[FL];
    plant->wheel_speed[RL] = axle_speed;
    plant->wheel_speed[RR] = axle_speed;
    memset(plant->tyre, 0, sizeof plant->tyre);
    chassis_start(&plant->chassis, p, &road);
    thermal_start(&plant->thermal, p);
    memset(&plant->energy, 0, sizeof plant->energy);
    plant->energy.kinetic_start = kinetic_energy(plant);

    double load[4];
    const struct tyre_force none[4] = {{0.0, 0.0, 0.0, 0.0}};
    chassis_wheel_loads(&plant->chassis, p, &road, load);
    write_outputs(plant, load, none);
}

/* Bound of the torque that resists the rolling of wheel i: brake and rolling resistance. */
static double wheel_friction(const struct plant *plant, int i, double load)
{
    const struct plant_vars *p = &plant->v;
    const double pressure = i < RL ? brakes_front_pressure(&plant->brakes, p) : brakes_rear_pressure(&plant->brakes, p);
    const double radius = i < RL ? p->tyre_radius_front : p->tyre_radius_rear;
    return pressure * p->brake_torque_gain + p->rolling_resistance * load * radius;
}

static void thermal_update(struct plant *plant, const struct rotation_work *work, const double load[4],
                           int32_t cranking)
{
    const double axle = 0.5 * (plant->wheel_speed[RL] + plant->wheel_speed[RR]);
    struct thermal_input in = {.engine_power = plant->engine.torque * plant->engine.speed,
                               .engine_speed = plant->engine.speed,
                               .driveline_power =
                                   fabs(plant->driveline.loss_torque * axle) + fabs(work->clutch) / PLANT_INNER_STEP_S,
                               .axle_speed = axle,
                               .speed = plant->chassis.vx,
                               .ignition = plant->v.ignition,
                               .cranking = cranking,
                               .running = plant->engine.running};
    for (int i = 0; i < WHEELS; ++i) {
        in.slip_power[i] = plant->energy.tyre_power[i];
        in.rolling_power[i] = plant->v.rolling_resistance * load[i] * fabs(plant->chassis.vx);
    }
    thermal_step(&plant->thermal, &plant->v, &in, THERMAL_DIVIDER * PLANT_INNER_STEP_S);
}

static void inner_step(struct plant *plant, const struct road *road, double load[4], struct tyre_force force[4])
{
    const struct plant_vars *p = &plant->v;
    steering_step(&plant->steering, p, p->steer_motor_demand);
    brakes_step(&plant->brakes, p, p->brake_pressure_demand);

    struct engine_command engine = {
        .throttle = clamp(p->throttle_demand, 0.0, 1.0), .ignition = p->ignition, .starter = p->starter};
    driveline_shift_step(&plant->driveline, p, p->gear_demand, p->ignition, plant->wheel_speed, plant->engine.speed,
                         &engine);
    engine_step(&plant->engine, p, &engine);

    const double steer = steering_road_angle(&plant->steering, p);
    const double sin_steer = sin(steer);
    const double cos_steer = cos(steer);
    struct wheel_motion motion;
    chassis_wheel_motion(p, plant->chassis.vx, plant->chassis.vy, plant->chassis.yaw_rate, sin_steer, cos_steer,
                         &motion);
    chassis_wheel_loads(&plant->chassis, p, road, load);

    struct rotation_input rotation = {.engine_torque = plant->engine.torque};
    double tyre_x[4];
    double tyre_y[4];
    for (int i = 0; i < WHEELS; ++i) {
        const bool front = i < RL;
        const double camber = front ? p->camber_left_front : p->camber_left_rear;
        const struct tyre_input in = {
            .load = load[i],
            .speed_x = motion.along[i],
            .speed_y = motion.across[i],
            .rim_speed = plant->wheel_speed[i] * (front ? p->tyre_radius_front : p->tyre_radius_rear),
            .friction = road->friction[i],
            .stiffness_scale = front ? p->tyre_stiffness_scale_front : p->tyre_stiffness_scale_rear,
            .slip_offset = p->oval_asymmetry * p->camber_slip_gain * camber};
        force[i] = tyre_step(&plant->tyre[i], p, &in);
        tyre_x[i] = force[i].x;
        tyre_y[i] = force[i].y;
        rotation.tyre_force_x[i] = force[i].x;
        rotation.wheel_friction[i] = wheel_friction(plant, i, load[i]);
    }

    struct rotation_work work;
    driveline_rotate(&plant->driveline, p, &rotation, plant->wheel_speed, &plant->engine.speed, &work);
    plant->energy.engine += work.engine;
    plant->energy.wheel_friction += work.wheel_friction;
    plant->energy.clutch += work.clutch;
    chassis_step(&plant->chassis, &plant->energy, p, road, sin_steer, cos_steer, tyre_x, tyre_y, work.wheel_mid);

    plant->steps += 1;
    if (plant->steps % THERMAL_DIVIDER == 0) {
        const int32_t cranking = p->starter != 0 && plant->engine.running == 0 ? 1 : 0;
        thermal_update(plant, &work, load, cranking);
    }
}

void plant_advance(struct plant *plant, int64_t inner_steps)
{
    const struct road road = road_from_inputs(&plant->v);
    double load[4] = {0.0, 0.0, 0.0, 0.0};
    struct tyre_force force[4] = {{0.0, 0.0, 0.0, 0.0}};
    if (inner_steps <= 0) {
        return;
    }
    for (int64_t i = 0; i < inner_steps; ++i) {
        inner_step(plant, &road, load, force);
    }
    write_outputs(plant, load, force);
}
