/* Control-tower state: where the car is in the run, as race control's flags and the Raptor's sys_state move it. */
#ifndef RACELOOP_OBC_CT_STATE_H
#define RACELOOP_OBC_CT_STATE_H

#include <stdbool.h>
#include <stdint.h>

/* States; the numbers are those of ct_report.ct_state. */
enum ct_state {
    CT_UNINITIALISED = 0,
    CT_PWR_ON = 1,
    CT_INITIALIZED = 2,
    CT_ACT_TEST = 3,
    CT_CRANKREADY = 4,
    CT_CRANKING = 5,
    CT_RACEREADY = 6,
    CT_INIT_DRIVING = 7,
    CT_CAUTION = 8,
    CT_NOM_RACE = 9,
    CT_COORD_STOP = 10,
    CT_CNTRL_SHUTDOWN = 11, /* terminal */
    CT_EMRG_SHUTDOWN = 12,  /* terminal */
    CT_DEFAULT = 255,
};

/* sys_state of the Raptor, as far as ct_state or the SSM looks at it. */
enum sys_state {
    SYS_ACT_TEST_PASSED = 4,
    SYS_CRANKREADY = 5,
    SYS_CRANK_CHECKS_PASSED = 6,
    SYS_ENG_IDLE = 8,
    SYS_DRIVING = 9,
    SYS_EMERGENCY_SHUTDOWN = 16,
    SYS_CRITICAL_LIMIT_EXCEEDED = 18,
};

/* Race control's flags (base_to_car_summary, MyLaps codes). */
enum race_flag {
    TRACK_FLAG_RED = 1,
    TRACK_FLAG_ORANGE = 2,
    TRACK_FLAG_YELLOW = 3,
    TRACK_FLAG_GREEN = 4,
    VEHICLE_FLAG_NONE = 0,
    VEHICLE_FLAG_NONE_ALT = 1,
    VEHICLE_FLAG_CHEQUERED = 4,
    VEHICLE_FLAG_PURPLE = 8,
};

/* Everything that one step reads. */
typedef struct ct_input {
    uint8_t sys_state;
    uint8_t track_flag;
    uint8_t vehicle_flag;
    bool raptor_alive; /* misc_report is fresh */
    bool configuration_accepted;
    bool nominal;    /* the SSM is NOMINAL */
    bool full_brake; /* the SSM is in FULL_BRAKE */
    bool standing_still;
} ct_input;

/* State after one step from `state`; at most one transition per step. */
uint8_t ct_state_next(uint8_t state, const ct_input *input);

/* True in the states in which control moves the car: CAUTION, NOM_RACE, COORD_STOP. */
bool ct_state_drives(uint8_t state);

#endif
