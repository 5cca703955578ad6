/* Lateral and longitudinal control of the car: the pure step behind every drive-by-wire command.
 *
 * All lateral controllers run in parallel every cycle; the SSM picks whose command leaves, so that a backup is
 * always warm. Nothing here reads a frame or a clock.
 */
#ifndef RACELOOP_OBC_CONTROL_H
#define RACELOOP_OBC_CONTROL_H

#include <stdbool.h>
#include <stdint.h>

#include "obc/emergency.h"
#include "obc/gear_shift.h"
#include "obc/lateral_lqr.h"
#include "obc/longitudinal.h"
#include "obc/motion_predictor.h"
#include "obc/trajectory.h"

#define CONTROL_SPEED_DISAGREEMENT 2.0f /* m/s between wheels and estimate, above which the faster one counts */

/* Lateral controllers; the numbers are those of ssm_status.ssm_controller. */
enum control_lateral {
    CONTROL_NONE = 0,
    CONTROL_LQR = 1,
    CONTROL_STANLEY = 2,
    CONTROL_PURE_PURSUIT = 3,
    CONTROL_EMERGENCY = 4,
    CONTROL_LATERAL_COUNT = 5,
};

/* State of the car as estimation reports it. ISO 8855 axes, track frame. */
typedef struct control_estimate {
    float x;        /* m */
    float y;        /* m */
    float yaw;      /* rad, (-pi, pi] */
    float vx;       /* m/s */
    float vy;       /* m/s */
    float yaw_rate; /* rad/s */
    float ax;       /* m/s2 */
    float ay;       /* m/s2 */
    bool valid;     /* fresh and finite */
} control_estimate;

/* What the Raptor reports that control needs. */
typedef struct control_feedback {
    float wheel_speed;         /* m/s, mean of the undriven wheels */
    float engine_speed;        /* rad/s */
    float road_wheel_angle;    /* rad, from the averaged motor angle */
    float brake_pressure;      /* Pa, front */
    uint8_t gear;              /* 0..6 */
    uint8_t gear_shift_status; /* 1 ready, 3 upshift, 4 downshift */
    bool engine_running;
} control_feedback;

/* Everything that one control step reads. */
typedef struct control_input {
    const trajectory *plan; /* newest complete plan, or null */
    control_estimate estimate;
    control_feedback feedback;
    const wall_polynomial *wall; /* newest, or null; counts while it is not older than its time-out */
    uint32_t wall_count;         /* changes with every new wall */
    uint16_t wall_age_ms;
    uint16_t wall_timeout_ms;
    float max_speed;        /* m/s, in force now */
    float max_acceleration; /* m/s2 */
    float max_deceleration; /* m/s2, positive */
    uint8_t lateral;        /* enum control_lateral: whose command leaves */
    bool drive_enabled;     /* false: throttle 0, integrators held at rest, holding brake */
    bool safe_stop;         /* stop along the planned path at max_deceleration */
} control_input;

/* Commands, and the errors behind them. */
typedef struct control_output {
    float road_wheel_angle[CONTROL_LATERAL_COUNT]; /* rad, every controller's own wish */
    float road_wheel_command;                      /* rad, the chosen one, limited */
    float throttle;                                /* 0..1 */
    float brake_pressure;                          /* Pa */
    uint8_t gear;                                  /* 0..6 */
    float cross_track_error;                       /* m, positive: left of the path */
    float heading_error;                           /* rad */
    float speed_error;                             /* m/s, reference minus actual */
    bool lateral_valid;                            /* a path and an estimate were there */
    bool emergency_valid;                          /* a wall was there, which is all that CONTROL_EMERGENCY needs */
} control_output;

/* State of control. Zero it, or control_init. */
typedef struct control {
    motion_predictor predictor;
    lateral_lqr lqr;
    emergency emergency;
    longitudinal speed;
    gear_shift gear;
    float road_wheel_command; /* rad, last command */
    float rounding;           /* rad, part of earlier commands that the wire's step has withheld */
} control;

/* Straight wheels, neutral, standing. */
void control_init(control *self);

/* One period of control, called at 100 Hz. Without a plan or an estimate the wheels keep their angle and the car is
 * braked at max_deceleration, which it is beyond the last point of a plan, too; below walking pace the wheels keep
 * their angle too, as they do when the chosen controller is CONTROL_NONE, or has no finite answer. CONTROL_EMERGENCY
 * takes nothing from plan and estimate: it follows the wall, and stops at EMERGENCY_DECELERATION at most.
 * The road wheel command is rounded to the step of steering_cmd, and what rounding withholds is carried over, so that
 * its mean is exact. input, output: not null. Whatever the input holds, all commands are finite and inside their
 * ranges; road_wheel_angle is as its controller computed it. */
void control_step(control *self, const control_input *input, control_output *output);

#endif
