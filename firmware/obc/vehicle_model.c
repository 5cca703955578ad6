#include "obc/vehicle_model.h"

#include <math.h>

#include "obc/controller_tables.h"
#include "obc/numeric.h"

/* An axle never counts as lighter than this share of the peak-stiffness load: slip angles stay finite. */
static const float load_ratio_min = 0.02f;

static float axle_stiffness(float peak, float load)
{
    const float q = fmaxf(load / controller_table.stiffness_peak_load, load_ratio_min);
    return peak * 2.0f * q / (1.0f + q * q);
}

/* Yaw moment (N m) of the driven axle whose wheels the limited-slip differential holds together. In a turn the inner
 * wheel then slips forward and the outer one back, which works against the turn; load transfer leaves the outer wheel
 * more of the drive force, which works with it. Both up to the differential's locking torque.
 * lateral, drive, load: N, of side force, drive force and load of the axle's share. */
static float differential_moment(float curvature, float lateral, float drive, float load)
{
    const controller_tables *car = &controller_table;
    const float outward = numeric_clamp(2.0f * car->load_transfer_rear * lateral / load, -1.0f, 1.0f);
    const float slip = 0.5f * car->track_rear * curvature;
    const float inner_surplus = car->slip_stiffness * load * (1.0f - outward * outward) * slip - outward * drive;
    const float locking = 2.0f * (car->differential_preload / car->driven_radius + car->differential_ratio * drive);
    return -0.5f * car->track_rear * numeric_clamp(inner_surplus, -locking, locking);
}

void vehicle_steady_cornering(float speed, float curvature, float bank, vehicle_cornering *out)
{
    const controller_tables *car = &controller_table;
    const float wheelbase = car->cg_to_front + car->cg_to_rear;
    const float sin_bank = sinf(bank);
    const float cos_bank = cosf(bank);
    const float speed_square = speed * speed;
    const float centripetal = speed_square * curvature; /* horizontal */
    const float lateral = car->mass * (centripetal * cos_bank - car->gravity * sin_bank);
    const float weight = car->mass * (car->gravity * cos_bank + centripetal * sin_bank);
    const float front_share = car->cg_to_rear / wheelbase;
    const float rear_share = car->cg_to_front / wheelbase;

    const float load_front = weight * front_share + car->downforce_front * speed_square;
    out->load_rear = weight * rear_share + car->downforce_rear * speed_square;
    out->load = load_front + out->load_rear;
    out->stiffness_front = axle_stiffness(car->stiffness_peak_front, load_front);
    out->stiffness_rear = axle_stiffness(car->stiffness_peak_rear, out->load_rear);
    const float held = car->drag_factor * speed_square + car->rolling_resistance * out->load;
    out->yaw_moment = differential_moment(curvature, lateral, held, out->load_rear);
    const float force_front = lateral * front_share - out->yaw_moment / wheelbase;
    const float force_rear = lateral * rear_share + out->yaw_moment / wheelbase;
    out->slip_front = force_front / out->stiffness_front;
    out->slip_rear = force_rear / out->stiffness_rear;
    out->yaw_rate = speed * curvature * cos_bank;
    out->sideslip = car->cg_to_rear * curvature - out->slip_rear;
    out->steer = wheelbase * curvature + out->slip_front - out->slip_rear;
    out->drag = force_front * out->slip_front + force_rear * out->slip_rear;
}

void vehicle_motion_step(vehicle_motion *motion, const vehicle_cornering *tyres, float speed, float bank, float steer,
                         float dt)
{
    const controller_tables *car = &controller_table;
    const float cf = tyres->stiffness_front;
    const float cr = tyres->stiffness_rear;
    const float lf = car->cg_to_front;
    const float lr = car->cg_to_rear;
    const float yaw_before = motion->yaw;

    /* (v I - dt v A) z' = v z + dt v (B steer + g + M): the bicycle's equations times speed, implicit Euler. */
    const float m11 = speed + dt * (cf + cr) / car->mass;
    const float m12 = dt * ((cf * lf - cr * lr) / car->mass + speed * speed);
    const float m21 = dt * (cf * lf - cr * lr) / car->yaw_inertia;
    const float m22 = speed + dt * (cf * lf * lf + cr * lr * lr) / car->yaw_inertia;
    const float n1 = speed * (motion->vy + dt * (cf * steer / car->mass + car->gravity * sinf(bank)));
    const float n2 = speed * (motion->yaw_rate + dt * (cf * lf * steer + tyres->yaw_moment) / car->yaw_inertia);
    const float determinant = m11 * m22 - m12 * m21;
    motion->vy = (n1 * m22 - n2 * m12) / determinant;
    motion->yaw_rate = (n2 * m11 - n1 * m21) / determinant;

    const float turn = dt * motion->yaw_rate / cosf(bank); /* about the vertical */
    const float heading = yaw_before + 0.5f * turn;
    motion->yaw = numeric_wrap_angle(yaw_before + turn);
    motion->x += dt * (speed * cosf(heading) - motion->vy * sinf(heading));
    motion->y += dt * (speed * sinf(heading) + motion->vy * cosf(heading));
}
