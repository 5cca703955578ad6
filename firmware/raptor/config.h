/* Configuration of the Raptor. */
#ifndef RACELOOP_RAPTOR_CONFIG_H
#define RACELOOP_RAPTOR_CONFIG_H

#include <stdint.h>

/* All limits and times that the Raptor works with. SI units; motor angles are at the steering motor. */
typedef struct raptor_config {
    /* Supervision of the onboard computer. */
    uint16_t command_timeout_ms;   /* brake, accelerator and steering command */
    uint16_t ct_report_timeout_ms; /* ct_report whose counter moves */
    uint16_t gear_timeout_ms;      /* older gear command: the gear is held */
    uint16_t implausible_limit;    /* implausible frames in a row that are a fault */
    uint32_t ct_inconsistent_us;   /* how long ct_state may contradict sys_state */
    uint32_t pedal_conflict_us;    /* how long accelerator and brake may be pressed together */
    float pedal_conflict_throttle; /* 0..1 */
    float pedal_conflict_brake;    /* Pa */
    float steer_jump;              /* rad, largest step between two steering commands while driving */

    /* sys_state machine. */
    uint32_t power_on_us;          /* least time in PWR_ON */
    uint32_t crank_check_us;       /* how long the crank conditions must hold */
    uint32_t crank_check_limit_us; /* time for them to be met */
    uint32_t crank_limit_us;       /* starter time */
    uint32_t engine_settle_us;     /* how long the engine must run by itself */
    float engine_idle_minimum;     /* rad/s */
    float battery_minimum;         /* V, for cranking */
    float battery_maximum;         /* V */
    float standstill_speed;        /* m/s */

    /* Actuation test. */
    float test_steer;            /* rad, sweep to both sides */
    float test_steer_tolerance;  /* rad */
    float test_brake;            /* Pa, pulse */
    float test_brake_release;    /* Pa, between the pulses */
    float test_brake_required;   /* Pa, least pressure that the pulse must show */
    float test_brake_tolerance;  /* Pa */
    uint32_t test_settle_us;     /* how long the feedback must fit */
    uint32_t test_step_limit_us; /* time for a step of the test */

    /* Brake. */
    float brake_hold;              /* Pa, held outside DRIVING */
    float brake_axle_share[2];     /* pressure of front and rear line over the request, at rest */
    float brake_out_of_spec;       /* Pa, allowed error of a settled line */
    float brake_out_of_spec_share; /* of the expected pressure, allowed in addition */
    float brake_settled_band;      /* Pa, a request inside this band counts as constant */
    uint32_t brake_settle_us;      /* how long it must be constant before the lines are judged */
    uint32_t brake_fault_us;       /* how long a line may then be out of spec */

    /* Engine. */
    float engine_low_speed; /* rad/s, below: est3 */
    uint32_t engine_low_us;

    /* Gearbox. */
    uint32_t shift_interval_us; /* least time between two gear demands */

    /* Space Drive. */
    uint16_t position_timeout_ms; /* calibrated positions */
    uint16_t status_timeout_ms;   /* status frames */
    uint16_t error_timeout_ms;    /* error frames, which come five times as seldom */
    uint32_t space_drive_lost_us; /* how long an axis may be without two valid channels */

    /* Vehicle. */
    float rolling_radius[2]; /* m, front and rear */
} raptor_config;

/* Defaults; the reasons are beside the values. */
extern const raptor_config raptor_config_default;

#endif
