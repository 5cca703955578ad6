"""Raptor: reports on CAN1 and requests on CAN3, their rates, counters, values and limits."""

from __future__ import annotations

import math
from collections import Counter

import pytest
from actuator_ecus import DEG, Car, Outbox, car_in, message_frame

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import Bus, Station

NAN, INF = math.nan, math.inf

#: Messages of the Raptor that nobody sends: the car has no source for them.
WITHOUT_SOURCE = {"rest_of_field", "marelli_report_2", "mylaps_report_1", "mylaps_report_2"}


def fitted(car: Car) -> Car:
    for wheel in range(4):
        car.wired.tyre_pressure[wheel] = 2.0e5
        car.wired.tyre_temperature[wheel] = 60.0 + wheel
    return car


def test_every_message_leaves_at_its_cycle_time() -> None:
    car = fitted(Car())
    counts: Counter[int] = Counter(frame.id for _ in range(100) for frame in car.tick().frames if frame.bus == Bus.CAN1)
    expected = {
        message.frame_id: 1_000_000 // message.cycle_us
        for message in database
        if message.bus == Bus.CAN1 and message.sender == Station.RAPTOR and message.name not in WITHOUT_SOURCE
    }
    assert counts == expected
    assert len(expected) == lib.RAPTOR_REPORTS


def test_the_load_is_spread_over_the_ticks() -> None:
    car = fitted(Car())
    per_tick = [sum(frame.bus == Bus.CAN1 for frame in car.tick().frames) for _ in range(100)]
    assert max(per_tick) - min(per_tick) <= 2


def test_frames_have_the_length_of_their_message() -> None:
    car = fitted(Car())
    for _ in range(100):
        for frame in car.tick().frames:
            message = database.find(frame.bus, frame.id)
            assert message is not None
            assert frame.dlc == message.length
            assert frame.data[frame.dlc :] == bytes(8 - frame.dlc)


@pytest.mark.parametrize(
    ("name", "counter"),
    [
        ("brake_pressure_report", "brk_pressure_fdbk_counter"),
        ("accelerator_report", "acc_pedal_fdbk_counter"),
        ("steering_report", "steering_motor_fdbk_counter"),
        ("misc_report", "raptor_rolling_counter"),
        ("req_brake_pos", "Appl_Message_Counter"),
    ],
)
def test_counters_run_through_all_values(name: str, counter: str) -> None:
    car = Car()
    values = [car.tick().value(name, counter) for _ in range(600)]
    assert values == [number % 256 for number in range(600)]


def test_requests_pass_the_receivers_check() -> None:
    car = Car()
    receivers = {0x20: ffi.new("codec_rx *"), 0x21: ffi.new("codec_rx *")}
    for tick in range(600):
        for frame in car.tick().frames:
            if frame.bus == Bus.CAN3:
                pointer = ffi.new("can_frame *")
                ffi.buffer(pointer)[:] = frame.pack()
                assert lib.codec_receive(receivers[frame.id], pointer, tick) == 0
    assert receivers[0x21].valid == 600
    assert receivers[0x20].valid == 599, "the first waits for a position to hold"


def newest(car: Car, name: str) -> dict[str, float]:
    rows: list[dict[str, float]] = []
    for _ in range(10):
        rows += car.tick().of(name)
    return rows[-1]


def fixed_car() -> Car:
    """A car whose wired signals stay as a test sets them."""
    car = Car()
    car._stimulate = lambda: None  # type: ignore[method-assign]
    return car


def test_wheel_speeds_use_the_rolling_radii() -> None:
    car = fixed_car()
    for wheel, value in enumerate((100.0, 101.0, 102.0, 103.0)):
        car.wired.wheel_speed[wheel] = value
    row = newest(car, "wheel_speed_report")
    expected = [100 * 0.2958 * 3.6, 101 * 0.2958 * 3.6, 102 * 0.3099 * 3.6, 103 * 0.3099 * 3.6]
    assert list(row.values()) == pytest.approx(expected, abs=0.051)
    speed = newest(car, "pt_report_1")["vehicle_speed_kmph"]
    assert speed == pytest.approx(sum(expected[:2]) / 2, abs=0.051)


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_a_failed_wheel_speed_sensor_silences_the_report_and_is_no_standstill(wheel: int, value: float) -> None:
    """The message cannot say "failed", and 0 km/h would be a lie that stops nobody."""
    car = fixed_car()
    car.set_wheels(50.0)
    car.run(5)
    car.wired.wheel_speed[wheel] = value
    for _ in range(20):
        sent = car.tick()
        assert sent.of("wheel_speed_report") == []
        assert car.c.speed == pytest.approx(50.0)
    car.set_wheels(0.0)
    assert car.tick().value("wheel_speed_report", "wheel_speed_FL") == 0.0


def test_the_rear_potentiometers_are_swapped_on_the_wire() -> None:
    car = fixed_car()
    for wheel in range(4):
        car.wired.suspension_travel[wheel] = 0.010 + 0.001 * wheel
    row = newest(car, "wheel_potentiometer_data")
    assert row["wheel_potentiometer_RL"] == pytest.approx(12.0)
    assert row["wheel_potentiometer_RR"] == pytest.approx(13.0)


def test_powertrain_and_misc_values() -> None:
    car = fixed_car()
    wired = car.wired
    wired.engine_speed, wired.throttle_position, wired.gear, wired.gear_shift_status = 640.0, 0.372, 4, 3
    wired.engine_running, wired.fuel_pressure, wired.oil_pressure = True, 350_500.0, 420_100.0
    wired.coolant_temperature, wired.transmission_temperature, wired.transmission_pressure = 88.0, 92.0, 310_000.0
    wired.oil_temperature, wired.wheel_torque, wired.battery_voltage = 101.0, -1234.5, 13.24
    wired.mode_switch, wired.safety_switch = True, 1
    wired.brake_pressure_front, wired.brake_pressure_rear = 2.7504e6, 2.3e6
    for wheel in range(4):
        wired.wheel_load[wheel] = 2000.0 + 100.0 * wheel
    first = newest(car, "pt_report_1")
    assert first["engine_speed_rpm"] == round(640 * 30 / math.pi)
    assert (first["throttle_position"], first["current_gear"]) == (pytest.approx(37.2), 4)
    assert (first["gear_shift_status"], first["engine_state"], first["engine_run_switch"]) == (3, 1, 0)
    second = newest(car, "pt_report_2")
    assert list(second.values()) == pytest.approx([350.5, 420.1, 88, 92, 310])
    third = newest(car, "pt_report_3")
    assert list(third.values()) == pytest.approx([101, -1234.5, -1, -1])
    misc = newest(car, "misc_report")
    assert (misc["battery_voltage"], misc["mode_switch_state"], misc["safety_switch_state"]) == (
        pytest.approx(13.2), 1, 1,
    )  # fmt: skip
    brake = newest(car, "brake_pressure_report")
    assert (brake["brake_pressure_fdbk_front"], brake["brake_pressure_fdbk_rear"]) == (2750, 2300)
    assert list(newest(car, "wheel_strain_gauge").values()) == [2000, 2100, 2200, 2300]


def test_the_drivers_switches_come_back() -> None:
    car = fixed_car()
    car.tick([message_frame("dash_switches_cmd", 0, driver_traction_aim_switch=3, driver_traction_range_switch=7)])
    row = newest(car, "pt_report_3")
    assert (row["driver_traction_aim_swicth_fbk"], row["driver_traction_range_switch_fbk"]) == (3, 7)


@pytest.mark.parametrize("tyre", ["FL", "FR", "RL", "RR"])
def test_tyre_frames(tyre: str) -> None:
    car = fitted(fixed_car())
    index = ["FL", "FR", "RL", "RR"].index(tyre)
    car.wired.tyre_pressure[index] = 1.85e5
    car.wired.tyre_temperature[index] = 85.3
    for number in range(1, 5):
        values = list(newest(car, f"Tire_Temp_{tyre}_{number}").values())
        assert values == pytest.approx([85.3] * 4)
    pressure = newest(car, f"Tire_Pressure_{tyre}")
    assert list(pressure.values()) == [1850, 1850 - 1013]


def test_without_tyre_pressure_sensors_their_frames_stay_away() -> None:
    car = fixed_car()
    ids = {frame.id for _ in range(100) for frame in car.tick().frames}
    assert not ids & {1320, 1321, 1322, 1323}


def test_race_control_is_relayed() -> None:
    car = fixed_car()
    race = car.wired.race_control
    race.heartbeat, race.track_flag, race.vehicle_flag, race.rank = 5, 4, 2, 1
    race.round_target_speed, race.lap_count, race.lap_distance, race.lap_time = 100, 7, 1234, 42.8476
    race.marelli_track_flag, race.marelli_vehicle_flag, race.marelli_sector_flag = 1, 25, 3
    assert list(newest(car, "base_to_car_summary").values()) == [5, 4, 2, 1, 100, 7, 1234]
    timing = newest(car, "base_to_car_timing")
    assert (timing["laps"], timing["lap_time"]) == (7, pytest.approx(42_847.6))
    assert timing["time_stamp"] == pytest.approx(120.0), "0.1 ms, of the tick that sent it"
    marelli = newest(car, "marelli_report_1")
    assert list(marelli.values()) == [1, 25, 3, 1, 0]


SATURATED: list[tuple[str, float, str, str, float]] = [
    ("engine_speed", NAN, "pt_report_1", "engine_speed_rpm", 0),
    ("engine_speed", -5.0, "pt_report_1", "engine_speed_rpm", 0),
    ("engine_speed", 1e9, "pt_report_1", "engine_speed_rpm", 16_000),
    ("throttle_position", INF, "pt_report_1", "throttle_position", 100),
    ("throttle_position", -INF, "pt_report_1", "throttle_position", 0),
    ("wheel_torque", NAN, "pt_report_3", "torque_wheels", -3276.8),
    ("wheel_torque", 1e6, "pt_report_3", "torque_wheels", 3276.7),
    ("wheel_torque", -1e6, "pt_report_3", "torque_wheels", -3276.8),
    ("battery_voltage", 99.0, "misc_report", "battery_voltage", 25.5),
    ("battery_voltage", NAN, "misc_report", "battery_voltage", 0),
    ("fuel_pressure", 1e9, "pt_report_2", "fuel_pressure_kPa", 1000),
    ("coolant_temperature", -40.0, "pt_report_2", "coolant_temperature", 0),
    ("coolant_temperature", 300.0, "pt_report_2", "coolant_temperature", 255),
    ("brake_pressure_front", NAN, "brake_pressure_report", "brake_pressure_fdbk_front", 0),
    ("brake_pressure_front", 9.0e6, "brake_pressure_report", "brake_pressure_fdbk_front", 8191),
    ("brake_pressure_rear", -1.0e5, "brake_pressure_report", "brake_pressure_fdbk_rear", 0),
]


@pytest.mark.parametrize(("field", "value", "name", "signal", "expected"), SATURATED)
def test_values_saturate(field: str, value: float, name: str, signal: str, expected: float) -> None:
    car = fixed_car()
    setattr(car.wired, field, value)
    assert newest(car, name)[signal] == pytest.approx(expected)


@pytest.mark.parametrize("value", [NAN, INF, -INF, 3.4e38, -3.4e38])
def test_hopeless_wired_signals_break_nothing(value: float) -> None:
    """Every wired number at once: all frames still leave and decode, the brake is full or held, no throttle."""
    car = fixed_car()
    for name, kind in ffi.typeof("raptor_wired_in").fields:
        if kind.type is ffi.typeof("float"):
            setattr(car.wired, name, value)
        elif kind.type is ffi.typeof("float[4]"):
            setattr(car.wired, name, [value] * 4)
    for _ in range(100):
        sent = car.tick()
        assert car.c.demand.brake >= lib.raptor_config_default.brake_hold
        assert car.drive.throttle_demand == 0.0
        for frame in sent.frames:
            message = database.find(frame.bus, frame.id)
            assert message is not None
            assert all(math.isfinite(number) for number in message.decode(frame.data))


def test_steering_reports_show_the_space_drives_sensors() -> None:
    car = car_in(4)
    car.space_drive.follow = False
    for channel, angle in enumerate((10.0, 11.0, 12.0)):
        car.space_drive.wired.steer_motor_angle[channel] = angle * DEG
    car.run(3)
    sent = car.tick()
    assert list(sent.of("steering_report_extd")[-1].values()) == [10.0, 11.0, 12.0]
    assert sent.value("steering_report", "steering_motor_ang_avg_fdbk") == 11.0


def test_a_full_outbox_loses_frames_and_nothing_else() -> None:
    car = car_in(9)
    for capacity in (0, 1, 2, 5, 10):
        car.outbox = Outbox(capacity)
        sent = car.tick()
        assert len(sent.frames) == capacity
        assert car.outbox.c.dropped > 0
    assert car.state == 9


def test_diagnostic_bits_have_the_places_of_the_wire() -> None:
    car = fixed_car()
    names = database.message("diagnostic_report").signals
    assert names[0] == "sd_system_warning"
    bits = {
        "sd_system_warning": lib.RAPTOR_DIAG_SD_WARNING,
        "sd_system_failure": lib.RAPTOR_DIAG_SD_FAILURE,
        **{f"sd_brake_warning{n + 1}": lib.RAPTOR_DIAG_SD_BRAKE_WARNING_1 << n for n in range(3)},
        **{f"sd_steer_warning{n + 1}": lib.RAPTOR_DIAG_SD_STEER_WARNING_1 << n for n in range(3)},
        "est1_oos_front_brk": lib.RAPTOR_DIAG_EST1_FRONT_BRAKE,
        "est2_oos_rear_brk": lib.RAPTOR_DIAG_EST2_REAR_BRAKE,
        "est3_low_eng_speed": lib.RAPTOR_DIAG_EST3_LOW_ENGINE,
        "est4_sd_comms_loss": lib.RAPTOR_DIAG_EST4_SD_LOST,
        "est5_motec_comms_loss": lib.RAPTOR_DIAG_EST5_MOTEC_LOST,
        "est6_sd_ebrake": lib.RAPTOR_DIAG_EST6_SD_EBRAKE,
        "adlink_hb_lost": lib.RAPTOR_DIAG_OBC_LOST,
        "rc_lost": lib.RAPTOR_DIAG_RC_LOST,
    }
    assert set(bits) | {"motec_warning"} == set(names)
    outbox = Outbox()
    for name, bit in bits.items():
        car.c.diagnostic.bits = bit
        lib.raptor_reports_send(car.c, car.wired, 0, 0, outbox.c)
        message = database.message("diagnostic_report")
        row = next(message.decode(frame.data) for frame in outbox.take() if frame.id == message.frame_id)
        assert {signal for signal, value in zip(names, row, strict=True) if value} == {name}
