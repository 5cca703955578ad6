/* Numbers of sys_state (Raptor), ct_state (onboard computer) and the MyLaps track flags as CAN1 carries them. */
#ifndef RACELOOP_RAPTOR_STATES_H
#define RACELOOP_RAPTOR_STATES_H

/* sys_state of misc_report. The zero of a fresh state struct is NONE: nothing is allowed in it. */
enum raptor_sys {
    RAPTOR_SYS_NONE = 0,
    RAPTOR_SYS_PWR_ON = 1,
    RAPTOR_SYS_SUBSYS_CON = 2,
    RAPTOR_SYS_ACT_TESTING = 3,
    RAPTOR_SYS_ACT_TEST_PASSED = 4,
    RAPTOR_SYS_CRANKREADY = 5,
    RAPTOR_SYS_CRANK_CHECKS_PASSED = 6,
    RAPTOR_SYS_CRANKING = 7,
    RAPTOR_SYS_ENG_IDLE = 8,
    RAPTOR_SYS_DRIVING = 9,
    RAPTOR_SYS_SHUT_ENG = 10,
    RAPTOR_SYS_PWR_OFF = 11,
    RAPTOR_SYS_CRANK_CHECK_INIT = 13,
    RAPTOR_SYS_ACT_TEST_FAIL = 14,
    RAPTOR_SYS_CRANK_CHECKS_FAIL = 15,
    RAPTOR_SYS_EMERGENCY_SHUTDOWN = 16,
    RAPTOR_SYS_ENG_FAILED_TO_START = 17,
    RAPTOR_SYS_COUNT = 18,
};

/* ct_state of ct_report. */
enum raptor_ct {
    RAPTOR_CT_NONE = 0,
    RAPTOR_CT_PWR_ON = 1,
    RAPTOR_CT_INITIALIZED = 2,
    RAPTOR_CT_ACT_TEST = 3,
    RAPTOR_CT_CRANKREADY = 4,
    RAPTOR_CT_CRANKING = 5,
    RAPTOR_CT_RACEREADY = 6,
    RAPTOR_CT_INIT_DRIVING = 7,
    RAPTOR_CT_CAUTION = 8,
    RAPTOR_CT_NOM_RACE = 9,
    RAPTOR_CT_COORD_STOP = 10,
    RAPTOR_CT_CNTRL_SHUTDOWN = 11,
    RAPTOR_CT_EMRG_SHUTDOWN = 12,
    RAPTOR_CT_DEFAULT = 255,
};

/* track_flag of base_to_car_summary. */
enum raptor_track_flag {
    RAPTOR_TRACK_RED = 1,
    RAPTOR_TRACK_ORANGE = 2,
    RAPTOR_TRACK_YELLOW = 3,
    RAPTOR_TRACK_GREEN = 4,
};

#endif
