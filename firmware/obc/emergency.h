/* Emergency controller: pure pursuit along the wall, for a car that does not know where it is.
 *
 * It uses the wall as the LiDARs see it, the wheels' speed and the steering's angle: no GNSS, no IMU, no estimate.
 * Between two walls it reckons its own motion. The virtual path begins at the car and leads to the line parallel to the
 * wall at the distance that the car had when the controller took over, 1.5 m at least.
 */
#ifndef RACELOOP_OBC_EMERGENCY_H
#define RACELOOP_OBC_EMERGENCY_H

#include <stdbool.h>
#include <stdint.h>

#include "obc/motion_predictor.h"
#include "obc/wall_path.h"

/* How long the wall's last curvature is held once the wall is lost during an emergency stop, ms. */
#define EMERGENCY_HOLD_MS 300U

/* Deceleration of an emergency stop, m/s2, or the configured one if that is less: within the grip that a turn at the
 * top speed leaves, with wheels that roll, since locked ones do not steer. */
#define EMERGENCY_DECELERATION 8.0f

typedef struct emergency_input {
    const wall_polynomial *wall; /* newest, or null */
    uint32_t wall_count;         /* changes with every new wall */
    uint16_t wall_age_ms;
    uint16_t wall_timeout_ms;
    float wheel_speed;      /* m/s */
    float road_wheel_angle; /* rad, reported */
    bool engaged;           /* its command leaves */
} emergency_input;

typedef struct emergency_output {
    float road_wheel_angle; /* rad */
    float speed;            /* m/s */
    float acceleration;     /* m/s2, of the wheels */
    bool valid;             /* there is a wall to follow, or its curvature is still held */
} emergency_output;

/* Zero it to start: no wall, standing. */
typedef struct emergency {
    wall_polynomial wall;
    uint32_t wall_count;
    vehicle_motion car; /* in the frame of `wall` */
    float speed;        /* m/s, of the wheels, which a wheel that locks does not pull down */
    float acceleration; /* m/s2, smoothed */
    float distance;     /* m, that the path keeps from the wall */
    float curvature;    /* 1/m, of the wall beside the car when it was last seen */
} emergency;

/* One period, 100 Hz, in every state of the car, so that the controller is warm.
 * All pointers but the wall not null; a value that is not finite makes the output invalid. */
void emergency_step(emergency *self, const emergency_input *input, const motion_predictor *predictor,
                    emergency_output *output);

#endif
