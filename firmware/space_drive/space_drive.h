/* Space Drive: steering and brake actuation with three redundant channels per axis, voting, counter and CRC
 * check on every request, and an emergency brake when requests stop or fail their check.
 */
#ifndef RACELOOP_SPACE_DRIVE_H
#define RACELOOP_SPACE_DRIVE_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"
#include "common/executive.h"

enum { SPACE_DRIVE_CHANNELS = 3 };

/* Position counts on CAN3. Steering: 0 right stop, 0x4000 straight, 0x8000 left stop (ours, after the brake's
 * published scale). Brake and gas: 0 full brake, 0x4000 neutral, 0x8000 full gas (gas is not used on this car).
 * 0xFFFF: signal not valid. */
enum {
    SPACE_DRIVE_NEUTRAL = 0x4000,
    SPACE_DRIVE_STOP = 0x8000,
    SPACE_DRIVE_INVALID = 0xFFFF,
};

/* Ends of travel behind the counts. */
#define SPACE_DRIVE_STEER_STOP_RAD 4.18879020f /* 240 degrees at the motor */
#define SPACE_DRIVE_BRAKE_STOP_PA 6.0e6f       /* full brake */

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

/* TODO(space drive owner): state struct `space_drive`, configuration, and the door below. */

/* void space_drive_init(space_drive *self, const space_drive_config *config);   null config: defaults
 * void space_drive_tick(space_drive *self, uint64_t now_us, const space_drive_wired_in *wired,
 *                       const can_frame *in, uint32_t in_count, space_drive_wired_out *drive, can_outbox *out); */

#endif
