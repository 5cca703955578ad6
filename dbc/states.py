"""Codes that scenarios name: states of the car's computers and flags of race control.

The names are those of the DBC files' value tables; a contract test holds both equal.
"""

from __future__ import annotations

from enum import IntEnum


class SysState(IntEnum):
    """State of the Raptor, misc_report.sys_state."""

    NONE = 0
    PWR_ON = 1
    SUBSYS_CON = 2
    ACT_TESTING = 3
    ACT_TEST_PASSED = 4
    CRANKREADY = 5
    CRANK_CHECKS_PASSED = 6
    CRANKING = 7
    ENG_IDLE = 8
    DRIVING = 9
    SHUT_ENG = 10
    PWR_OFF = 11
    RAPTOR_OFF = 12
    CRANK_CHECK_INIT = 13
    ACT_TEST_FAIL = 14
    CRANK_CHECKS_FAIL = 15
    EMERGENCY_SHUTDOWN = 16
    ENG_FAILED_TO_START = 17
    CRITICAL_LIMIT_EXCEEDED = 18
    STANDBY = 19
    INVALID = 255


class CtState(IntEnum):
    """State of the onboard computer, ct_report.ct_state."""

    UNINITIALISED = 0
    PWR_ON = 1
    INITIALIZED = 2
    ACT_TEST = 3
    CRANKREADY = 4
    CRANKING = 5
    RACEREADY = 6
    INIT_DRIVING = 7
    CAUTION = 8
    NOM_RACE = 9
    COORD_STOP = 10
    CNTRL_SHUTDOWN = 11
    EMRG_SHUTDOWN = 12
    DEFAULT = 255


class SsmState(IntEnum):
    """State of the System Status Manager, ssm_status.ssm_state."""

    BOOT = 0
    CONFIG_CHECK = 1
    LAUNCHING = 2
    NOMINAL = 3
    DEGRADED = 4
    EMERGENCY = 5
    FULL_BRAKE = 6


class TrackFlag(IntEnum):
    """Flag for the whole track, MyLaps code, base_to_car_summary.track_flag."""

    UNKNOWN = 0
    RED = 1
    ORANGE = 2
    YELLOW = 3
    GREEN = 4
    WAVING_GREEN = 8


class VehicleFlag(IntEnum):
    """Flag for this car, MyLaps code, base_to_car_summary.veh_flag."""

    NONE = 0
    NONE_ALT = 1
    BLACK = 2
    CHEQUERED = 4
    DEFENDER = 5
    ATTACKER = 7
    PURPLE = 8
