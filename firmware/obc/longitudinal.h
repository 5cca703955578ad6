/* Speed control: a rate-limited speed reference, force feed-forward through the engine map, PID on the error, and
 * either throttle or brake, never both. */
#ifndef RACELOOP_OBC_LONGITUDINAL_H
#define RACELOOP_OBC_LONGITUDINAL_H

#include <stdbool.h>
#include <stdint.h>

#include "obc/vehicle_model.h"

/* Pressure that holds the standing car, and that is commanded while driving is not enabled. */
#define LONGITUDINAL_HOLD_PRESSURE_PA 8.0e5f

/* Zero it to start: standing. */
typedef struct longitudinal {
    float reference; /* m/s, speed reference behind its rate limits */
    float integral;  /* m/s2 */
    float throttle;  /* 0..1, last command */
    float pressure;  /* Pa, last command */
    bool braking;    /* the brake has the force, not the throttle */
    bool moving;     /* the reference has left standstill */
} longitudinal;

typedef struct longitudinal_input {
    float speed;               /* m/s */
    float acceleration;        /* m/s2, measured along the car */
    float target_speed;        /* m/s, planned and limited */
    float target_acceleration; /* m/s2, of the planned speed; used when no rate limit is active */
    float max_acceleration;    /* m/s2, >= 0 */
    float max_deceleration;    /* m/s2, >= 0 */
    vehicle_cornering road;    /* loads and cornering resistance at this speed */
    float engine_speed;        /* rad/s */
    uint8_t gear;              /* 0..6 */
    bool shifting;             /* the driveline is open */
} longitudinal_input;

typedef struct longitudinal_output {
    float throttle;       /* 0..1 */
    float brake_pressure; /* Pa, 0..6e6 */
    float speed_error;    /* m/s, reference minus speed */
} longitudinal_output;

/* One period, 100 Hz. input: finite. */
void longitudinal_step(longitudinal *self, const longitudinal_input *input, longitudinal_output *out);

/* Driving is not enabled: throttle closed, holding pressure, everything at rest.
 * speed: m/s, from which the reference starts when driving is enabled again. */
void longitudinal_hold(longitudinal *self, float speed, longitudinal_output *out);

#endif
