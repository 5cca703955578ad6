"""The onboard computer from power-on to driving, and what it commands on the way."""

from __future__ import annotations

import pytest
from obc_harness import OPERATION, TICK_US, ObcHarness, cast_frames, drop

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import FRAME_SIZE, Bus, Flag, Station, iterate
from firmware.parameters import load_operation

FULL_BRAKE_KPA, STEERED_BRAKE_KPA = 4500, 3500
HOLDING_KPA = 2000


def test_full_brake_from_the_very_first_tick_and_while_nothing_is_configured() -> None:
    harness = ObcHarness()
    for _ in range(300):
        harness.tick()
        assert (harness.brake_kpa, harness.throttle) == (FULL_BRAKE_KPA, 0)
        assert harness.value("gear_shift_cmd", "desired_gear") == 0
    assert harness.state == lib.SSM_CONFIG_CHECK
    assert harness.ct_state == lib.CT_PWR_ON
    assert harness.value("parameter_summary", "summary_verdict") == lib.PARAMETER_VERDICT_PENDING


def test_full_brake_without_any_frame_at_all() -> None:
    harness = ObcHarness()
    for _ in range(200):
        harness.tick(b"")
        assert (harness.brake_kpa, harness.throttle) == (FULL_BRAKE_KPA, 0)
    assert harness.ct_state == lib.CT_DEFAULT


def test_zeroed_computer_is_a_full_brake() -> None:
    harness = ObcHarness()
    harness.obc = ffi.new("obc *")
    for _ in range(50):
        harness.tick()
        assert (harness.brake_kpa, harness.throttle) == (FULL_BRAKE_KPA, 0)


def test_way_to_driving() -> None:
    harness = ObcHarness()
    harness.tick()
    harness.configure()
    states = []
    for _ in range(130):
        harness.tick()
        states.append(harness.state)
        expected = HOLDING_KPA if harness.state == lib.SSM_NOMINAL else FULL_BRAKE_KPA
        assert (harness.brake_kpa, harness.throttle) == (expected, 0)
    assert sorted(set(states)) == [lib.SSM_LAUNCHING, lib.SSM_NOMINAL]
    assert states == sorted(states)

    harness = ObcHarness()
    harness.plan_speed = 10.0
    harness.drive()
    assert harness.active_faults() == set()
    assert harness.obc.ssm.faults.event_count == 0
    assert not [frame for frame in harness.log if frame.id == database.message("fault_event").frame_id]
    harness.signals["pt_report_1"]["current_gear"] = 1
    harness.run(50)
    assert harness.value("gear_shift_cmd", "desired_gear") == 1
    assert harness.throttle > 0
    assert harness.brake_kpa == 0


def told_ct_states(harness: ObcHarness) -> list[int]:
    """What ct_report said, without repetitions."""
    report = database.message("ct_report")
    place = report.signals.index("ct_state")
    said = [int(report.decode(frame.data)[place]) for frame in harness.log if frame.id == report.frame_id]
    return [state for before, state in zip([None, *said], said, strict=False) if state != before]


@pytest.mark.parametrize("phase", range(5))
def test_a_ct_state_is_told_before_it_is_left(phase: int) -> None:
    """Configured already when the Raptor is first heard, the computer could leave PWR_ON at once."""
    harness = ObcHarness()
    harness.filters.append(drop("misc_report"))
    harness.tick()
    harness.configure()
    harness.run(40 + phase)
    assert told_ct_states(harness) == [lib.CT_DEFAULT]
    harness.filters.clear()
    harness.run(20)
    assert told_ct_states(harness) == [lib.CT_DEFAULT, lib.CT_PWR_ON, lib.CT_INITIALIZED]


@pytest.mark.parametrize(
    ("flags", "state"),
    [
        ({"track_flag": 1}, "CT_COORD_STOP"),  # red
        ({"veh_flag": 8}, "CT_EMRG_SHUTDOWN"),  # purple
        ({"veh_flag": 4}, "CT_NOM_RACE"),  # chequered: CAUTION waits
    ],
)
def test_only_a_stop_does_not_wait_until_the_ct_state_is_told(flags: dict[str, int], state: str) -> None:
    harness = ObcHarness()
    harness.drive()
    harness.signals["base_to_car_summary"] |= flags
    for _ in range(30):
        harness.obc.ct_state_told = False
        harness.tick()
    assert harness.obc.ct_state == getattr(lib, state)


@pytest.mark.parametrize("without", ["nodes", "estimate", "plan", "launch", "sensors", "raptor", "race_control"])
def test_no_launch_while_something_is_missing(without: str) -> None:
    silent = {
        "nodes": [],
        "estimate": ["estimate_position"],
        "plan": [],
        "launch": ["launch_request"],
        "sensors": ["imu_rates"],
        "raptor": ["misc_report"],
        "race_control": ["base_to_car_summary"],
    }[without]
    harness = ObcHarness()
    periods = dict(harness.periods)
    for name in silent:
        del harness.periods[name]
    harness.silent_nodes = {0, 1} if without == "nodes" else set()
    harness.planning = without != "plan"
    harness.configure()
    harness.run(300)
    assert harness.state == lib.SSM_LAUNCHING
    assert (harness.brake_kpa, harness.throttle) == (FULL_BRAKE_KPA, 0)
    assert harness.active_faults() == set(), "nothing latches before the car has run"
    harness.periods, harness.planning, harness.silent_nodes = periods, True, set()
    harness.run(150)
    assert harness.state == lib.SSM_NOMINAL


def test_nodes_start_up_in_their_own_time() -> None:
    harness = ObcHarness()
    harness.configure()
    for code in (128, 64, 100):
        harness.node_codes = {0: 0, 1: code}
        harness.run(150)
        assert harness.state == lib.SSM_LAUNCHING
    harness.node_codes = {0: 0, 1: 0}
    harness.run(3)
    assert harness.state == lib.SSM_NOMINAL


def test_withdrawn_request_holds_the_launch_back() -> None:
    harness = ObcHarness()
    harness.signals["launch_request"]["launch_wanted"] = 0
    harness.configure()
    harness.run(200)
    assert harness.state == lib.SSM_LAUNCHING


def test_periods_and_senders() -> None:
    harness = ObcHarness()
    harness.launch()
    harness.log.clear()
    harness.run(200)
    counts: dict[str, int] = {}
    for frame in harness.log:
        message = database.find(frame.bus, frame.id)
        assert message is not None
        assert message.sender == frame.sender == Station.OBC
        assert frame.bus in (Bus.CAN1, Bus.CAN_A)
        counts[message.name] = counts.get(message.name, 0) + 1
    assert counts == {
        "brake_pressure_cmd": 200, "accelerator_cmd": 200, "steering_cmd": 200, "gear_shift_cmd": 20, "ct_report": 40,
        "ct_report_2": 200, "dash_switches_cmd": 200, "ct_vehicle_acc_feedback": 200,
        "ssm_status": 200, "vehicle_status": 200, "control_status": 200,
        "parameter_summary": 20, "executive_statistics": 20, "executive_task": 20,
    }  # fmt: skip


def test_flags_are_acknowledged() -> None:
    harness = ObcHarness()
    harness.signals["base_to_car_summary"] |= {"track_flag": 4, "veh_flag": 5}
    harness.signals["marelli_report_1"] |= {
        "marelli_track_flag": 9, "marelli_vehicle_flag": 25, "marelli_sector_flag": 37,
    }  # fmt: skip
    harness.configure()
    harness.run(20)
    assert harness.value("ct_report", "track_cond_ack") == 4
    assert harness.value("ct_report", "veh_sig_ack") == 5
    assert harness.value("ct_report", "veh_num") == dict(load_operation(OPERATION))["vehicle_number"]
    assert harness.received["ct_report_2"] == (9, 25, 37)


def test_vehicle_status_relays_the_car() -> None:
    harness = ObcHarness()
    harness.signals["misc_report"]["sys_state"] = 13
    harness.signals["pt_report_1"]["current_gear"] = 5
    harness.signals["wheel_speed_report"] = {
        "wheel_speed_FL": 100.0, "wheel_speed_FR": 108.0, "wheel_speed_RL": 300.0, "wheel_speed_RR": 0.0,
    }  # fmt: skip
    harness.run(12)
    assert harness.value("vehicle_status", "obc_sys_state") == 13
    assert harness.value("vehicle_status", "obc_gear") == 5
    assert harness.value("vehicle_status", "obc_round_target_speed") == 31
    assert harness.value("vehicle_status", "obc_wheel_speed") == pytest.approx(104.0 / 3.6, abs=0.0025)
    assert harness.value("vehicle_status", "obc_plan_in_use") == harness.plan_counter


def test_steering_feedback_is_the_road_wheels() -> None:
    harness = ObcHarness()
    harness.configure()
    harness.signals["steering_report"]["steering_motor_ang_avg_fdbk"] = -45.0
    harness.signals["brake_pressure_report"]["brake_pressure_fdbk_front"] = 1234
    harness.signals["pt_report_1"]["engine_speed_rpm"] = 3000
    harness.run(5)
    feedback = harness.obc.vehicle.control
    assert feedback.road_wheel_angle == pytest.approx(-0.0523599, abs=1e-6)  # -45 degrees / 15
    assert feedback.brake_pressure == 1_234_000
    assert feedback.engine_speed == pytest.approx(314.159, abs=1e-3)


def test_acceleration_feedback_in_g() -> None:
    harness = ObcHarness()
    harness.signals["estimate_quality"] |= {"estimate_ax": 9.8, "estimate_ay": -4.9}
    harness.signals["imu_specific_force"]["imu_specific_force_z"] = 14.71
    harness.run(3)
    assert harness.received["ct_vehicle_acc_feedback"] == pytest.approx((1.0, -0.5, 0.5))


def test_whole_run_ends_in_the_controlled_shutdown() -> None:
    harness = ObcHarness()
    harness.drive()
    harness.set_speed(30.0)
    harness.run(5)
    harness.signals["base_to_car_summary"]["veh_flag"] = 4
    harness.run(12)
    assert harness.ct_state == lib.CT_CAUTION
    harness.set_speed(0.0)
    harness.run(12)
    assert harness.ct_state == lib.CT_CNTRL_SHUTDOWN
    assert (harness.brake_kpa, harness.throttle) == (HOLDING_KPA, 0)
    assert harness.state == lib.SSM_NOMINAL


def test_purple_flag_is_a_full_brake() -> None:
    harness = ObcHarness()
    harness.drive()
    harness.set_speed(30.0)
    harness.run(5)
    harness.signals["base_to_car_summary"]["veh_flag"] = 8
    harness.run(12)
    assert harness.ct_state == lib.CT_EMRG_SHUTDOWN
    assert (harness.brake_kpa, harness.throttle) == (STEERED_BRAKE_KPA, 0)


def test_red_flag_is_a_coordinated_stop() -> None:
    harness = ObcHarness()
    harness.plan_speed = 40.0
    harness.drive()
    harness.set_speed(30.0)
    harness.signals["pt_report_1"] |= {"current_gear": 3, "engine_speed_rpm": 4000}
    harness.run(20)
    assert harness.throttle > 0
    harness.signals["base_to_car_summary"]["track_flag"] = 1
    harness.run(30)
    assert harness.ct_state == lib.CT_COORD_STOP
    assert harness.throttle == 0
    assert harness.brake_kpa > 500


def test_recorded_input_gives_bit_identical_output() -> None:
    harness = ObcHarness()
    recorded: list[bytes] = []
    harness.filters.append(lambda frames: (recorded.append(frames), frames)[1])
    sent = []
    harness.plan_speed = 20.0
    harness.configure()
    for tick in range(400):
        if tick == 200:
            harness.signals["misc_report"]["sys_state"] = 4
        if tick == 300:
            harness.silent_nodes = {1}
        sent.append(harness.tick())
    assert harness.state == lib.SSM_EMERGENCY
    replay = ObcHarness()
    assert [replay.tick(frames) for frames in recorded] == sent


def test_schedule_is_sane() -> None:
    assert lib.executive_table_valid(lib.obc_schedule(), lib.OBC_TASK_COUNT, lib.EXECUTIVE_FRAME_US)


def test_statistics_name_every_task() -> None:
    harness = ObcHarness()
    schedule = lib.obc_schedule()
    seen = {}
    for _ in range(10 * lib.OBC_TASK_COUNT):
        harness.tick()
        seen[harness.value("executive_task", "task_index")] = harness.value("executive_task", "task_budget")
    assert seen == {index: schedule[index].budget_us for index in range(lib.OBC_TASK_COUNT)}
    assert harness.value("executive_statistics", "executive_overruns") == 0
    assert harness.value("executive_statistics", "executive_late_frames") == 0


def test_frames_that_are_not_to_be_used_change_nothing() -> None:
    harness = ObcHarness()
    harness.launch()
    good = next(iterate(harness.message("base_to_car_summary", track_flag=4, veh_flag=8)))
    bad = [
        good._replace(flags=int(Flag.REMOTE)),
        good._replace(flags=int(Flag.ERROR)),
        good._replace(flags=int(Flag.EXTENDED)),
        good._replace(dlc=7),
        good._replace(bus=Bus.CAN3),
        good._replace(bus=200),
        good._replace(id=0x7FF),
    ]
    before = harness.obc.rejected_frames
    del harness.periods["base_to_car_summary"]
    harness.extra.extend(frame.pack() for frame in bad)
    harness.tick()
    assert harness.obc.rejected_frames == before + len(bad)
    assert harness.value("vehicle_status", "obc_track_flag") == 1
    longer = good._replace(dlc=64)
    harness.extra.append(longer.pack())
    harness.tick()
    assert harness.value("vehicle_status", "obc_track_flag") == 4, "a longer frame is accepted, as public stacks do"


@pytest.mark.parametrize("capacity", range(12))
def test_small_outbox_never_overflows(capacity: int) -> None:
    harness = ObcHarness()
    out = ffi.new("can_outbox *", {"frames": (storage := ffi.new("can_frame[]", 12)), "capacity": capacity})
    ffi.buffer(storage)[:] = b"\xa5" * (12 * FRAME_SIZE)
    for tick in range(30):
        out.count = 0
        frames = b"".join(harness.due())
        array, count = cast_frames(frames)
        lib.obc_tick(harness.obc, tick * TICK_US, array, count, out)
        assert out.count == capacity or capacity >= 10
    assert bytes(ffi.buffer(storage))[capacity * FRAME_SIZE :] == b"\xa5" * ((12 - capacity) * FRAME_SIZE)
    assert out.dropped > 0
