/* System Status Manager: the car's state of health, the reaction in force, and the limits that follow from it.
 *
 * Pure: it sees conditions and verdicts, never a frame. A zeroed SSM is BOOT, which is full brake.
 */
#ifndef RACELOOP_OBC_SSM_H
#define RACELOOP_OBC_SSM_H

#include <stdbool.h>
#include <stdint.h>

#include "obc/fault_monitor.h"

/* States; the numbers are those of ssm_status.ssm_state. */
enum ssm_state {
    SSM_BOOT = 0,         /* full brake */
    SSM_CONFIG_CHECK = 1, /* full brake; waits for a configuration and its verdict */
    SSM_LAUNCHING = 2,    /* full brake; nodes may start */
    SSM_NOMINAL = 3,
    SSM_DEGRADED = 4,   /* lower limits by fault, or a backup controller */
    SSM_EMERGENCY = 5,  /* stops along the path or beside the wall, then holds */
    SSM_FULL_BRAKE = 6, /* until restart */
};

/* Limits for planning and control. SI units, all positive. */
typedef struct ssm_limits {
    float max_speed;
    float max_acceleration;
    float max_deceleration;
} ssm_limits;

/* Everything that one step reads. */
typedef struct ssm_input {
    const fault_conditions *conditions; /* not null */
    ssm_limits nominal;
    ssm_limits degraded;   /* with no fault that leaves less */
    uint64_t now_us;       /* monotonic */
    uint8_t verdict;       /* enum parameter_verdict */
    bool degraded_allowed; /* false: what would degrade stops the car instead */
    bool launch_wanted;    /* the operator's last word, however old */
    bool driving;          /* control moves the car */
    bool standing_still;
    bool wall_followed; /* CONTROL_EMERGENCY has a wall to stop beside */
} ssm_input;

/* What is in force. A zeroed output is full brake. */
typedef struct ssm_output {
    ssm_limits limits;     /* zero unless NOMINAL or DEGRADED; max_deceleration holds in EMERGENCY too */
    uint8_t state;         /* enum ssm_state */
    uint8_t reaction;      /* enum fault_reaction */
    uint8_t worst_fault;   /* enum fault_id behind the reaction */
    uint8_t active_faults; /* number */
    uint8_t controller;    /* enum control_lateral that steers, from NOMINAL on; a full brake is steered as well */
    bool drive_allowed;    /* anything but the full brake may be commanded */
    bool safe_stop;        /* stop along the path, or beside the wall when CONTROL_EMERGENCY steers */
} ssm_output;

/* State: zero it to start. */
typedef struct ssm {
    fault_monitor faults;
    uint8_t state; /* enum ssm_state */
    bool launch_was_wanted;
} ssm;

/* One 10 ms cycle. All pointers not null. */
void ssm_step(ssm *self, const ssm_input *input, ssm_output *output);

#endif
