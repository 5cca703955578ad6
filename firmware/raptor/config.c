#include "raptor/config.h"

const raptor_config raptor_config_default = {
    .command_timeout_ms = 100,   /* ten periods, the figure of public drive-by-wire kits */
    .ct_report_timeout_ms = 200, /* four periods of ct_report */
    .gear_timeout_ms = 500,
    .implausible_limit = 3,
    .ct_inconsistent_us = 200000, /* ct_report travels every 50 ms, and an answer to sys_state takes one more */
    .pedal_conflict_us = 500000,
    .pedal_conflict_throttle = 0.10f,
    .pedal_conflict_brake = 5.0e5f,
    .steer_jump = 1.575160f, /* 90 deg and half a bit: 6 deg at the wheels within 10 ms is no driver's wish */

    .power_on_us = 500000,
    .crank_check_us = 200000,
    .crank_check_limit_us = 2000000,
    .crank_limit_us = 5000000,
    .engine_settle_us = 300000,
    .engine_idle_minimum = 73.3f, /* 700 rpm */
    .battery_minimum = 10.5f,
    .battery_maximum = 16.0f,
    .standstill_speed = 0.5f,

    .test_steer = 0.523599f,           /* 30 deg */
    .test_steer_tolerance = 0.069813f, /* 4 deg */
    .test_brake = 2.5e6f,
    .test_brake_release = 5.0e5f, /* still holds the car on the grade of a race track */
    .test_brake_required = 2.0e6f,
    .test_brake_tolerance = 3.0e5f,
    .test_settle_us = 100000,
    .test_step_limit_us = 1500000,

    .brake_hold = 2.0e6f,
    .brake_axle_share = {1.0f, 0.46f / 0.54f}, /* the front line gets the full pressure */
    .brake_out_of_spec = 4.0e5f,
    .brake_out_of_spec_share = 0.15f,
    .brake_settled_band = 1.0e5f,
    .brake_settle_us = 500000,
    .brake_fault_us = 200000,

    .engine_low_speed = 41.9f, /* 400 rpm */
    .engine_low_us = 300000,

    .shift_interval_us = 300000,

    .position_timeout_ms = 50,
    .status_timeout_ms = 200,
    .error_timeout_ms = 500,
    .space_drive_lost_us = 50000,

    .rolling_radius = {0.2958f, 0.3099f},
};
