#include "obc/lateral_lqr.h"

#include <math.h>

#include "obc/numeric.h"

static const float period = 0.01f;        /* s */
static const float integral_max = 0.02f;  /* rad: ten times what the oval set-up needs */
static const float integrated_max = 0.5f; /* m: a far start or a lane change winds it up no faster */

enum state_index { E_Y, E_Y_RATE, E_PSI, E_PSI_RATE, STEER, STEER_RATE, E_Y_INTEGRAL };

static void gains_at(float speed, float *gain)
{
    const float position = numeric_clamp(speed / controller_table.lqr_speed_step, 0.0f, (float)(CONTROLLER_SPEEDS - 1));
    uint32_t row = (uint32_t)position;
    if (row > CONTROLLER_SPEEDS - 2) {
        row = CONTROLLER_SPEEDS - 2;
    }
    const float part = position - (float)row;
    for (uint32_t i = 0; i < CONTROLLER_STATES; i++) {
        const float low = controller_table.lqr_gain[row][i];
        gain[i] = low + part * (controller_table.lqr_gain[row + 1u][i] - low);
    }
}

float lateral_lqr_command(const lateral_lqr *self, const lateral_state *state)
{
    const vehicle_motion *motion = &state->predicted.motion;
    const vehicle_cornering *steady = &state->cornering;
    const float along = sinf(state->heading_error);
    const float across = cosf(state->heading_error);
    float gain[CONTROLLER_STATES];
    gains_at(state->speed, gain);
    return state->steer_ahead + self->integral - gain[E_Y] * state->path.lateral -
           gain[E_Y_RATE] * (state->speed * along + motion->vy * across) -
           gain[E_PSI] * (state->heading_error + steady->sideslip) -
           gain[E_PSI_RATE] * (motion->yaw_rate - steady->yaw_rate) -
           gain[STEER] * (state->predicted.steer - steady->steer) - gain[STEER_RATE] * state->predicted.steer_rate;
}

void lateral_lqr_integrate(lateral_lqr *self, const lateral_state *state)
{
    float gain[CONTROLLER_STATES];
    gains_at(state->speed, gain);
    const float error = numeric_clamp(state->path.lateral, -integrated_max, integrated_max);
    self->integral = numeric_clamp(self->integral - gain[E_Y_INTEGRAL] * error * period, -integral_max, integral_max);
}
