#include "tyre.h"

#include <math.h>

#include "numeric.h"

/* Below this load a tyre carries nothing and forgets its deflection. */
static const double min_load = 1.0;

/* Tread damping: without it a locked or parked car rings on its tyres for seconds. The forces
 * vanish in steady state because they depend on the rate of deflection only. The lateral one
 * fades with speed, where the lag of slip damps by itself. */
static const double damping_time_x = 0.002;
static const double damping_time_y = 0.02;
static const double damping_fade_speed = 2.0;

/* Largest normalised slip that the deflection may store. The peak of the force is near 1.2. Without
 * the bound a wheel that stops after a slide would push the car back by its stored deflection. */
static const double slip_bound_standing = 1.5;
static const double slip_bound_per_speed = 3.0;
static const double slip_bound_top = 100.0;

/* The formula is only trusted up to this multiple of the nominal load. */
static const double max_load_change = 3.0;

double tyre_cornering_stiffness(const struct plant_vars *p, double load)
{
    const double q = load / (p->tyre_pky2 * p->tyre_nominal_load);
    /* sin(2 atan q) without the two calls */
    return p->tyre_nominal_load * p->tyre_pky1 * 2.0 * q / (1.0 + q * q);
}

/* Shape of the Magic Formula over the stiffness-normalised slip s >= 0, divided by s. Past its peak
 * it does not fall below `slide`: the fitted coefficients are for slips near the peak, and without
 * the floor a spinning wheel would lose nearly all its force. */
static double shape_over_slip(double s, double c, double e, double slide)
{
    if (s < 1e-6) {
        return c;
    }
    const double angle = c * atan(s - e * (s - atan(s)));
    const double shape = sin(angle);
    return (angle > 0.5 * PLANT_PI ? fmax(shape, slide) : shape) / s;
}

struct tyre_force tyre_step(struct tyre_state *state, const struct plant_vars *p, const struct tyre_input *in)
{
    struct tyre_force force = {0.0, 0.0, 0.0, 0.0};
    const double dt = PLANT_INNER_STEP_S;
    if (in->load < min_load) {
        state->deflection_x = 0.0;
        state->deflection_y = 0.0;
        return force;
    }
    const double load = in->load;
    const double change = fmin(load / p->tyre_nominal_load - 1.0, max_load_change);
    const double peak_x = load * fmax(0.1, p->tyre_pdx1 + p->tyre_pdx2 * change) * p->tyre_mu_scale_x * in->friction;
    const double peak_y = load * fmax(0.1, p->tyre_pdy1 + p->tyre_pdy2 * change) * p->tyre_mu_scale_y * in->friction;
    const double stiffness_x = load * p->tyre_pkx1 * exp(p->tyre_pkx3 * change);
    const double stiffness_y = tyre_cornering_stiffness(p, load) * in->stiffness_scale;
    const double bx = stiffness_x / (p->tyre_pcx1 * peak_x * p->tyre_relaxation_x);
    const double by = stiffness_y / (p->tyre_pcy1 * peak_y * p->tyre_relaxation_y);

    /* Deflection: slip speed loads it, rolling carries it away. Implicit in the second part. */
    const double roll = fabs(in->speed_x);
    const double slip_speed_x = in->rim_speed - in->speed_x;
    const double slip_speed_y = roll * in->slip_offset - in->speed_y;
    double ux = (state->deflection_x + dt * slip_speed_x) / (1.0 + dt * roll / p->tyre_relaxation_x);
    double uy = (state->deflection_y + dt * slip_speed_y) / (1.0 + dt * roll / p->tyre_relaxation_y);

    const double bound = fmin(slip_bound_standing + slip_bound_per_speed * (roll + fabs(in->speed_y)), slip_bound_top);
    const double stored = sqrt(bx * bx * ux * ux + by * by * uy * uy);
    if (stored > bound) {
        ux *= bound / stored;
        uy *= bound / stored;
    }

    const double fade = damping_fade_speed / (damping_fade_speed + roll);
    const double sx = bx * (ux + damping_time_x * (ux - state->deflection_x) / dt);
    const double sy = by * (uy + fade * damping_time_y * (uy - state->deflection_y) / dt);
    state->deflection_x = ux;
    state->deflection_y = uy;

    const double s = sqrt(sx * sx + sy * sy);
    force.x = peak_x * sx * shape_over_slip(s, p->tyre_pcx1, p->tyre_pex1, p->tyre_sliding_share);
    force.y = peak_y * sy * shape_over_slip(s, p->tyre_pcy1, p->tyre_pey1, p->tyre_sliding_share);
    force.slip_x = ux / p->tyre_relaxation_x;
    force.slip_y = uy / p->tyre_relaxation_y;
    return force;
}
