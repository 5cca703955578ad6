/* Everything the controllers know of the car, and the gains made from it.
 *
 * controller_tables.c is written by autonomy/controller_design.py from a vehicle file in scenarios/vehicles; do not
 * edit it by hand. A test fails when it is not what the design computes.
 */
#ifndef RACELOOP_OBC_CONTROLLER_TABLES_H
#define RACELOOP_OBC_CONTROLLER_TABLES_H

#include <stdint.h>

enum {
    CONTROLLER_SPEEDS = 31,        /* rows of the gain table */
    CONTROLLER_STATES = 7,         /* e_y, de_y/dt, e_psi, de_psi/dt, steering angle, its rate, integral of e_y */
    CONTROLLER_PREVIEW_STEPS = 16, /* path ahead that the gains look at */
    CONTROLLER_PREVIEW_TICKS = 3,  /* control periods per step */
    CONTROLLER_PREVIEW_SIGNALS = 3,
    CONTROLLER_DEAD_TICKS = 5,     /* control periods between a steering command and its first effect */
    CONTROLLER_ENGINE_SPEEDS = 32, /* rows of the engine map */
    CONTROLLER_THROTTLES = 11,     /* columns of the engine map: 0, 0.1 .. 1 */
    CONTROLLER_GEARS = 7,          /* neutral and six gears */
};

typedef struct controller_tables {
    /* Body */
    float mass;               /* kg */
    float yaw_inertia;        /* kg m2 */
    float cg_to_front;        /* m, centre of gravity to front axle */
    float cg_to_rear;         /* m */
    float gravity;            /* m/s2 */
    float drag_factor;        /* N/(m/s)2: half air density times drag area */
    float downforce_front;    /* N/(m/s)2 on the front axle */
    float downforce_rear;     /* N/(m/s)2 on the rear axle */
    float rolling_resistance; /* rolling resistance over wheel load */

    /* Tyres: cornering stiffness of an axle = peak * 2 q / (1 + q2), q = axle load / peak load */
    float stiffness_peak_front; /* N/rad */
    float stiffness_peak_rear;  /* N/rad */
    float stiffness_peak_load;  /* N, of an axle */
    float slip_stiffness;       /* longitudinal, of a cornering tyre over its load */

    /* Limited-slip differential */
    float track_rear;           /* m */
    float load_transfer_rear;   /* N from the inner to the outer wheel per N of the car's side force */
    float differential_preload; /* N m */
    float differential_ratio;   /* locking torque over axle torque */

    /* Steering, at the road wheel. One period of the actuator: next (angle, rate) = transition * (angle, rate)
     * + input * command. */
    float steer_transition[2][2];
    float steer_input[2];
    float steer_max;      /* rad */
    float steer_rate_max; /* rad/s */
    float steer_step;     /* rad, one step of steering_cmd on the wire */
    float steer_lag;      /* s, of the actuator behind its command on a ramp, without dead time */

    /* Lateral gains, rad per unit of each state; the integral's is per metre second. Row i is for speed
     * i * lqr_speed_step; the first row is at least the lowest speed of the design. */
    float lqr_speed_step; /* m/s */
    float lqr_gain[CONTROLLER_SPEEDS][CONTROLLER_STATES];

    /* Answer to the path ahead: rad per change of steady-state sideslip (rad), yaw rate (rad/s) and steering angle
     * (rad) over each step of the preview. */
    float lqr_preview[CONTROLLER_SPEEDS][CONTROLLER_PREVIEW_STEPS][CONTROLLER_PREVIEW_SIGNALS];

    /* Driveline */
    float gear_ratio[CONTROLLER_GEARS];     /* engine over wheel speed; 0 in neutral */
    float effective_mass[CONTROLLER_GEARS]; /* kg, with all that spins */
    float driveline_efficiency;
    float clutch_engage_speed; /* rad/s of the engine, below it the clutch is open */
    float driven_radius;       /* m */
    float engine_speed_step;   /* rad/s between rows of the engine map, first row at 0 */
    float engine_torque[CONTROLLER_ENGINE_SPEEDS][CONTROLLER_THROTTLES]; /* N m, rising along each row */

    /* Brakes */
    float brake_gain; /* N of brake force per Pa of the front pressure */
} controller_tables;

extern const controller_tables controller_table;

#endif
