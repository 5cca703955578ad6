"""Every fault of the table, provoked the way it comes: by frames that stop, lie or stand still, and by time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from obc_harness import NOISY, OPERATION, OPERATIONS, ObcHarness, drop

from bridge._native import lib
from dbc.codec import MessageCodec, database
from dbc.frames import Station, iterate
from firmware.tables import REACTIONS, own_faults

FAULTS = {fault.name: fault for fault in own_faults()}
Provoke = Callable[[ObcHarness], None]


def silent(*names: str) -> Provoke:
    return lambda harness: [harness.periods.pop(name) for name in names] and None


def signal(message: str, **values: float) -> Provoke:
    return lambda harness: harness.signals[message].update(values)


def node(number: int, **changes: Any) -> Provoke:
    def apply(harness: ObcHarness) -> None:
        if "code" in changes:
            harness.node_codes[number] = changes["code"]
        if "reliability" in changes:
            harness.node_reliability[number] = changes["reliability"]
        if changes.get("frozen"):
            harness.frozen_nodes.add(number)
        if changes.get("silent"):
            harness.silent_nodes.add(number)

    return apply


def slow(prefix: str, period_us: int) -> Provoke:
    def apply(harness: ObcHarness) -> None:
        harness.periods.update({name: period_us for name in harness.periods if name.startswith(prefix)})

    return apply


def attribute(name: str, value: object) -> Provoke:
    return lambda harness: setattr(harness, name, value)


def spoil_lqr(harness: ObcHarness) -> None:
    """Memory that went bad: the integrator is not a number, and stays so."""

    def poison(frames: bytes) -> bytes:
        harness.obc.control.lqr.integral = float("nan")
        return frames

    harness.filters.append(poison)


def cost(task: int, microseconds: int) -> Provoke:
    return lambda harness: setattr(harness.obc.executive.records[task], "injected_cost_us", microseconds)


def late(harness: ObcHarness) -> None:
    def jump(frames: bytes) -> bytes:
        harness.now_us += 10_000  # every second minor frame is missed
        return frames

    harness.filters.append(jump)


def late_write(harness: ObcHarness) -> None:
    harness.extra.append(harness.message("parameter_write", write_key=1))


def also_sent(name: str) -> Provoke:
    """Somebody else sends a message of the onboard computer."""

    def apply(harness: ObcHarness) -> None:
        harness.signals[name] = {}
        harness.periods[name] = database.message(name).cycle_us

    return apply


DIAGNOSTIC = {
    "sd_failure": "sd_system_failure",
    "est1_front_brake": "est1_oos_front_brk",
    "est2_rear_brake": "est2_oos_rear_brk",
    "est3_low_engine_speed": "est3_low_eng_speed",
    "est4_sd_comms_loss": "est4_sd_comms_loss",
    "est5_motec_comms_loss": "est5_motec_comms_loss",
    "est6_sd_emergency_brake": "est6_sd_ebrake",
    "adlink_heartbeat_lost": "adlink_hb_lost",
    "raptor_lost_race_control": "rc_lost",
}
WARNING_BITS = [
    "sd_system_warning",
    *(f"sd_{axis}_warning{channel}" for axis in ("brake", "steer") for channel in (1, 2, 3)),
]
SENSORS = {
    "gnss_a": ("gnss_a_position", 100_000),
    "gnss_b": ("gnss_b_position", 100_000),
    "imu": ("imu_rates", 20_000),
}

#: Status codes that a node of a running car must not report: those of one that starts, and those of one that fails.
NOT_READY = {"initialized": 64, "inactive": 100, "not initialized": 128}
FAILED = {"error": 200, "dead": 255, "unknown": 7}

COUNTERS = {
    "brake_report_stuck": ("brake_pressure_report", "brk_pressure_fdbk_counter"),
    "accelerator_report_stuck": ("accelerator_report", "acc_pedal_fdbk_counter"),
    "steering_report_stuck": ("steering_report", "steering_motor_fdbk_counter"),
    "misc_report_stuck": ("misc_report", "raptor_rolling_counter"),
}


def frozen(*prefixes: str) -> Provoke:
    return lambda harness: harness.frozen_sensors.update(prefixes)


def frozen_position(receiver: str) -> Provoke:
    """The receiver repeats a position that lies where the car is, and the car drives on."""

    def apply(harness: ObcHarness) -> None:
        name = f"{receiver}_position"
        harness.signals[name] = harness.world(name)

    return apply


def lead_lqr_astray(harness: ObcHarness) -> None:
    """An integrator that holds a turn of its own, finite and steady."""

    def bias(frames: bytes) -> bytes:
        harness.obc.control.lqr.integral = 0.06
        return frames

    harness.filters.append(bias)


def slow_down(report: str, **values: float) -> Provoke:
    """The plan asks for a halt, and this report stays as it is."""

    def apply(harness: ObcHarness) -> None:
        harness.plan_speed = 0.0
        harness.signals[report].update(values)

    return apply


def node_cases(number: int, name: str) -> list[tuple[str, str, Provoke]]:
    """All ways in which a node is not what it should be."""
    return [
        *((f"{name}_not_ok", word, node(number, code=code)) for word, code in NOT_READY.items()),
        *((f"{name}_failed", word, node(number, code=code)) for word, code in FAILED.items()),
        (f"{name}_failed", "silent", node(number, silent=True)),
        (f"{name}_stalled", "frozen", node(number, frozen=True)),
        (f"{name}_low_reliability", "low", node(number, reliability=49.5)),
    ]


def scan(sensor: int, **values: float) -> Provoke:
    return lambda harness: harness.scans[sensor].update(values)


def scan_cases(sensor: int, name: str, too_small: float) -> list[tuple[str, str, Provoke]]:
    """All ways in which the scans of a sensor are not what they should be."""
    return [
        (f"{name}_timeout", "silent", lambda harness: harness.scans.pop(sensor) and None),
        (f"{name}_timeout", "old", scan(sensor, sensor_sample_age=151)),
        (f"{name}_low_rate", "slow", lambda harness: harness.scan_periods.update({sensor: 100_000})),
        (f"{name}_wrong_size", "small", scan(sensor, sensor_data_size=too_small)),
        (f"{name}_frozen", "sequence", lambda harness: harness.frozen_scans.add(sensor)),
    ]


CASES: list[tuple[str, str, Provoke]] = [
    ("parameter_write_late", "write", late_write),
    ("executive_overrun", "cost", cost(lib.OBC_TASK_STATUS, 11_000)),
    ("executive_late", "missed", late),
    ("launch_withdrawn", "withdrawn", signal("launch_request", launch_wanted=0)),
    ("launch_withdrawn", "silent", silent("launch_request")),
    *((f"{s}_timeout", "silent", silent(first)) for s, (first, _) in SENSORS.items()),
    *((f"{s}_low_rate", "slow", slow(s, period)) for s, (_, period) in SENSORS.items()),
    ("gnss_a_wrong_size", "short", silent("gnss_a_attitude")),
    ("gnss_b_wrong_size", "short", silent("gnss_b_quality")),
    ("imu_wrong_size", "short", silent("imu_specific_force")),
    *node_cases(0, "estimation"),
    *node_cases(1, "planning"),
    *node_cases(2, "wall"),
    ("estimate_degraded", "level", signal("estimate_quality", estimate_quality_level=2)),
    ("estimate_bad", "level", signal("estimate_quality", estimate_quality_level=1)),
    ("estimate_lost", "level", signal("estimate_quality", estimate_quality_level=0)),
    ("estimate_lost", "position", silent("estimate_position")),
    ("estimate_lost", "motion", silent("estimate_motion")),
    ("estimate_lost", "quality", silent("estimate_quality")),
    ("plan_stale", "silent", attribute("planning", False)),
    ("plan_stale", "incomplete", lambda harness: harness.filters.append(drop("trajectory_header"))),
    ("wall_missing", "silent", silent("wall_line")),
    ("wall_missing", "half", silent("wall_bend")),
    ("wall_missing", "none found", signal("wall_line", wall_order=0)),
    ("path_left", "offset", signal("estimate_position", estimate_y=3.5)),
    ("command_invalid", "memory", lambda harness: setattr(harness.obc, "dbw_violations", lib.DBW_VIOLATION_THROTTLE)),
    ("lqr_invalid", "nan", spoil_lqr),
    ("control_late", "cost", cost(lib.OBC_TASK_CONTROL, 2_000)),
    ("lateral_acceleration_high", "spin", signal("estimate_motion", estimate_yaw_rate=3.0)),
    ("wheel_speed_missing", "silent", silent("wheel_speed_report")),
    ("brake_report_missing", "silent", silent("brake_pressure_report")),
    ("brake_report_missing", "stuck", signal("brake_pressure_report", brk_pressure_fdbk_counter=7)),
    ("steering_report_missing", "silent", silent("steering_report")),
    ("steering_report_missing", "stuck", signal("steering_report", steering_motor_fdbk_counter=7)),
    ("misc_report_missing", "silent", silent("misc_report")),
    ("misc_report_missing", "stuck", signal("misc_report", raptor_rolling_counter=7)),
    ("powertrain_report_missing", "silent", silent("pt_report_1")),
    ("diagnostic_report_missing", "silent", silent("diagnostic_report")),
    ("raptor_emergency", "shutdown", signal("misc_report", sys_state=16)),
    ("raptor_emergency", "critical", signal("misc_report", sys_state=18)),
    *(("sd_warning", bit, signal("diagnostic_report", **{bit: 1})) for bit in WARNING_BITS),
    ("motec_warning", "value", signal("diagnostic_report", motec_warning=3)),
    *((fault, bit, signal("diagnostic_report", **{bit: 1})) for fault, bit in DIAGNOSTIC.items()),
    ("raptor_emergency", "restarted", signal("misc_report", sys_state=1)),
    ("raptor_emergency", "engine off", signal("misc_report", sys_state=10)),
    ("race_control_lost", "silent", silent("base_to_car_summary")),
    ("second_computer", "commands", also_sent("brake_pressure_cmd")),
    ("second_computer", "reports", also_sent("ssm_status")),
    ("computer_stopping", "told", lambda harness: lib.obc_stop(harness.obc)),
    ("race_control_lost", "frozen", signal("base_to_car_summary", base_to_car_heartbeat=3)),
    *(
        case
        for receiver in ("gnss_a", "gnss_b")
        for case in (
            (f"{receiver}_frozen", "position", frozen_position(receiver)),
            (f"{receiver}_frozen", "velocity", frozen(f"{receiver}_velocity")),
            (f"{receiver}_frozen", "attitude", frozen(f"{receiver}_attitude")),
            (f"{receiver}_jump", "position", signal(f"{receiver}_position", **{f"{receiver}_latitude": 5e-5})),
        )
    ),
    ("imu_frozen", "rates", frozen("imu_rates")),
    ("imu_frozen", "force", frozen("imu_specific_force")),
    ("imu_jump", "rate", signal("imu_rates", imu_yaw_rate=-1.5)),
    ("imu_jump", "force", signal("imu_specific_force", imu_specific_force_y=35.0)),
    ("lqr_diverging", "integrator", lead_lqr_astray),
    ("accelerator_report_missing", "silent", silent("accelerator_report")),
    *((fault, "counter", signal(report, **{counter: 7})) for fault, (report, counter) in COUNTERS.items()),
    ("steering_implausible", "turned", signal("steering_report", steering_motor_ang_avg_fdbk=60.0)),
    ("brake_implausible", "drags", signal("brake_pressure_report", brake_pressure_fdbk_front=2500)),
    ("brake_implausible", "weak", slow_down("brake_pressure_report", brake_pressure_fdbk_front=0)),
    ("throttle_implausible", "asked", slow_down("accelerator_report", acc_pedal_fdbk=40.0)),
    ("throttle_implausible", "stuck open", slow_down("pt_report_1", throttle_position=40.0)),
    ("gear_implausible", "stays", signal("pt_report_1", current_gear=5)),
    ("wheel_speed_implausible", "stand", signal("wheel_speed_report", wheel_speed_FL=0.0, wheel_speed_FR=0.0)),
    ("wheel_speed_implausible", "spin", signal("wheel_speed_report", wheel_speed_FL=90.0, wheel_speed_FR=90.0)),
]

#: Those of a car that has to see others, which a car that drives alone does not know.
PERCEPTION_CASES = [
    *scan_cases(3, "lidar", 19_999),
    *scan_cases(4, "radar", 63),
    ("radar_wrong_size", "large", scan(4, sensor_data_size=65)),
    *node_cases(3, "lidar_detection"),
    *node_cases(4, "radar_detection"),
    *node_cases(5, "tracking"),
    *node_cases(6, "prediction"),
]
OF_PERCEPTION = {name for name, _, _ in PERCEPTION_CASES}

# Rejected files are in test_parameter_matrix; controllers without a state of their own are never not finite on finite
# frames, so what follows if they are is proven in test_ssm_states.
PROVEN_ELSEWHERE = {"parameters_rejected", "stanley_invalid", "pure_pursuit_invalid"}


def test_no_fault_is_left_out() -> None:
    assert {name for name, _, _ in CASES} | OF_PERCEPTION | PROVEN_ELSEWHERE == set(FAULTS)
    assert {name for name, fault in FAULTS.items() if "with perception_required" in fault.detection} == OF_PERCEPTION


def test_everything_supervised_has_its_rows() -> None:
    """The table is complete: sensors, nodes, reports and diagnostic bits by kind of fault, from the sources of each."""
    sensors = {name.split("_")[0] if name.startswith("imu") else name[:6] for name in NOISY}
    assert sensors == {"gnss_a", "gnss_b", "imu"}
    kinds = ("timeout", "low_rate", "wrong_size", "frozen", "jump")
    assert {f"{sensor}_{kind}" for sensor in sensors for kind in kinds} <= set(FAULTS)
    kinds = ("timeout", "low_rate", "wrong_size", "frozen")
    scanners = database.message("sensor_notice").choices["sensor_id"]
    assert sorted(scanners) == [lib.SCAN_FIRST_ID + number for number in range(lib.SCAN_COUNT)]
    assert {f"{scanner.lower()}_{kind}" for scanner in scanners.values() for kind in kinds} <= set(FAULTS)
    names = database.message("node_status").choices["node_id"]
    assert len(names) == lib.NODE_PERCEPTION
    names = names | database.message("perception_status").choices["perception_id"]
    nodes = [names[number].lower() for number in range(lib.NODE_COUNT)]
    health = ("not_ok", "failed", "stalled", "low_reliability")
    assert {f"{node}_{kind}" for node in nodes for kind in health} <= set(FAULTS)
    codes = set(database.message("node_status").choices["node_status_code"]) - {0}
    assert codes == (set(NOT_READY.values()) | set(FAILED.values())) - {FAILED["unknown"]}
    assert {"estimate_degraded", "estimate_bad", "estimate_lost"} <= set(FAULTS)
    reports = ("wheel_speed_missing", *(f"{r}_report_missing" for r in ("brake", "accelerator", "steering", "misc")))
    assert {*reports, "powertrain_report_missing", "diagnostic_report_missing"} <= set(FAULTS)
    plausible = ("steering", "brake", "throttle", "gear", "wheel_speed")
    assert {f"{what}_implausible" for what in plausible} <= set(FAULTS)
    heard = {report for report, _ in COUNTERS.values()} | {"base_to_car_summary"}
    counted = {m.name for m in database if m.sender == Station.RAPTOR and m.name in ObcHarness().signals and counter(m)}
    assert counted == heard
    bits = {*DIAGNOSTIC.values(), *WARNING_BITS, "motec_warning"}
    assert bits == set(database.message("diagnostic_report").signals)


def counter(message: MessageCodec) -> bool:
    return any(signal.endswith(("_counter", "_heartbeat")) for signal in message.signals)


def left_by(active: set[int]) -> tuple[float, float]:
    """Least shares of the degraded speed and acceleration, by the table's source; no fault leaves all."""
    rows = [fault for fault in FAULTS.values() if fault.id in active]
    return (
        min((row.speed_percent for row in rows if row.speed_percent), default=100) / 100.0,
        min((row.acceleration_percent for row in rows if row.acceleration_percent), default=100) / 100.0,
    )


def driven(harness: ObcHarness) -> ObcHarness:
    """At 20 m/s, with nothing wrong."""
    harness.plan_speed = 30.0
    harness.drive()
    harness.set_speed(20.0)
    harness.signals["pt_report_1"] |= {"current_gear": 2, "engine_speed_rpm": 5000}
    harness.run(30)
    assert (harness.state, harness.active_faults()) == (lib.SSM_NOMINAL, set())
    return harness


@pytest.mark.parametrize("provoke", [pytest.param(p, id=f"{n}-{way}") for n, way, p in PERCEPTION_CASES])
def test_a_car_that_drives_alone_does_not_miss_perception(provoke: Provoke) -> None:
    harness = ObcHarness(perception=True)
    harness.operation = OPERATION
    driven(harness)
    provoke(harness)
    for _ in range(250):
        harness.tick()
        assert harness.state == lib.SSM_NOMINAL
        assert harness.active_faults() == set()


def test_a_car_that_must_see_others_is_not_launched_blind() -> None:
    harness = ObcHarness()
    harness.operation = OPERATIONS / "perception.yaml"
    harness.configure()
    for _ in range(300):
        harness.tick()
        assert harness.state != lib.SSM_NOMINAL
    names = {fault.id: name for name, fault in FAULTS.items()}
    # Scans that do not come have not frozen.
    assert {names[number] for number in harness.blocking()} == OF_PERCEPTION - {"lidar_frozen", "radar_frozen"}


@pytest.mark.parametrize(
    ("name", "provoke"), [pytest.param(n, p, id=f"{n}-{way}") for n, way, p in CASES + PERCEPTION_CASES]
)
def test_fault(name: str, provoke: Provoke) -> None:
    harness = driven(ObcHarness(perception=name in OF_PERCEPTION))
    fault = FAULTS[name]
    harness.log.clear()
    provoke(harness)
    ticks = 0
    while fault.id not in harness.active_faults():
        harness.tick()
        ticks += 1
        assert ticks < 250, f"{name} never became active"
    event = database.message("fault_event")
    events = [event.decode(f.data) for f in iterate(harness.sent) if f.id == event.frame_id]
    assert (fault.id, 1) in [(int(e[0]), int(e[1])) for e in events], "the event leaves in the tick of the reaction"

    reaction = REACTIONS.index(fault.reaction)
    assert harness.value("ssm_status", "ssm_reaction") >= reaction
    if reaction == lib.FAULT_REACTION_FULL_BRAKE:
        assert harness.state == lib.SSM_FULL_BRAKE
        controlled = harness.value("ssm_status", "ssm_controller") != lib.CONTROL_NONE
        steered = controlled and name != "steering_implausible"
        assert (harness.brake_kpa, harness.throttle) == (3500 if steered else 4500, 0)
        harness.run(20)
        assert harness.ct_state == lib.CT_EMRG_SHUTDOWN
    elif reaction in (lib.FAULT_REACTION_SAFE_STOP, lib.FAULT_REACTION_EMERGENCY_STOP):
        if reaction == lib.FAULT_REACTION_EMERGENCY_STOP:
            assert harness.value("ssm_status", "ssm_controller") == lib.CONTROL_EMERGENCY
        harness.run(2)
        assert harness.state in (lib.SSM_EMERGENCY, lib.SSM_FULL_BRAKE)
        assert harness.throttle == 0
        assert harness.brake_kpa > 0
        assert harness.value("ssm_status", "ssm_max_speed") == 0
    elif reaction >= lib.FAULT_REACTION_DEGRADE:
        assert harness.state >= lib.SSM_DEGRADED
        if harness.state == lib.SSM_DEGRADED:
            speed, acceleration = left_by(harness.active_faults())
            assert speed <= fault.speed_percent / 100.0
            assert acceleration <= fault.acceleration_percent / 100.0
            assert harness.value("ssm_status", "ssm_max_speed") == pytest.approx(30.0 * speed, abs=0.025)
            assert harness.value("ssm_status", "ssm_max_acceleration") == pytest.approx(3.0 * acceleration, abs=0.05)
    if reaction == lib.FAULT_REACTION_SWITCH_CONTROLLER:
        assert harness.value("ssm_status", "ssm_controller") == lib.CONTROL_STANLEY


def test_limits_of_two_faults_and_of_the_one_that_is_left() -> None:
    harness = ObcHarness()
    harness.drive()
    periods = dict(harness.periods)

    def limits() -> tuple[float, float]:
        speed, acceleration = (harness.value("ssm_status", f"ssm_max_{name}") for name in ("speed", "acceleration"))
        return round(speed, 3), round(acceleration, 3)

    assert limits() == (63.1, 8.0)
    del harness.periods["accelerator_report"]
    harness.run(15)
    assert limits() == (30.0, 1.5)
    harness.node_reliability[0] = 0.0
    harness.run(10)
    assert limits() == (18.0, 1.5)
    harness.periods = periods
    harness.run(60)
    assert limits() == (18.0, 1.8)
    harness.node_reliability[0] = 100.0
    harness.run(110)
    assert limits() == (63.1, 8.0)


def test_driving_goes_on_after_a_short_sensor_gap() -> None:
    harness = ObcHarness()
    harness.plan_speed = 30.0
    harness.drive()
    periods = dict(harness.periods)
    del harness.periods["gnss_a_position"]
    harness.run(25)
    assert harness.state == lib.SSM_DEGRADED
    harness.periods = periods
    harness.run(250)
    assert harness.state == lib.SSM_NOMINAL


def test_safe_stop_then_holding_brake_then_reset() -> None:
    harness = ObcHarness()
    harness.plan_speed = 30.0
    harness.drive()
    harness.set_speed(20.0)
    harness.run(20)
    harness.node_codes[1] = 200
    harness.run(10)
    assert harness.state == lib.SSM_EMERGENCY
    harness.node_codes[1] = 0
    harness.set_speed(0.0)
    harness.run(100)
    assert harness.state == lib.SSM_EMERGENCY
    assert harness.throttle == 0
    assert harness.brake_kpa >= 500
    harness.signals["launch_request"]["launch_wanted"] = 0
    harness.run(20)
    harness.signals["launch_request"]["launch_wanted"] = 1
    harness.run(20)
    assert harness.state == lib.SSM_NOMINAL


def test_stale_inputs_take_the_throttle_away_before_any_reaction() -> None:
    harness = ObcHarness()
    harness.plan_speed = 40.0
    harness.drive()
    harness.set_speed(20.0)
    harness.signals["pt_report_1"] |= {"current_gear": 2, "engine_speed_rpm": 5000}
    harness.run(40)
    assert harness.throttle > 0
    for name in ("estimate_position", "estimate_motion", "estimate_quality"):
        del harness.periods[name]
    harness.run(7)
    assert harness.state == lib.SSM_NOMINAL, "the debounce still runs"
    assert harness.throttle == 0
    assert harness.brake_kpa >= 2000


def test_full_brake_is_steered() -> None:
    harness = ObcHarness()
    harness.plan_speed = 30.0
    harness.drive()
    harness.set_speed(20.0)
    harness.signals["estimate_position"]["estimate_y"] = 2.0
    harness.run(30)
    before = harness.value("steering_cmd", "steering_motor_ang_cmd")
    assert before < 0, "left of the path: steer right"
    harness.signals["misc_report"]["sys_state"] = 16
    harness.signals["estimate_position"]["estimate_y"] = -2.0
    harness.run(60)
    assert harness.state == lib.SSM_FULL_BRAKE
    assert harness.brake_kpa == 3500
    assert harness.value("steering_cmd", "steering_motor_ang_cmd") > 0
    harness.set_speed(0.0)
    harness.run(2)
    assert harness.brake_kpa == 4500, "at rest nobody steers"
