/* The wall beside the track as the autonomy partition sends it on CAN-A: a polynomial in the vehicle's frame. */
#ifndef RACELOOP_OBC_WALL_RECEIVER_H
#define RACELOOP_OBC_WALL_RECEIVER_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"

enum {
    WALL_FRAMES = 2,
    WALL_COEFFICIENTS = 4,
};

/* A wall at y = sum of coefficient[k] x^k: ISO 8855 axes from the car's centre of gravity. */
typedef struct wall_polynomial {
    float coefficient[WALL_COEFFICIENTS]; /* m, 1, 1/m, 1/m2 */
    float begin;                          /* m, least and largest x of points on the wall */
    float end;
} wall_polynomial;

/* Newest wall: zero it to start, which is none. */
typedef struct wall_receiver {
    wall_polynomial halves;        /* newest line and bend */
    uint64_t half_us[WALL_FRAMES]; /* when they came */
    uint8_t counter[WALL_FRAMES];  /* of each */
    bool half_seen[WALL_FRAMES];
    bool found; /* the line says so */
    wall_polynomial wall;
    uint8_t wall_counter; /* its halves' */
    uint64_t received_us; /* when the first half of `wall` came */
    uint32_t count;       /* walls so far; wraps */
    bool seen;
} wall_receiver;

/* Take wall_line or wall_bend. A wall counts when its halves, in whatever order, have the same counter, which is not
 * that of the wall before, and it was found. Frames that cannot be read are dropped. now_us: time of the tick,
 * monotonic. */
void wall_receiver_push(wall_receiver *self, const can_frame *frame, uint64_t now_us);

/* Age of the newest wall in ms, saturating; 65535 when there was none. */
uint16_t wall_receiver_age_ms(const wall_receiver *self, uint64_t now_us);

/* Age up to which a wall is followed, ms: the time-out of its messages. */
uint16_t wall_receiver_timeout_ms(void);

#endif
