#include "chassis.h"

#include <math.h>

#include "numeric.h"

/* The yaw moment of the oval set-up comes from rolling tyres: it fades in over this speed. */
static const double asymmetry_fade_speed = 5.0;

/* Acceleration of the body along the road normal. On a banked turn of constant radius the car turns
 * about the vertical at yaw_rate / cos(bank); its part along the car's left axis swings the forward
 * speed upwards along the road normal. This is what presses the car into a banking. */
static double normal_acceleration(const struct chassis_state *state, const struct road *road)
{
    return state->vx * state->yaw_rate * road->sin_bank / road->cos_bank;
}

void chassis_start(struct chassis_state *state, const struct plant_vars *p, const struct road *road)
{
    *state = (struct chassis_state){0};
    state->x = p->x0;
    state->y = p->y0;
    state->yaw = remainder(p->yaw0, 2.0 * PLANT_PI);
    if (state->yaw <= -PLANT_PI) {
        state->yaw += 2.0 * PLANT_PI;
    }
    state->vx = p->v0;
    /* as if standing held by the tyres */
    state->load_fx = p->gravity * road->sin_grade;
    state->load_fy = -p->gravity * road->sin_bank * road->cos_grade;
    state->fx = state->load_fx;
    state->fy = state->load_fy;
    state->fz = p->gravity * road->cos_bank * road->cos_grade;
}

/* Share an axle's load between left and right; a lifted wheel leaves all to the other one. */
static void share_axle(double axle_load, double transfer_to_right, double *left, double *right)
{
    const double total = fmax(axle_load, 0.0);
    *left = clamp(0.5 * total - transfer_to_right, 0.0, total);
    *right = total - *left;
}

void chassis_wheel_loads(const struct chassis_state *state, const struct plant_vars *p, const struct road *road,
                         double load[4])
{
    const double wheelbase = p->cg_to_front_axle + p->cg_to_rear_axle;
    const double weight = p->mass * (p->gravity * road->cos_bank * road->cos_grade + normal_acceleration(state, road));
    const double dynamic_pressure = 0.5 * p->air_density * state->vx * state->vx;
    const double to_rear = p->mass * state->load_fx * p->cg_height / wheelbase;
    const double roll_moment = p->mass * state->load_fy * p->cg_height;
    const double front = weight * p->cg_to_rear_axle / wheelbase - to_rear + dynamic_pressure * p->downforce_area_front;
    const double rear = weight * p->cg_to_front_axle / wheelbase + to_rear + dynamic_pressure * p->downforce_area_rear;
    share_axle(front, roll_moment * p->roll_stiffness_front_share / p->track_width_front, &load[FL], &load[FR]);
    share_axle(rear, roll_moment * (1.0 - p->roll_stiffness_front_share) / p->track_width_rear, &load[RL], &load[RR]);
}

void chassis_wheel_motion(const struct plant_vars *p, double vx, double vy, double yaw_rate, double sin_steer,
                          double cos_steer, struct wheel_motion *motion)
{
    const double half_front = 0.5 * p->track_width_front * yaw_rate;
    const double half_rear = 0.5 * p->track_width_rear * yaw_rate;
    const double front_y = vy + yaw_rate * p->cg_to_front_axle;
    const double rear_y = vy - yaw_rate * p->cg_to_rear_axle;
    motion->along[FL] = (vx - half_front) * cos_steer + front_y * sin_steer;
    motion->along[FR] = (vx + half_front) * cos_steer + front_y * sin_steer;
    motion->across[FL] = front_y * cos_steer - (vx - half_front) * sin_steer;
    motion->across[FR] = front_y * cos_steer - (vx + half_front) * sin_steer;
    motion->along[RL] = vx - half_rear;
    motion->along[RR] = vx + half_rear;
    motion->across[RL] = rear_y;
    motion->across[RR] = rear_y;
}

/* Turn a vector by -angle without changing its length (Cayley form). Plain Euler would add energy
 * in every step of a turn. */
static void rotate_back(double angle, double *x, double *y)
{
    const double h = 0.5 * angle;
    const double d = 1.0 / (1.0 + h * h);
    const double c = (1.0 - h * h) * d;
    const double s = 2.0 * h * d;
    const double rx = c * *x + s * *y;
    const double ry = c * *y - s * *x;
    *x = rx;
    *y = ry;
}

void chassis_step(struct chassis_state *state, struct energy_account *energy, const struct plant_vars *p,
                  const struct road *road, double sin_steer, double cos_steer, const double tyre_x[4],
                  const double tyre_y[4], const double wheel_mid[4])
{
    const double dt = PLANT_INNER_STEP_S;
    const double lf = p->cg_to_front_axle;
    const double lr = p->cg_to_rear_axle;
    double bx[4];
    double by[4];
    for (int i = 0; i < WHEELS; ++i) {
        const double s = i < RL ? sin_steer : 0.0;
        const double c = i < RL ? cos_steer : 1.0;
        bx[i] = tyre_x[i] * c - tyre_y[i] * s;
        by[i] = tyre_y[i] * c + tyre_x[i] * s;
    }
    const double speed2 = state->vx * state->vx;
    const double drag = 0.5 * p->air_density * p->drag_area * state->vx * fabs(state->vx);
    const double asymmetry =
        p->oval_asymmetry * p->asymmetry_yaw_moment * speed2 / (speed2 + asymmetry_fade_speed * asymmetry_fade_speed);
    const double moment = lf * (by[FL] + by[FR]) - lr * (by[RL] + by[RR]) +
                          0.5 * p->track_width_front * (bx[FR] - bx[FL]) +
                          0.5 * p->track_width_rear * (bx[RR] - bx[RL]) + asymmetry;
    const double fx = (bx[FL] + bx[FR] + bx[RL] + bx[RR] - drag) / p->mass;
    const double fy = (by[FL] + by[FR] + by[RL] + by[RR]) / p->mass;
    const double gx = -p->gravity * road->sin_grade;
    const double gy = p->gravity * road->sin_bank * road->cos_grade;
    const double normal = normal_acceleration(state, road);

    const double vx_mid = state->vx + 0.5 * dt * (fx + gx);
    const double vy_mid = state->vy + 0.5 * dt * (fy + gy);
    const double r_mid = state->yaw_rate + 0.5 * dt * moment / p->yaw_inertia;

    /* Works with the mean speeds of the step add up to the change of kinetic energy exactly. */
    struct wheel_motion mid;
    chassis_wheel_motion(p, vx_mid, vy_mid, r_mid, sin_steer, cos_steer, &mid);
    double tyre_work = 0.0;
    for (int i = 0; i < WHEELS; ++i) {
        const double radius = i < RL ? p->tyre_radius_front : p->tyre_radius_rear;
        energy->tyre_power[i] = tyre_x[i] * (radius * wheel_mid[i] - mid.along[i]) - tyre_y[i] * mid.across[i];
        tyre_work += energy->tyre_power[i];
    }
    energy->tyre += dt * (tyre_work - asymmetry * r_mid);
    energy->aero += dt * drag * vx_mid;
    energy->gravity += dt * p->mass * (gx * vx_mid + gy * vy_mid);

    state->vx += dt * (fx + gx);
    state->vy += dt * (fy + gy);
    state->yaw_rate += dt * moment / p->yaw_inertia;
    rotate_back(r_mid * dt, &state->vx, &state->vy);

    /* Plan view: the car turns with the banking about the vertical. */
    const double yaw_step = dt * r_mid / road->cos_bank;
    const double heading = state->yaw + 0.5 * yaw_step;
    const double forward = dt * vx_mid * road->cos_grade;
    const double left = dt * vy_mid * road->cos_bank;
    const double c = cos(heading);
    const double s = sin(heading);
    state->x += forward * c - left * s;
    state->y += forward * s + left * c;
    state->z += dt * vx_mid * road->sin_grade;
    state->yaw += yaw_step;
    if (state->yaw > PLANT_PI) {
        state->yaw -= 2.0 * PLANT_PI;
    } else if (state->yaw <= -PLANT_PI) {
        state->yaw += 2.0 * PLANT_PI;
    }
    state->distance += dt * sqrt(vx_mid * vx_mid + vy_mid * vy_mid);

    state->fx = fx;
    state->fy = fy;
    state->fz = p->gravity * road->cos_bank * road->cos_grade + normal;
    state->ax = fx + gx;
    state->ay = fy + gy;
    state->load_fx = lag_step(state->load_fx, fx, p->load_transfer_time_constant, dt);
    state->load_fy = lag_step(state->load_fy, fy, p->load_transfer_time_constant, dt);
}
