#include "obc/engine_map.h"

#include "obc/controller_tables.h"
#include "obc/numeric.h"

/* Torque over throttle at one engine speed. */
static void row_at(float engine_speed, float *row)
{
    const float position =
        numeric_clamp(engine_speed / controller_table.engine_speed_step, 0.0f, (float)(CONTROLLER_ENGINE_SPEEDS - 1));
    uint32_t i = (uint32_t)position;
    if (i > CONTROLLER_ENGINE_SPEEDS - 2) {
        i = CONTROLLER_ENGINE_SPEEDS - 2;
    }
    const float part = position - (float)i;
    for (uint32_t k = 0; k < CONTROLLER_THROTTLES; k++) {
        const float low = controller_table.engine_torque[i][k];
        row[k] = low + part * (controller_table.engine_torque[i + 1u][k] - low);
    }
}

float engine_map_torque(float engine_speed, float throttle)
{
    float row[CONTROLLER_THROTTLES];
    row_at(engine_speed, row);
    return numeric_interpolate(row, CONTROLLER_THROTTLES, throttle * (float)(CONTROLLER_THROTTLES - 1));
}

float engine_map_throttle(float engine_speed, float torque)
{
    float row[CONTROLLER_THROTTLES];
    row_at(engine_speed, row);
    if (!(torque > row[0])) {
        return 0.0f;
    }
    for (uint32_t k = 1; k < CONTROLLER_THROTTLES; k++) {
        if (torque < row[k]) {
            const float part = (torque - row[k - 1u]) / (row[k] - row[k - 1u]);
            return ((float)(k - 1u) + part) / (float)(CONTROLLER_THROTTLES - 1);
        }
    }
    return 1.0f;
}
