/* Drive-by-wire commands: the gate through which every command passes, and its encoding on CAN1.
 *
 * Deny by default: a command of control leaves only if the demand says that control drives, and only finite and inside
 * the limits; anything else becomes brake. Throttle and brake never leave together. A zeroed demand is a full brake.
 */
#ifndef RACELOOP_OBC_DBW_COMMAND_H
#define RACELOOP_OBC_DBW_COMMAND_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"

#define DBW_FULL_BRAKE_PA 4.5e6f /* brake pressure of a full brake before any configuration */

/* What the car's state allows to leave. */
enum dbw_mode {
    DBW_FULL_BRAKE = 0,
    DBW_HOLD = 1,  /* holding brake, no throttle */
    DBW_DRIVE = 2, /* control's commands */
};

/* Bits that dbw_command_step returns: the command that was not finite. */
enum dbw_violation {
    DBW_VIOLATION_STEERING = 1,
    DBW_VIOLATION_THROTTLE = 2,
    DBW_VIOLATION_BRAKE = 4,
};

/* Limits and constants from the parameters in force. SI units. */
typedef struct dbw_limits {
    float full_brake_pressure;    /* Pa, nobody steers */
    float steered_brake_pressure; /* Pa, a full brake while a controller steers */
    float holding_brake_pressure; /* Pa */
    float steering_limit;         /* rad at the road wheel, either side */
    float steering_slew;          /* rad/s */
    float steering_ratio;         /* motor angle over road-wheel angle */
    float throttle_limit;         /* 0..1 */
    uint8_t traction_aim;         /* 0..15 */
    uint8_t traction_range;       /* 0..15 */
} dbw_limits;

/* What is wanted in this cycle. */
typedef struct dbw_demand {
    uint8_t mode; /* enum dbw_mode; unknown: full brake */
    bool steer;   /* road_wheel_angle is to be followed; false: the last command is held, at first the wheels' own */
    bool wheels_follow; /* what is steered; then a full brake is one that should not lock them */
    bool standing_still;
    float road_wheel_angle;     /* rad, left positive */
    float wheels_found;         /* rad, where the wheels are, when wheels_known */
    bool wheels_known;          /* the Raptor reports them */
    float throttle;             /* 0..1 */
    float brake_pressure;       /* Pa */
    uint8_t gear;               /* 0..6 */
    float acceleration[3];      /* m/s2, forward, left, up without gravity */
    uint8_t marelli_track_flag; /* flags to acknowledge */
    uint8_t marelli_vehicle_flag;
    uint8_t marelli_sector_flag;
} dbw_demand;

/* What ct_report says. */
typedef struct dbw_ct_report {
    uint8_t ct_state;
    uint8_t track_flag; /* flags to acknowledge */
    uint8_t vehicle_flag;
    uint8_t vehicle_number;
} dbw_ct_report;

/* State: zero it to start. */
typedef struct dbw_command {
    float road_wheel_angle; /* last one commanded, rad */
    bool wheels_taken_over; /* the first command was where the wheels were found */
    float throttle;         /* last one commanded, 0..1 */
    float brake_pressure;   /* last one commanded, Pa */
    uint8_t gear;           /* last one commanded */
    uint8_t gear_age;       /* cycles since gear_shift_cmd was sent */
    bool gear_sent;
    uint8_t brake_counter;
    uint8_t throttle_counter;
    uint8_t steering_counter;
    uint8_t ct_counter;
} dbw_command;

/* Send the commands of one 10 ms cycle: 1400, 1401, 1402, 1405, 1406, 1450, and 1403 on change or every 100 ms.
 * All pointers not null. Returns the enum dbw_violation bits; any of them makes this cycle a full brake. */
uint8_t dbw_command_step(dbw_command *self, const dbw_demand *demand, const dbw_limits *limits, can_outbox *out);

/* Send ct_report (1404), which is due every 50 ms. */
void dbw_command_ct_report(dbw_command *self, const dbw_ct_report *report, can_outbox *out);

#endif
