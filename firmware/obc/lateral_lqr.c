#include "obc/lateral_lqr.h"

#include <math.h>

#include "obc/numeric.h"

static const float period = 0.01f;        /* s */
static const float integral_max = 0.02f;  /* rad: ten times what the oval set-up needs */
static const float integrated_max = 0.5f; /* m: a far start or a lane change winds it up no faster */

enum state_index { E_Y, E_Y_RATE, E_PSI, E_PSI_RATE, STEER, STEER_RATE, E_Y_INTEGRAL };

/* Row of the tables below a speed, and the share of the next one. */
typedef struct table_place {
    uint32_t row;
    float part;
} table_place;

static table_place place_of(float speed)
{
    const float position = numeric_clamp(speed / controller_table.lqr_speed_step, 0.0f, (float)(CONTROLLER_SPEEDS - 1));
    table_place place = {.row = (uint32_t)position};
    if (place.row > CONTROLLER_SPEEDS - 2) {
        place.row = CONTROLLER_SPEEDS - 2;
    }
    place.part = position - (float)place.row;
    return place;
}

static float between(table_place place, float low, float high)
{
    return low + place.part * (high - low);
}

static float gain_of(table_place place, enum state_index state)
{
    return between(place, controller_table.lqr_gain[place.row][state],
                   controller_table.lqr_gain[place.row + 1u][state]);
}

/* Steering for what the path is about to do: changes of its steady state within the preview. */
static float preview(const lateral_state *state, table_place place)
{
    const float step = (float)CONTROLLER_PREVIEW_TICKS * period * state->speed;
    vehicle_cornering from = state->cornering;
    float steer = 0.0f;
    for (uint32_t i = 0; i < CONTROLLER_PREVIEW_STEPS; i++) {
        const float *low = controller_table.lqr_preview[place.row][i];
        const float *high = controller_table.lqr_preview[place.row + 1u][i];
        path_point at;
        vehicle_cornering to;
        path_at(state->plan, state->path.foot.s + (float)(i + 1u) * step, &at);
        vehicle_steady_cornering(state->speed, at.curvature, at.bank, &to);
        steer += between(place, low[0], high[0]) * (to.sideslip - from.sideslip) +
                 between(place, low[1], high[1]) * (to.yaw_rate - from.yaw_rate) +
                 between(place, low[2], high[2]) * (to.steer - from.steer);
        from = to;
    }
    return steer;
}

float lateral_lqr_command(const lateral_lqr *self, const lateral_state *state)
{
    const vehicle_motion *motion = &state->predicted.motion;
    const vehicle_cornering *steady = &state->cornering;
    const table_place place = place_of(state->speed);
    const float lateral_speed = state->speed * sinf(state->heading_error) + motion->vy * cosf(state->heading_error);
    return steady->steer + preview(state, place) + self->integral - gain_of(place, E_Y) * state->path.lateral -
           gain_of(place, E_Y_RATE) * lateral_speed -
           gain_of(place, E_PSI) * (state->heading_error + steady->sideslip) -
           gain_of(place, E_PSI_RATE) * (motion->yaw_rate - steady->yaw_rate) -
           gain_of(place, STEER) * (state->predicted.steer - steady->steer) -
           gain_of(place, STEER_RATE) * state->predicted.steer_rate;
}

void lateral_lqr_integrate(lateral_lqr *self, const lateral_state *state)
{
    const float gain = gain_of(place_of(state->speed), E_Y_INTEGRAL);
    const float error = numeric_clamp(state->path.lateral, -integrated_max, integrated_max);
    self->integral = numeric_clamp(self->integral - gain * error * period, -integral_max, integral_max);
}
