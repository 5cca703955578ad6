"""What is known of this car's signals beyond the DBC files: how fast they can be, and which of them belong together.

Every rule goes by names; one whose messages or signals a database does not have is left out. Numbers come from the
public protocol and the firmware; the limits are those that recordings of a sound car keep.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bridge.safety.limits import NEUTRAL_COUNTS, PEDAL_BRAKE_KPA, PEDAL_THROTTLE_PERCENT, PEDAL_US
from dbc.states import SysState
from tools.dbw.findings import Rule
from tools.dbw.relations import Condition, Pair, Relation, Source

#: Ends of the Space Drive's counts; a neutral's worth of counts is one way to the stop.
STEER_STOP_DEG = 240.0
BRAKE_STOP_KPA = 6000.0

#: Of the pressure in the front line, what the rear line gets.
REAR_SHARE = 0.46 / 0.54

#: Error of a brake line that the Raptor allows: so much, and such a part of the pressure asked for.
BRAKE_ERROR_KPA = 400.0
BRAKE_ERROR_SHARE = 0.15

#: Deviation of one of three sensors that the Space Drive allows, and for how long.
STEER_DEVIATION_DEG = 5.0
BRAKE_DEVIATION_KPA = 300.0
DEVIATION_US = 100_000

#: The largest steering slew that the onboard computer takes as a parameter, 1 rad/s, at 15 motor per road-wheel angle.
STEERING_CMD_DEG_S = 859.5

#: The steering motor does 500 deg/s and the brake 180,000 kPa/s; half of that again is for the clocks of loggers.
STEERING_REPORT_DEG_S = 750.0
BRAKE_REPORT_KPA_S = 270_000.0

_COUNTS_PER_DEG = NEUTRAL_COUNTS / STEER_STOP_DEG
_COUNTS_PER_KPA = NEUTRAL_COUNTS / BRAKE_STOP_KPA
_CHANNELS = (1, 2, 3)
_TYRES = ("FL", "FR", "RL", "RR")

#: By message and signal: largest change per second. The brake command has none: full brake comes at once. A wheel that
#: locks stops within a tenth of a second; a receiver moves with the car, 0.001 deg of latitude is 111 m.
SLEW_LIMITS: Mapping[tuple[str, str], float] = {
    ("steering_cmd", "steering_motor_ang_cmd"): STEERING_CMD_DEG_S,
    ("steering_report", "steering_motor_ang_avg_fdbk"): STEERING_REPORT_DEG_S,
    **{("steering_report_extd", f"steering_motor_ang_{i}_fdbk"): STEERING_REPORT_DEG_S for i in _CHANNELS},
    **{
        (f"calb_steer_pos_{i}", f"cur_steer_pos_steering_pos_{i}"): STEERING_REPORT_DEG_S * _COUNTS_PER_DEG
        for i in _CHANNELS
    },
    **{
        (f"calb_brake_pos_{i}", f"cur_brake_pos_brake_pos_{i}"): BRAKE_REPORT_KPA_S * _COUNTS_PER_KPA for i in _CHANNELS
    },
    ("brake_pressure_report", "brake_pressure_fdbk_front"): BRAKE_REPORT_KPA_S,
    ("brake_pressure_report", "brake_pressure_fdbk_rear"): BRAKE_REPORT_KPA_S,
    **{("wheel_speed_report", f"wheel_speed_{tyre}"): 3000.0 for tyre in _TYRES},
    ("pt_report_1", "vehicle_speed_kmph"): 3000.0,
    ("pt_report_1", "engine_speed_rpm"): 100_000.0,
    **{
        (f"Tire_Temp_{tyre}_{part}", f"{tyre}_Tire_Temp_{4 * (part - 1) + i:02d}"): 50.0
        for tyre in _TYRES
        for part in range(1, 5)
        for i in range(1, 5)
    },
    **{
        (f"gnss_{one}_position", f"gnss_{one}_{axis}"): 0.002
        for one in ("a", "b")
        for axis in ("latitude", "longitude")
    },
    ("marelli_report_2", "marelli_gps_lat"): 0.002,
    ("marelli_report_2", "marelli_gps_long"): 0.002,
    ("mylaps_report_2", "Latitude"): 0.002,
    ("mylaps_report_2", "Longitude"): 0.002,
}

#: By message and signal: what has to change, within how many us.
MOVING: Mapping[tuple[str, str], int] = {
    ("base_to_car_summary", "base_to_car_heartbeat"): 1_000_000,
    ("base_to_car_timing", "time_stamp"): 1_000_000,
}

#: Whose value 0 is none.
SETTINGS = (("ct_report", "veh_num"),)


def _counts_of_deg(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return NEUTRAL_COUNTS + np.clip(angle, -STEER_STOP_DEG, STEER_STOP_DEG) * _COUNTS_PER_DEG


def _deg_of_counts(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    return (counts - NEUTRAL_COUNTS) / _COUNTS_PER_DEG


def _counts_of_kpa(pressure: NDArray[np.float64]) -> NDArray[np.float64]:
    return NEUTRAL_COUNTS - np.clip(pressure, 0.0, BRAKE_STOP_KPA) * _COUNTS_PER_KPA


def _kpa_of_counts(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    return (NEUTRAL_COUNTS - counts) / _COUNTS_PER_KPA


def _rear_of_counts(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    return _kpa_of_counts(counts) * REAR_SHARE


def _rear_of_front(pressure: NDArray[np.float64]) -> NDArray[np.float64]:
    return pressure * REAR_SHARE


def _mean(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    return (left + right) / 2.0


def _mean_ms(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    return (left + right) / 7.2


def _volts(millivolts: NDArray[np.float64]) -> NDArray[np.float64]:
    return millivolts / 1000.0


def _gauge(absolute: NDArray[np.float64]) -> NDArray[np.float64]:
    return absolute - 1013.0


#: The Raptor does what the onboard computer commands in this state only; it is in it for a tenth of a second.
_DRIVING = Condition("misc_report", "sys_state", SysState.DRIVING, SysState.DRIVING)
_STEADY_US = 100_000

#: Time for a value to get through a station with a cycle of 10 ms, in lock step or in processes of their own.
_PASSING_US = 50_000

_STEERING_CMD = ("steering_cmd", ("steering_motor_ang_cmd",))
_BRAKE_CMD = ("brake_pressure_cmd", ("brake_pressure_cmd",))
_STEERING_REQUEST = ("req_steer_pos", ("cntrl_pos",))
_BRAKE_REQUEST = ("req_brake_pos", ("contrl_pos_brk",))
_FRONT_WHEELS = ("wheel_speed_report", ("wheel_speed_FL", "wheel_speed_FR"))

#: Commands through the Raptor to the Space Drive.
_RELAYED = (
    Relation(
        Rule.RELAY,
        "req_steer_pos",
        "cntrl_pos",
        "steering_cmd asks for",
        sources=(Source(*_STEERING_CMD, _counts_of_deg),),
        window_us=_PASSING_US,
        exact=True,
        conditions=(_DRIVING,),
        steady_us=_STEADY_US,
        least=3,
    ),
    Relation(
        Rule.RELAY,
        "req_brake_pos",
        "contrl_pos_brk",
        "brake_pressure_cmd asks for",
        sources=(Source(*_BRAKE_CMD, _counts_of_kpa),),
        window_us=_PASSING_US,
        exact=True,
        conditions=(_DRIVING,),
        steady_us=_STEADY_US,
        least=3,
    ),
    Relation(
        Rule.RELAY,
        "accelerator_report",
        "acc_pedal_fdbk",
        "accelerator_cmd asks for",
        sources=(Source("accelerator_cmd", ("acc_pedal_cmd",)),),
        window_us=_PASSING_US,
        exact=True,
        conditions=(_DRIVING, Condition("brake_pressure_cmd", "brake_pressure_cmd", 0.0, 0.0)),
        steady_us=_STEADY_US,
        least=3,
    ),
    Relation(
        Rule.RELAY,
        "req_steer_pos",
        "veh_speed",
        "pt_report_1 says, in km/h,",
        sources=(Source("pt_report_1", ("vehicle_speed_kmph",)),),
        window_us=100_000,
        tolerance=1.0,
        least=3,
    ),
    *(
        Relation(
            Rule.RELAY,
            f"stat_brk_{i}",
            "curr_ip_dvc_pos",
            "req_brake_pos asks for",
            sources=(Source(*_BRAKE_REQUEST),),
            window_us=_PASSING_US,
            exact=True,
            least=3,
        )
        for i in _CHANNELS
    ),
    *(
        Relation(
            Rule.RELAY,
            "pt_report_3",
            f"driver_traction_{reported}_fbk",
            "dash_switches_cmd says",
            sources=(Source("dash_switches_cmd", (f"driver_traction_{sent}",)),),
            window_us=300_000,
            exact=True,
            least=2,
        )
        for reported, sent in (("aim_swicth", "aim_switch"), ("range_switch", "range_switch"))
    ),
)

#: What the Space Drive measures, through the Raptor.
_MEASURED = (
    *(
        Relation(
            Rule.RELAY,
            "steering_report_extd",
            f"steering_motor_ang_{i}_fdbk",
            f"calb_steer_pos_{i} is",
            sources=(Source(f"calb_steer_pos_{i}", (f"cur_steer_pos_steering_pos_{i}",), _deg_of_counts),),
            window_us=_PASSING_US,
            exact=True,
            conditions=(Condition(f"calb_steer_pos_{i}", "plausibity", 0.0, 0.0),),
            least=3,
        )
        for i in _CHANNELS
    ),
    Relation(
        Rule.AGREEMENT,
        "steering_report",
        "steering_motor_ang_avg_fdbk",
        "beyond all three sensors of steering_report_extd, the third one at",
        sources=tuple(Source("steering_report_extd", (f"steering_motor_ang_{i}_fdbk",)) for i in _CHANNELS),
        at="steering_report_extd",
        lead_us=0,
        least=3,
    ),
    *(
        Relation(
            Rule.AGREEMENT,
            f"calb_{axis}_pos_{i}",
            f"cur_{axis}_pos_{name}_pos_{i}",
            "beyond both of the other channels, the last one at",
            sources=tuple(
                Source(f"calb_{axis}_pos_{other}", (f"cur_{axis}_pos_{name}_pos_{other}",))
                for other in _CHANNELS
                if other != i
            ),
            window_us=20_000,
            tolerance=tolerance,
            conditions=tuple(Condition(f"calb_{axis}_pos_{other}", "plausibity", 0.0, 0.0) for other in _CHANNELS),
            lasting_us=DEVIATION_US,
        )
        for axis, name, tolerance in (
            ("steer", "steering", STEER_DEVIATION_DEG * _COUNTS_PER_DEG),
            ("brake", "brake", BRAKE_DEVIATION_KPA * _COUNTS_PER_KPA),
        )
        for i in _CHANNELS
    ),
)

#: Whether the car does what was asked for; each where the request to the Space Drive is in the recording, and where
#: only the command is. A command is followed within the delay and the rise of its actuator.
_FOLLOWED = tuple(
    Relation(
        Rule.AGREEMENT,
        message,
        signal,
        f"{source.message} has asked for",
        sources=(source,),
        window_us=1_000_000,
        tolerance=tolerance,
        share=share,
        conditions=conditions,
        least=3,
        lasting_us=30_000,
    )
    for message, signal, tolerance, share, request, command in (
        (
            "steering_report",
            "steering_motor_ang_avg_fdbk",
            STEER_DEVIATION_DEG,
            0.0,
            Source(*_STEERING_REQUEST, _deg_of_counts),
            Source(*_STEERING_CMD),
        ),
        (
            "brake_pressure_report",
            "brake_pressure_fdbk_front",
            BRAKE_ERROR_KPA,
            BRAKE_ERROR_SHARE,
            Source(*_BRAKE_REQUEST, _kpa_of_counts),
            Source(*_BRAKE_CMD),
        ),
        (
            "brake_pressure_report",
            "brake_pressure_fdbk_rear",
            BRAKE_ERROR_KPA,
            BRAKE_ERROR_SHARE,
            Source(*_BRAKE_REQUEST, _rear_of_counts),
            Source(*_BRAKE_CMD, _rear_of_front),
        ),
    )
    for source, conditions in ((request, ()), (command, (_DRIVING,)))
)

_SPEEDS = (
    Relation(
        Rule.AGREEMENT,
        "pt_report_1",
        "vehicle_speed_kmph",
        "the front wheels have",
        sources=(Source(*_FRONT_WHEELS, _mean),),
        window_us=_PASSING_US,
        tolerance=5.0,
        share=0.1,
        least=10,
    ),
    Relation(
        Rule.AGREEMENT,
        "vehicle_status",
        "obc_wheel_speed",
        "the front wheels have, in m/s,",
        sources=(Source(*_FRONT_WHEELS, _mean_ms),),
        window_us=100_000,
        tolerance=0.5,
        least=3,
    ),
    Relation(
        Rule.AGREEMENT,
        "ct_vehicle_acc_feedback",
        "vertical_ct_vehicle_acc_fbk",
        "gravity is in it: the car stands",
        limits=(-0.5, 0.5),
        conditions=(Condition("wheel_speed_report", "wheel_speed_FL", 0.0, 0.0),),
        steady_us=1_000_000,
        least=10,
    ),
    Relation(
        Rule.AGREEMENT,
        "misc_report",
        "battery_voltage",
        "stat_brk_1 has, in V,",
        sources=(Source("stat_brk_1", ("main_batt_curr_volt_val",), _volts),),
        window_us=200_000,
        tolerance=1.0,
        least=10,
    ),
    *(
        Relation(
            Rule.AGREEMENT,
            f"Tire_Pressure_{tyre}",
            f"{tyre}_Tire_Pressure_Gauge",
            "the absolute pressure less that of the air is",
            sources=(Source(f"Tire_Pressure_{tyre}", (f"{tyre}_Tire_Pressure",), _gauge),),
            lead_us=0,
            tolerance=250.0,
            least=3,
        )
        for tyre in _TYRES
    ),
)

_PEDALS = (
    Relation(
        Rule.PEDALS,
        "accelerator_cmd",
        "acc_pedal_cmd",
        f"brake_pressure_cmd is above {PEDAL_BRAKE_KPA:g} kPa, and both may be pressed for {PEDAL_US / 1e6:g} s",
        limits=(-np.inf, PEDAL_THROTTLE_PERCENT),
        conditions=(Condition("brake_pressure_cmd", "brake_pressure_cmd", PEDAL_BRAKE_KPA + 0.5, np.inf),),
        lasting_us=PEDAL_US,
    ),
)

#: Flags and states that a station repeats: message, signal, of which message and signal, and how long it may take, us.
_ECHOES = (
    (Rule.ACKNOWLEDGEMENT, "ct_report", "veh_sig_ack", "base_to_car_summary", "veh_flag", 200_000),
    (Rule.ACKNOWLEDGEMENT, "ct_report", "track_cond_ack", "base_to_car_summary", "track_flag", 200_000),
    *(
        (Rule.ACKNOWLEDGEMENT, "ct_report_2", f"marelli_{flag}_ack", "marelli_report_1", f"marelli_{flag}", 100_000)
        for flag in ("track_flag", "vehicle_flag", "sector_flag")
    ),
    (Rule.RELAY, "vehicle_status", "obc_sys_state", "misc_report", "sys_state", 100_000),
    (Rule.RELAY, "vehicle_status", "obc_gear", "pt_report_1", "current_gear", 100_000),
    (Rule.RELAY, "vehicle_status", "obc_track_flag", "base_to_car_summary", "track_flag", 100_000),
    (Rule.RELAY, "vehicle_status", "obc_veh_flag", "base_to_car_summary", "veh_flag", 100_000),
    (Rule.RELAY, "vehicle_status", "obc_round_target_speed", "base_to_car_summary", "round_target_speed", 100_000),
    (Rule.RELAY, "ct_report", "ct_state", "vehicle_status", "obc_ct_state", 100_000),
    (Rule.RELAY, "base_to_car_timing", "laps", "base_to_car_summary", "lap_count", 300_000),
)
#: A flag whose first frame the recording has lost is known again after a cycle of 100 ms, of which half a cycle counts.
_REPEATED = tuple(
    Relation(
        rule,
        message,
        signal,
        f"{source} says",
        sources=(Source(source, (of,)),),
        window_us=within_us,
        exact=True,
        least=3,
        lasting_us=60_000,
    )
    for rule, message, signal, source, of, within_us in _ECHOES
)

#: Places by receivers of their own; 0.01 deg is a kilometre.
_PLACES = tuple(
    Relation(
        Rule.AGREEMENT,
        message,
        signal,
        f"{source} has",
        sources=(Source(source, (of,)),),
        window_us=1_000_000,
        tolerance=0.01,
        least=3,
    )
    for message, axes in (
        ("marelli_report_2", (("marelli_gps_lat", "latitude"), ("marelli_gps_long", "longitude"))),
        ("mylaps_report_2", (("Latitude", "latitude"), ("Longitude", "longitude"))),
    )
    for signal, axis in axes
    for source, of in (("gnss_a_position", f"gnss_a_{axis}"),)
)

RELATIONS: tuple[Relation, ...] = (
    *_RELAYED,
    *_MEASURED,
    *_FOLLOWED,
    *_SPEEDS,
    *_PEDALS,
    *_REPEATED,
    *_PLACES,
)


def _pairs() -> tuple[Pair, ...]:
    """Each wheel with those before it, and the brake lines.

    Not wheel speeds: on a straight, or with a locked axle, they are the same.
    """
    pairs = [
        Pair(
            "brake_pressure_report",
            "brake_pressure_fdbk_rear",
            "brake_pressure_report",
            "brake_pressure_fdbk_front",
        )
    ]
    for place, tyre in enumerate(_TYRES):
        for other in _TYRES[:place]:
            pairs += [
                Pair(message, f"{name}_{tyre}", message, f"{name}_{other}")
                for message, name in (
                    ("wheel_strain_gauge", "wheel_strain_gauge"),
                    ("wheel_potentiometer_data", "wheel_potentiometer"),
                )
            ]
            pairs.append(
                Pair(
                    f"Tire_Pressure_{tyre}", f"{tyre}_Tire_Pressure", f"Tire_Pressure_{other}", f"{other}_Tire_Pressure"
                )
            )
            for part in range(1, 5):
                number = 4 * (part - 1) + 1
                pairs.append(
                    Pair(
                        f"Tire_Temp_{tyre}_{part}",
                        f"{tyre}_Tire_Temp_{number:02d}",
                        f"Tire_Temp_{other}_{part}",
                        f"{other}_Tire_Temp_{number:02d}",
                    )
                )
    return tuple(pairs)


PAIRS: tuple[Pair, ...] = _pairs()
