/* One actuator axis, steering or brake, with three redundant channels.
 *
 * Every channel judges the requests itself, reads its own sensor and computes its own demand; what leaves is the
 * median of the three demands. A channel whose sensor fails or disagrees is outvoted and then excluded until
 * restart; with fewer than two trusted channels the axis has failed.
 */
#ifndef RACELOOP_SPACE_DRIVE_AXIS_H
#define RACELOOP_SPACE_DRIVE_AXIS_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/debounce.h"
#include "common/voter.h"
#include "space_drive/request.h"

enum { SPACE_DRIVE_CHANNELS = 3 }; /* as many as the voter takes */

/* Properties of an axis, in the axis' own SI unit: rad for steering, Pa for the brake. */
typedef struct space_drive_axis_config {
    float position_at_zero; /* position that count 0 means */
    float position_at_max;  /* position that counts_max means */
    float sensor_minimum;   /* below: sensor failed */
    float sensor_maximum;   /* above: sensor failed */
    float deviation;        /* distance from the median that a sensor may have */
    float lead;             /* how far a channel's demand may run ahead of its own sensor */
    float safe_demand;      /* demand before the first good request; used when `safe_demand_valid` */
    bool safe_demand_valid; /* false: hold the position that the sensor shows */
    uint16_t counts_max;    /* largest count that a request may ask for */
    uint16_t bad_limit;     /* bad requests in a row that lose the axis */
    uint32_t timeout_us;    /* age of the last good request that loses the axis */
    uint32_t deviation_us;  /* how long a sensor may deviate before its channel is excluded */
} space_drive_axis_config;

/* One of the three channels. */
typedef struct space_drive_channel {
    space_drive_request request;
    debounce sensor_fault;
    debounce disagreement;
    float position;     /* own sensor, axis unit; only meaningful while sensor_valid */
    float demand;       /* own demand, axis unit */
    bool sensor_valid;  /* finite and inside its range now */
    bool excluded;      /* until restart */
    bool sensor_failed; /* why: invalid reading */
    bool implausible;   /* why: outvoted */
} space_drive_channel;

/* State of one axis: zero it to start. */
typedef struct space_drive_axis {
    space_drive_channel channels[SPACE_DRIVE_CHANNELS];
    float demand;       /* voted demand; holds its last value when the vote fails */
    float position;     /* voted position; holds its last value when the vote fails */
    bool demand_valid;  /* a vote has succeeded at least once */
    bool ready;         /* two channels or more have had a good request */
    bool requests_lost; /* fewer than two trusted channels have fresh requests now, though the axis was ready */
    bool failed;        /* fewer than two channels are trusted; until restart */
} space_drive_axis;

/* Hand a request frame to every channel's receiver. */
void space_drive_axis_receive(space_drive_axis *self, const space_drive_axis_config *config, const can_frame *frame,
                              uint64_t now_us);

/* One tick after reception: judge the sensors, compute the channels' demands and vote.
 * sensors: one per channel, axis unit; NaN and infinities are invalid readings. */
void space_drive_axis_step(space_drive_axis *self, const space_drive_axis_config *config,
                           const float sensors[SPACE_DRIVE_CHANNELS], uint64_t now_us);

/* Counts of a position: 0 at position_at_zero, counts_max at position_at_max, saturated; position finite. */
uint16_t space_drive_axis_counts(const space_drive_axis_config *config, float position);

#endif
