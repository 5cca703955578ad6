/* Gear requests over speed, with hysteresis and a pause between requests. */
#ifndef RACELOOP_OBC_GEAR_SHIFT_H
#define RACELOOP_OBC_GEAR_SHIFT_H

#include <stdbool.h>
#include <stdint.h>

enum {
    GEAR_SHIFT_TOP = 6,
    GEAR_SHIFT_PAUSE_TICKS = 30, /* 300 ms between requests */
    GEAR_SHIFT_READY = 1,        /* pt_report_1.gear_shift_status */
    GEAR_SHIFT_LOCKED_OUT = 2,
};

/* Zero it to start: neutral. */
typedef struct gear_shift {
    uint8_t requested; /* 0..6 */
    uint8_t pause;     /* ticks until the next request may differ */
} gear_shift;

/* Gear to request, 0..6; called at 100 Hz.
 * speed: m/s. gear, status: as the transmission reports them. Neutral while the engine stands; first gear is requested
 * out of neutral once `drive` is wanted. A request stays until the transmission is ready again, at least 300 ms. */
uint8_t gear_shift_step(gear_shift *self, float speed, uint8_t gear, uint8_t status, bool engine_running, bool drive);

#endif
