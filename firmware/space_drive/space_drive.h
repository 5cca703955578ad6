/* Space Drive: steering and brake actuation with three redundant channels per axis, voting, counter and CRC
 * check on every request, and an emergency brake when requests stop or fail their check.
 */
#ifndef RACELOOP_SPACE_DRIVE_H
#define RACELOOP_SPACE_DRIVE_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"
#include "common/debounce.h"
#include "common/executive.h"
#include "space_drive/axis.h"

/* Position counts on CAN3. Steering: 0 right stop, 0x4000 straight, 0x8000 left stop (ours, after the brake's
 * published scale). Brake and gas: 0 full brake, 0x4000 neutral, 0x8000 full gas (gas is not used on this car).
 * 0xFFFF: signal not valid. */
enum {
    SPACE_DRIVE_NEUTRAL = 0x4000,
    SPACE_DRIVE_STOP = 0x8000,
    SPACE_DRIVE_INVALID = 0xFFFF,
};

/* Plausibility byte of a calibrated position. */
enum {
    SPACE_DRIVE_PLAUSIBLE = 0,
    SPACE_DRIVE_NOT_PLAUSIBLE = 2,
};

/* Ends of travel behind the counts. */
#define SPACE_DRIVE_STEER_STOP_RAD 4.18879020f /* 240 degrees at the motor */
#define SPACE_DRIVE_BRAKE_STOP_PA  6.0e6f      /* largest pressure, at count 0 */
/* Full brakes, docs/safety.md: the wheels of a car that nobody steers may lock, those of a steered one should not. */
#define SPACE_DRIVE_FULL_BRAKE_PA    4.5e6f
#define SPACE_DRIVE_STEERED_BRAKE_PA 3.5e6f

/* Signals wired to the Space Drive. */
typedef struct space_drive_wired_in {
    float steer_motor_angle[SPACE_DRIVE_CHANNELS]; /* rad, one sensor per channel, left positive */
    float brake_pressure[SPACE_DRIVE_CHANNELS];    /* Pa, one sensor per channel */
    float main_battery;                            /* V */
    float backup_battery;                          /* V */
} space_drive_wired_in;

/* Signals that the Space Drive drives. */
typedef struct space_drive_wired_out {
    float steer_motor_demand;    /* rad, left positive */
    float brake_pressure_demand; /* Pa, 0..SPACE_DRIVE_BRAKE_STOP_PA */
} space_drive_wired_out;

/* Configuration. The defaults are `space_drive_config_default`. */
typedef struct space_drive_config {
    space_drive_axis_config steer; /* rad */
    space_drive_axis_config brake; /* Pa */
    float battery_minimum;         /* V, both batteries: below is reported */
    float battery_maximum;         /* V, both batteries: above is reported */
} space_drive_config;

extern const space_drive_config space_drive_config_default;

/* Why the emergency brake was applied; bits, latched until restart. */
enum space_drive_emergency {
    SPACE_DRIVE_EMERGENCY_STEER_REQUESTS = 1, /* steering requests stopped or failed their check */
    SPACE_DRIVE_EMERGENCY_BRAKE_REQUESTS = 2, /* brake requests stopped or failed their check */
    SPACE_DRIVE_EMERGENCY_STEER_SENSORS = 4,  /* fewer than two trusted steering channels */
    SPACE_DRIVE_EMERGENCY_BRAKE_SENSORS = 8,  /* fewer than two trusted brake channels */
    SPACE_DRIVE_EMERGENCY_STOPPING = 16,      /* told to stop */
};

/* State of one Space Drive. A zeroed one applies full brake. */
typedef struct space_drive {
    space_drive_config config;
    executive schedule;
    space_drive_axis steer;
    space_drive_axis brake;
    float main_battery;   /* V */
    float backup_battery; /* V */
    uint8_t emergency;    /* enum space_drive_emergency; nonzero: full brake until restart */
    bool shutdown;        /* shut down in order: full brake until restart, silence on CAN3 is no fault */
    float brake_demand;   /* Pa, in force */
    uint8_t steer_counter[SPACE_DRIVE_CHANNELS]; /* of the calibrated position frames */
    uint8_t brake_counter[SPACE_DRIVE_CHANNELS];
} space_drive;

/* Put `self` into its power-on state. config: null for the defaults; copied. */
void space_drive_init(space_drive *self, const space_drive_config *config);

/* Run one minor frame of 10 ms.
 *
 * now_us: monotonic. wired: sampled signals; NaN and infinities are treated as failed sensors. in: in_count frames
 * received since the last tick, any bus and id; what is not for the Space Drive is ignored. drive: all fields are
 * written. out: frames for CAN3 are appended.
 *
 * The steering follows its requests whenever they are valid, also under the emergency brake, because a car that
 * brakes in a turn still has to follow it; without valid requests it keeps its last good target. The emergency
 * brake stays until restart: a Raptor that was lost once is not trusted to drive on.
 */
void space_drive_tick(space_drive *self, uint64_t now_us, const space_drive_wired_in *wired, const can_frame *in,
                      uint32_t in_count, space_drive_wired_out *drive, can_outbox *out);

/* The Space Drive is about to be switched off: emergency brake from the next tick on, until space_drive_init.
 * One that was shut down in order brakes already, and reports no emergency. */
void space_drive_stop(space_drive *self);

/* The static schedule, for checks: returns the table, `count` receives the number of its tasks. */
const executive_task *space_drive_schedule(uint32_t *count);

#endif
