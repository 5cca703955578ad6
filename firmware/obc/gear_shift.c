#include "obc/gear_shift.h"

/* Speeds to leave a gear upwards and downwards, m/s; index is the gear. After public AV-21 stacks for ovals. */
static const float up_above[GEAR_SHIFT_TOP + 1] = {0.0f, 11.0f, 22.0f, 28.5f, 37.5f, 44.0f, 0.0f};
static const float down_below[GEAR_SHIFT_TOP + 1] = {0.0f, 0.0f, 9.5f, 19.5f, 25.0f, 35.0f, 41.5f};

static uint8_t wanted_gear(float speed, uint8_t gear, bool drive)
{
    if (gear == 0u) {
        return drive ? 1u : 0u;
    }
    if (gear < GEAR_SHIFT_TOP && speed > up_above[gear]) {
        return (uint8_t)(gear + 1u);
    }
    if (gear > 1u && speed < down_below[gear]) {
        return (uint8_t)(gear - 1u);
    }
    return gear;
}

uint8_t gear_shift_step(gear_shift *self, float speed, uint8_t gear, uint8_t status, bool engine_running, bool drive)
{
    if (!engine_running) {
        self->requested = 0;
        self->pause = 0;
        return 0;
    }
    if (self->pause > 0u) {
        self->pause--;
        return self->requested;
    }
    const bool settled = status == GEAR_SHIFT_READY || status == GEAR_SHIFT_LOCKED_OUT;
    if (!settled || gear > GEAR_SHIFT_TOP) {
        return self->requested;
    }
    const uint8_t wanted = wanted_gear(speed, gear, drive);
    if (wanted != self->requested) {
        self->requested = wanted;
        self->pause = GEAR_SHIFT_PAUSE_TICKS;
    }
    return self->requested;
}
