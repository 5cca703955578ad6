"""A corpus of planted defects: each makes one kind of encoding mistake in the recording of a sound car.

A defect says what a checker has to find: the rule, the message, the signal and the number of the first frame, and what
follows from it and cannot be avoided. Names say what is wrong; those with a public program in their words are mistakes
that it has made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dbc.codec import MessageCodec, database
from dbc.frames import FRAME_DTYPE, Bus, Flag
from tools.dbw.findings import Place, Rule

Values = NDArray[np.float64]
Rows = NDArray[np.intp]

DRIVING_S = 6.0
"""From here on the car drives and steers by a few degrees."""


class Traffic:
    """Frames of a recording, to be changed.

    Attributes
    ----------
    frames : array of `FRAME_DTYPE`.
    """

    def __init__(self, frames: NDArray[np.void]) -> None:
        self.frames = frames.copy()

    def rows(self, message: str, after_s: float = 0.0) -> Rows:
        """Where the frames of a message are, from some time on."""
        codec = database.message(message)
        mine = (self.frames["id"] == codec.frame_id) & (self.frames["bus"] == codec.bus)
        return np.flatnonzero(mine & (self.frames["time_us"] >= after_s * 1e6))

    def get(self, message: str, signal: str, rows: Rows) -> Values:
        """Physical values of a signal."""
        codec = database.message(message)
        values: Values = codec.columns(self.frames[rows])[codec.signals.index(signal)]
        return values

    def set(self, message: str, signal: str, rows: Rows, values: Values | float) -> None:
        """Encode other values of a signal; the CRC is right again."""
        codec = database.message(message)
        columns = codec.columns(self.frames[rows])
        columns[codec.signals.index(signal)] = values
        encoded = np.frombuffer(codec.frames(columns.T), dtype=FRAME_DTYPE)
        self.frames["data"][rows] = encoded["data"]
        self.sign(message, rows)

    def sign(self, message: str, rows: Rows) -> None:
        """Compute the CRC of frames, if they have one."""
        codec = database.message(message)
        facts = database.facts(message)
        if facts.crc is not None and facts.counter is not None:
            counter = codec.signals.index(facts.counter.name)
            for row, value in zip(rows, codec.columns(self.frames[rows])[counter], strict=True):
                finished = np.frombuffer(codec.finish(self.frames[row].tobytes(), int(value)), dtype=FRAME_DTYPE)
                self.frames["data"][row] = finished["data"][0]

    def raw(self, message: str, signal: str, rows: Rows) -> NDArray[np.int64]:
        """Raw values of a signal."""
        definition = database.message(message).definition.get_signal_by_name(signal)
        physical = self.get(message, signal, rows)
        return np.rint((physical - float(definition.offset)) / float(definition.scale)).astype(np.int64)

    def set_raw(self, message: str, signal: str, rows: Rows, raw: NDArray[np.int64] | int) -> None:
        """Encode other raw values."""
        definition = database.message(message).definition.get_signal_by_name(signal)
        self.set(message, signal, rows, np.asarray(raw) * float(definition.scale) + float(definition.offset))

    def drop(self, rows: Rows) -> None:
        """Take frames out."""
        self.frames = np.delete(self.frames, rows)

    def braking_s(self) -> float:
        """When the driving car has begun to brake."""
        rows = self.rows("brake_pressure_cmd", DRIVING_S)
        pressure = self.get("brake_pressure_cmd", "brake_pressure_cmd", rows)
        return float(self.frames["time_us"][rows[np.argmax(pressure > 150.0)]]) * 1e-6

    def insert(self, codec: MessageCodec, values: NDArray[np.float64], times: NDArray[np.int64]) -> None:
        """Put frames in, each behind all others of its time."""
        new = np.frombuffer(codec.frames(values, times), dtype=FRAME_DTYPE)
        together = np.concatenate([self.frames, new])
        self.frames = together[np.argsort(together["time_us"], kind="stable")]


def place(rule: Rule, message: str, signal: str = "") -> Place:
    """Of a message that the database has."""
    return Place(rule, database.message(message).bus, message, signal)


@dataclass(frozen=True)
class Expected:
    """What has to be found.

    Attributes
    ----------
    place, frame : where, and in which frame first.
    also : what follows from it in other places, whichever frame it shows in first.
    """

    place: Place
    frame: int
    also: frozenset[Place] = frozenset()


def expect(rule: Rule, message: str, signal: str, frame: int | np.intp, *also: Place) -> Expected:
    """Shorthand."""
    return Expected(place(rule, message, signal), int(frame), frozenset(also))


Plant = Callable[[Traffic], Expected]


@dataclass(frozen=True)
class Defect:
    """One of the corpus.

    Attributes
    ----------
    kind, name : in words.
    plant : makes it.
    """

    kind: str
    name: str
    plant: Plant = field(repr=False)


DEFECTS: list[Defect] = []


def defect(kind: str, name: str) -> Callable[[Plant], Plant]:
    """Put a defect into the corpus."""

    def add(plant: Plant) -> Plant:
        DEFECTS.append(Defect(kind, name, plant))
        return plant

    return add


# --- identity ---------------------------------------------------------------------------------------------------------


@defect("identity", "a report under an identifier that no message has")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("wheel_speed_report", DRIVING_S)[:1]
    traffic.frames["id"][rows] = 0x7AB
    return Expected(Place(Rule.UNKNOWN, Bus.CAN1, "7AB"), int(rows[0]))


@defect("identity", "the Marelli report under its identifier of before V14, 1000")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("marelli_report_1")
    traffic.frames["id"][rows] = 1000
    missing = place(Rule.MISSING, "marelli_report_1")
    return Expected(Place(Rule.UNKNOWN, Bus.CAN1, "3E8"), int(rows[0]), frozenset({missing}))


@defect("identity", "dash switches under their identifier of before V14, which has become that of ct_report_2")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("dash_switches_cmd", DRIVING_S)
    traffic.frames["id"][rows] = database.message("ct_report_2").frame_id
    return expect(
        Rule.VALUE,
        "ct_report_2",
        "marelli_track_flag_ack",
        rows[0],
        place(Rule.CYCLE, "ct_report_2"),
    )


@defect("identity", "acceleration feedback under its identifier of before V14, which has become that of dash switches")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("ct_vehicle_acc_feedback", DRIVING_S)
    traffic.frames["id"][rows] = database.message("dash_switches_cmd").frame_id
    stray = rows[(traffic.frames["data"][rows][:, 1:] != 0).any(axis=1)]
    return expect(Rule.UNUSED, "dash_switches_cmd", "", stray[0], place(Rule.CYCLE, "dash_switches_cmd"))


@defect("identity", "purdue: MyLaps speed and heading dispatched to the second Marelli report")
def _(traffic: Traffic) -> Expected:
    times = traffic.frames["time_us"][traffic.rows("gnss_a_position", 1.1)[::2]].astype(np.int64)
    first = database.message("mylaps_report_1")
    traffic.insert(first, np.tile([[50.0, 180.0]], (len(times), 1)), times)
    rows = traffic.rows("mylaps_report_1")
    traffic.frames["id"][rows] = database.message("marelli_report_2").frame_id
    return expect(
        Rule.AGREEMENT,
        "marelli_report_2",
        "marelli_gps_lat",
        rows[0],
        place(Rule.AGREEMENT, "marelli_report_2", "marelli_gps_long"),
    )


@defect("identity", "a 29-bit identifier in place of the 11-bit one")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("pt_report_1", DRIVING_S)[:1]
    traffic.frames["flags"][rows] = Flag.EXTENDED
    return Expected(Place(Rule.UNKNOWN, Bus.CAN1, "0000053C"), int(rows[0]))


@defect("identity", "steering command on CAN3")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("steering_cmd")
    traffic.frames["bus"][rows] = Bus.CAN3
    missing = place(Rule.MISSING, "steering_cmd")
    return Expected(Place(Rule.UNKNOWN, Bus.CAN3, "57A"), int(rows[0]), frozenset({missing}))


@defect("identity", "a remote frame")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("misc_report", DRIVING_S)[:1]
    traffic.frames["flags"][rows] = Flag.REMOTE
    jump = place(Rule.JUMP, "misc_report", "raptor_rolling_counter")
    return expect(Rule.REMOTE, "misc_report", "", rows[0], jump)


@defect("identity", "an error frame")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("wheel_speed_report", DRIVING_S)[:1]
    traffic.frames["flags"][rows] = Flag.ERROR
    return Expected(Place(Rule.ERROR, Bus.CAN1, "514"), int(rows[0]))


# --- length -----------------------------------------------------------------------------------------------------------


@defect("length", "misc_report with four bytes of five")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("misc_report")
    traffic.frames["dlc"][rows] = 4
    return expect(Rule.SHORT, "misc_report", "", rows[0], place(Rule.MISSING, "misc_report"))


@defect("length", "a frame without data")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("gear_shift_cmd", DRIVING_S)[:1]
    traffic.frames["dlc"][rows] = 0
    return expect(Rule.SHORT, "gear_shift_cmd", "", rows[0])


@defect("length", "the brake report with eight bytes, of which it has five")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("brake_pressure_report")
    traffic.frames["dlc"][rows] = 8
    return expect(Rule.LONG, "brake_pressure_report", "", rows[0])


@defect("length", "steering_report as long as in the AV-24")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("steering_report", DRIVING_S)
    traffic.frames["dlc"][rows] = 8
    return expect(Rule.LONG, "steering_report", "", rows[0])


# --- bits that no signal has ------------------------------------------------------------------------------------------


@defect("unused bits", "unused bytes are filled with FF")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("accelerator_cmd")
    traffic.frames["data"][rows, 3:] = 0xFF
    return expect(Rule.UNUSED, "accelerator_cmd", "", rows[0])


@defect("unused bits", "unused bytes keep what was in the buffer before")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("gear_shift_cmd")
    before = traffic.frames["data"][traffic.rows("brake_pressure_cmd")[: len(rows)]]
    traffic.frames["data"][rows, 1:] = before[:, 1:]
    stray = rows[(before[:, 1:] != 0).any(axis=1)]
    return expect(Rule.UNUSED, "gear_shift_cmd", "", stray[0])


@defect("unused bits", "the brake command in 16 bits of 13")
def _(traffic: Traffic) -> Expected:
    row = traffic.rows("brake_pressure_cmd")[100]
    traffic.frames["data"][row, 1] |= 0xE0
    return expect(Rule.UNUSED, "brake_pressure_cmd", "", row)


# --- bit order and place ----------------------------------------------------------------------------------------------


def swap(traffic: Traffic, low_byte: int, rows: Rows) -> None:
    """Change the order of two bytes."""
    data = traffic.frames["data"]
    data[rows, low_byte], data[rows, low_byte + 1] = data[rows, low_byte + 1].copy(), data[rows, low_byte].copy()


@defect("bit order", "engine speed little-endian")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("pt_report_1")
    raw = traffic.raw("pt_report_1", "engine_speed_rpm", rows)
    swapped = raw >> 8 | (raw & 0xFF) << 8
    traffic.set_raw("pt_report_1", "engine_speed_rpm", rows, swapped)
    return expect(
        Rule.RANGE,
        "pt_report_1",
        "engine_speed_rpm",
        rows[np.argmax(swapped > 16000)],
        place(Rule.SLEW, "pt_report_1", "engine_speed_rpm"),
    )


@defect("bit order", "tyre temperature little-endian")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("Tire_Temp_FL_1")
    swap(traffic, 0, rows)
    changes = np.diff(traffic.frames["data"][rows, 0].astype(int)) != 0
    return expect(Rule.SLEW, "Tire_Temp_FL_1", "FL_Tire_Temp_01", rows[1 + np.argmax(changes)])


@defect("bit order", "tyre pressures little-endian")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("Tire_Pressure_RR")
    swap(traffic, 0, rows)
    swap(traffic, 2, rows)
    return expect(Rule.AGREEMENT, "Tire_Pressure_RR", "RR_Tire_Pressure_Gauge", rows[0])


@defect("bit order", "wheel speed big-endian")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("wheel_speed_report")
    swap(traffic, 4, rows)
    high = traffic.frames["data"][rows, 5].astype(int) << 8 | traffic.frames["data"][rows, 4]
    return expect(
        Rule.RANGE,
        "wheel_speed_report",
        "wheel_speed_RL",
        rows[np.argmax(high > 3400)],
        place(Rule.SLEW, "wheel_speed_report", "wheel_speed_RL"),
    )


@defect("bit order", "brake command big-endian")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("brake_pressure_cmd")
    swap(traffic, 0, rows)
    stray = rows[traffic.frames["data"][rows, 1] & 0xE0 != 0]
    return expect(
        Rule.UNUSED,
        "brake_pressure_cmd",
        "",
        stray[0],
        place(Rule.RELAY, "req_brake_pos", "contrl_pos_brk"),
    )


@defect("bit order", "steering command big-endian")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("steering_cmd")
    raw = traffic.raw("steering_cmd", "steering_motor_ang_cmd", rows)
    swap(traffic, 0, rows)
    return expect(
        Rule.SLEW,
        "steering_cmd",
        "steering_motor_ang_cmd",
        rows[np.argmax(raw != 0)],
        place(Rule.UNUSED, "steering_cmd"),
        place(Rule.RESOLUTION, "steering_cmd", "steering_motor_ang_cmd"),
        place(Rule.RELAY, "req_steer_pos", "cntrl_pos"),
    )


@defect("bit order", "misc_report's counter byte-aligned, at bit 16")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("misc_report")
    counters = traffic.raw("misc_report", "raptor_rolling_counter", rows)
    data = traffic.frames["data"]
    data[rows, 2], data[rows, 3] = counters, 0
    # Seen three bits further up, the counter stays for eight frames.
    return expect(
        Rule.STUCK,
        "misc_report",
        "raptor_rolling_counter",
        rows[1],
        place(Rule.JUMP, "misc_report", "raptor_rolling_counter"),
        place(Rule.UNUSED, "misc_report"),
    )


# --- sign -------------------------------------------------------------------------------------------------------------


@defect("sign", "average steering angle with the other sign than its sensors")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("steering_report")
    angles = traffic.get("steering_report", "steering_motor_ang_avg_fdbk", rows)
    traffic.set("steering_report", "steering_motor_ang_avg_fdbk", rows, -angles)
    return expect(Rule.AGREEMENT, "steering_report", "steering_motor_ang_avg_fdbk", rows[np.argmax(angles != 0.0)])


@defect("sign", "all steering feedback with the other sign than the command")
def _(traffic: Traffic) -> Expected:
    angles = {}
    for message, signals in (
        ("steering_report", ["steering_motor_ang_avg_fdbk"]),
        ("steering_report_extd", [f"steering_motor_ang_{i}_fdbk" for i in (1, 2, 3)]),
    ):
        for signal in signals:
            rows = traffic.rows(message)
            angles[signal] = traffic.get(message, signal, rows)
            traffic.set(message, signal, rows, -angles[signal])
    rows = traffic.rows("steering_report_extd")
    first = rows[np.argmax(angles["steering_motor_ang_1_fdbk"] != 0.0)]
    return expect(
        Rule.RELAY,
        "steering_report_extd",
        "steering_motor_ang_1_fdbk",
        first,
        place(Rule.RELAY, "steering_report_extd", "steering_motor_ang_2_fdbk"),
        place(Rule.RELAY, "steering_report_extd", "steering_motor_ang_3_fdbk"),
        place(Rule.AGREEMENT, "steering_report", "steering_motor_ang_avg_fdbk"),
    )


@defect("sign", "steering request to the Space Drive with the other sign than the command")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("req_steer_pos", DRIVING_S)
    raw = traffic.raw("req_steer_pos", "cntrl_pos", rows)
    traffic.set_raw("req_steer_pos", "cntrl_pos", rows, 2 * 0x4000 - raw)
    return expect(
        Rule.RELAY,
        "req_steer_pos",
        "cntrl_pos",
        rows[0],
        place(Rule.AGREEMENT, "steering_report", "steering_motor_ang_avg_fdbk"),
    )


@defect("sign", "negative angles as sign and magnitude")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("steering_report_extd")
    raw = traffic.raw("steering_report_extd", "steering_motor_ang_2_fdbk", rows)
    wrong = np.where(raw < 0, -1024 - raw, raw)
    traffic.set_raw("steering_report_extd", "steering_motor_ang_2_fdbk", rows, wrong)
    return expect(
        Rule.SLEW,
        "steering_report_extd",
        "steering_motor_ang_2_fdbk",
        rows[np.argmax(raw < 0)],
        place(Rule.RELAY, "steering_report_extd", "steering_motor_ang_2_fdbk"),
    )


# --- scale, offset and resolution -------------------------------------------------------------------------------------


@defect("scale", "vehicle speed in miles per hour")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("pt_report_1", 8.0)
    speed = traffic.get("pt_report_1", "vehicle_speed_kmph", rows)
    traffic.set("pt_report_1", "vehicle_speed_kmph", rows, speed * 0.621)
    return expect(
        Rule.AGREEMENT,
        "pt_report_1",
        "vehicle_speed_kmph",
        rows[0],
        place(Rule.RELAY, "req_steer_pos", "veh_speed"),
    )


@defect("scale", "front brake pressure in psi")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("brake_pressure_report", 3.0)
    pressure = traffic.get("brake_pressure_report", "brake_pressure_fdbk_front", rows)
    traffic.set("brake_pressure_report", "brake_pressure_fdbk_front", rows, pressure * 0.145)
    return expect(Rule.AGREEMENT, "brake_pressure_report", "brake_pressure_fdbk_front", rows[0])


@defect("scale", "rear brake pressure in bar")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("brake_pressure_report", 3.0)
    pressure = traffic.get("brake_pressure_report", "brake_pressure_fdbk_rear", rows)
    traffic.set("brake_pressure_report", "brake_pressure_fdbk_rear", rows, pressure * 0.01)
    return expect(Rule.AGREEMENT, "brake_pressure_report", "brake_pressure_fdbk_rear", rows[0])


@defect("scale", "brake request scaled for 8191 kPa")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("req_brake_pos", traffic.braking_s())
    raw = traffic.raw("req_brake_pos", "contrl_pos_brk", rows)
    traffic.set_raw("req_brake_pos", "contrl_pos_brk", rows, 0x4000 - (0x4000 - raw) * 6000 // 8191)
    return expect(
        Rule.RELAY,
        "req_brake_pos",
        "contrl_pos_brk",
        rows[0],
        *(place(Rule.RELAY, f"stat_brk_{i}", "curr_ip_dvc_pos") for i in (1, 2, 3)),
    )


@defect("scale", "gauge pressure of a tyre in kPa")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("Tire_Pressure_FL", DRIVING_S)
    pressure = traffic.get("Tire_Pressure_FL", "FL_Tire_Pressure_Gauge", rows)
    traffic.set("Tire_Pressure_FL", "FL_Tire_Pressure_Gauge", rows, pressure / 10.0)
    return expect(Rule.AGREEMENT, "Tire_Pressure_FL", "FL_Tire_Pressure_Gauge", rows[0])


@defect("scale", "battery voltage in whole volts")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("misc_report", 2.0)
    volts = traffic.get("misc_report", "battery_voltage", rows)
    traffic.set_raw("misc_report", "battery_voltage", rows, np.rint(volts).astype(np.int64))
    return expect(Rule.AGREEMENT, "misc_report", "battery_voltage", rows[0])


@defect("scale", "accelerator feedback from 0 to 1")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("accelerator_report", 7.0)
    traffic.set(
        "accelerator_report", "acc_pedal_fdbk", rows, traffic.get("accelerator_report", "acc_pedal_fdbk", rows) / 100
    )
    return expect(Rule.RELAY, "accelerator_report", "acc_pedal_fdbk", rows[0])


@defect("scale", "wheel speed for the onboard computer in km/h")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("vehicle_status", 7.0)
    traffic.set("vehicle_status", "obc_wheel_speed", rows, traffic.get("vehicle_status", "obc_wheel_speed", rows) * 3.6)
    return expect(Rule.AGREEMENT, "vehicle_status", "obc_wheel_speed", rows[0])


def put_places(traffic: Traffic, message: str) -> Rows:
    """Let a receiver of the car tell its place five times a second, as the other one has it."""
    rows = traffic.rows("gnss_a_position", 1.1)[::4]
    places = np.stack([traffic.get("gnss_a_position", f"gnss_a_{axis}", rows) for axis in ("latitude", "longitude")])
    traffic.insert(database.message(message), places.T, traffic.frames["time_us"][rows].astype(np.int64))
    return traffic.rows(message)


@defect("scale", "pitt: latitude scaled twice in the Marelli report")
def _(traffic: Traffic) -> Expected:
    rows = put_places(traffic, "marelli_report_2")
    latitude = traffic.get("marelli_report_2", "marelli_gps_lat", rows)
    traffic.set("marelli_report_2", "marelli_gps_lat", rows, latitude * 1e-7)
    cycle = place(Rule.CYCLE, "marelli_report_2")
    return expect(Rule.AGREEMENT, "marelli_report_2", "marelli_gps_lat", rows[0], cycle)


@defect("scale", "longitude in millionths of a degree")
def _(traffic: Traffic) -> Expected:
    rows = put_places(traffic, "mylaps_report_2")
    longitude = traffic.get("mylaps_report_2", "Longitude", rows)
    traffic.set("mylaps_report_2", "Longitude", rows, longitude / 10.0)
    return expect(Rule.AGREEMENT, "mylaps_report_2", "Longitude", rows[0])


@defect("scale", "latitude and longitude exchanged")
def _(traffic: Traffic) -> Expected:
    rows = put_places(traffic, "mylaps_report_2")
    latitude, longitude = (traffic.get("mylaps_report_2", name, rows) for name in ("Latitude", "Longitude"))
    traffic.set("mylaps_report_2", "Latitude", rows, longitude)
    traffic.set("mylaps_report_2", "Longitude", rows, latitude)
    return expect(
        Rule.AGREEMENT, "mylaps_report_2", "Latitude", rows[0], place(Rule.AGREEMENT, "mylaps_report_2", "Longitude")
    )


@defect("offset", "vertical acceleration with gravity")
def _(traffic: Traffic) -> Expected:
    message, signal = "ct_vehicle_acc_feedback", "vertical_ct_vehicle_acc_fbk"
    rows = traffic.rows(message)
    traffic.set(message, signal, rows, traffic.get(message, signal, rows) + 1.0)
    # A second after the first wheel speed the car is known to stand.
    speeds = traffic.frames["time_us"][traffic.rows("wheel_speed_report")[0]]
    return expect(Rule.AGREEMENT, message, signal, rows[traffic.frames["time_us"][rows] >= speeds + 1_000_000][0])


@defect("resolution", "dspace: steering command rounded to an integer")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("steering_cmd")
    angles = traffic.get("steering_cmd", "steering_motor_ang_cmd", rows)
    traffic.set("steering_cmd", "steering_motor_ang_cmd", rows, np.trunc(angles))
    # The Raptor passes on what it gets.
    requests = traffic.rows("req_steer_pos", DRIVING_S)
    traffic.set(
        "req_steer_pos", "cntrl_pos", requests, np.rint(0x4000 * (1 + np.trunc(angles[-len(requests) :]) / 240))
    )
    return expect(Rule.RESOLUTION, "steering_cmd", "steering_motor_ang_cmd", rows[0])


@defect("resolution", "accelerator command in whole percents")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("accelerator_cmd")
    pedal = np.rint(traffic.get("accelerator_cmd", "acc_pedal_cmd", rows))
    traffic.set("accelerator_cmd", "acc_pedal_cmd", rows, pedal)
    reports = traffic.rows("accelerator_report", DRIVING_S)
    traffic.set("accelerator_report", "acc_pedal_fdbk", reports, pedal[-len(reports) :])
    reported = place(Rule.RESOLUTION, "accelerator_report", "acc_pedal_fdbk")
    return expect(Rule.RESOLUTION, "accelerator_cmd", "acc_pedal_cmd", rows[0], reported)


@defect("resolution", "acceleration in tenths of a G")
def _(traffic: Traffic) -> Expected:
    message, signal = "ct_vehicle_acc_feedback", "long_ct_vehicle_acc_fbk"
    rows = traffic.rows(message)
    traffic.set(message, signal, rows, np.round(traffic.get(message, signal, rows), 1))
    return expect(Rule.RESOLUTION, message, signal, rows[0])


# --- rounding ---------------------------------------------------------------------------------------------------------


def steer_counts(angles: Values) -> Values:
    """Of the Space Drive, exactly."""
    return 0x4000 * (1 + angles / 240)


@defect("rounding", "steering request cut off and not rounded")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("req_steer_pos", DRIVING_S)
    exact = steer_counts(
        traffic.get("steering_cmd", "steering_motor_ang_cmd", traffic.rows("steering_cmd"))[-len(rows) :]
    )
    traffic.set_raw("req_steer_pos", "cntrl_pos", rows, np.floor(exact).astype(np.int64))
    return expect(Rule.ROUNDING, "req_steer_pos", "cntrl_pos", rows[np.argmax(exact % 1 > 0.51)])


@defect("rounding", "brake request cut off and not rounded")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("req_brake_pos", traffic.braking_s())
    pressure = traffic.get("brake_pressure_cmd", "brake_pressure_cmd", traffic.rows("brake_pressure_cmd"))[-len(rows) :]
    exact = 0x4000 * (1 - pressure / 6000)
    traffic.set_raw("req_brake_pos", "contrl_pos_brk", rows, np.floor(exact).astype(np.int64))
    return expect(
        Rule.ROUNDING,
        "req_brake_pos",
        "contrl_pos_brk",
        rows[np.argmax(exact % 1 > 0.51)],
        *(place(Rule.RELAY, f"stat_brk_{i}", "curr_ip_dvc_pos") for i in (1, 2, 3)),
    )


@defect("rounding", "accelerator feedback cut off and not rounded")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("accelerator_report", 7.0)
    pedal = traffic.get("accelerator_cmd", "acc_pedal_cmd", traffic.rows("accelerator_cmd"))[-len(rows) :]
    traffic.set_raw("accelerator_report", "acc_pedal_fdbk", rows, np.floor(pedal * 10 + 1e-6).astype(np.int64))
    return expect(
        Rule.ROUNDING, "accelerator_report", "acc_pedal_fdbk", rows[np.argmax(np.round(pedal * 10 % 1, 6) > 0.51)]
    )


@defect("rounding", "angle of a steering sensor cut off and not rounded")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("steering_report_extd")
    counts = traffic.get("calb_steer_pos_1", "cur_steer_pos_steering_pos_1", traffic.rows("calb_steer_pos_1"))
    exact = np.concatenate([[0.0], (counts - 0x4000) / 0x4000 * 480])[: len(rows)]
    traffic.set_raw("steering_report_extd", "steering_motor_ang_1_fdbk", rows, np.trunc(exact).astype(np.int64))
    return expect(
        Rule.ROUNDING,
        "steering_report_extd",
        "steering_motor_ang_1_fdbk",
        rows[np.argmax(np.abs(exact) % 1 > 0.51)],
    )


@defect("rounding", "average steering angle cut off and not rounded")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("steering_report", 1.0)
    angles = traffic.raw("steering_report", "steering_motor_ang_avg_fdbk", rows)
    wrong = np.where(angles > 4, angles - 1, angles)
    traffic.set_raw("steering_report", "steering_motor_ang_avg_fdbk", rows, wrong)
    return expect(Rule.AGREEMENT, "steering_report", "steering_motor_ang_avg_fdbk", rows[np.argmax(angles > 4)])


# --- range ------------------------------------------------------------------------------------------------------------


def one_value(message: str, signal: str, value: float, rule: Rule, *also: Place) -> Plant:
    """A single frame with a value that cannot be."""

    def plant(traffic: Traffic) -> Expected:
        rows = traffic.rows(message, DRIVING_S)[7:8]
        traffic.set(message, signal, rows, value)
        return expect(rule, message, signal, rows[0], *also)

    return plant


for _message, _signal, _value, _also in (
    ("pt_report_1", "throttle_position", 120.0, ()),
    ("wheel_speed_report", "wheel_speed_RR", 341.0, (Rule.SLEW,)),
    ("diagnostic_report", "motec_warning", 32.0, ()),
    ("accelerator_cmd", "acc_pedal_cmd", -151.0, ()),
    ("pt_report_2", "fuel_pressure_kPa", 1000.1, ()),
    ("pt_report_1", "engine_speed_rpm", 16001.0, (Rule.SLEW,)),
):
    defect("range", f"{_signal} is {_value:g}")(
        one_value(_message, _signal, _value, Rule.RANGE, *(place(rule, _message, _signal) for rule in _also))
    )

for _message, _signal, _value, _also in (
    ("base_to_car_summary", "track_flag", 9.0, ()),
    ("base_to_car_summary", "veh_flag", 6.0, ()),
    ("pt_report_1", "gear_shift_status", 5.0, ()),
    ("ssm_status", "ssm_state", 9.0, ()),
    ("ct_report_2", "marelli_track_flag_ack", 2.0, ()),
):
    defect("range", f"{_signal} has the value {_value:g}, which stands for nothing")(
        one_value(_message, _signal, _value, Rule.VALUE, *_also)
    )


# --- slew -------------------------------------------------------------------------------------------------------------


for _message, _signal, _value, _also in (
    ("steering_cmd", "steering_motor_ang_cmd", 40.0, ()),
    ("steering_report_extd", "steering_motor_ang_3_fdbk", -60.0, ()),
    ("brake_pressure_report", "brake_pressure_fdbk_front", 4096.0, ()),
    ("wheel_speed_report", "wheel_speed_FL", 200.0, ()),
    ("gnss_b_position", "gnss_b_latitude", 36.4, ()),
    ("Tire_Temp_RR_3", "RR_Tire_Temp_11", 90.0, ()),
    ("calb_brake_pos_2", "cur_brake_pos_brake_pos_2", 3000.0, ()),
):
    defect("slew", f"{_signal} is {_value:g} for a single frame")(
        one_value(_message, _signal, _value, Rule.SLEW, *_also)
    )


# --- counter ----------------------------------------------------------------------------------------------------------


def count(message: str, wanted: Callable[[NDArray[np.int64]], NDArray[np.int64]], rule: Rule, first: int) -> Plant:
    """Counters as a function of the right ones from the hundredth frame on; which of these is the first to tell."""

    def plant(traffic: Traffic) -> Expected:
        counter = database.facts(message).counter
        assert counter is not None
        rows = traffic.rows(message)[100:]
        raw = traffic.raw(message, counter.name, rows)
        traffic.set_raw(message, counter.name, rows, wanted(raw))
        return expect(rule, message, counter.name, rows[first])

    return plant


defect("counter", "tum: steering command without counter")(
    count("steering_cmd", lambda raw: np.full_like(raw, 99), Rule.STUCK, 0)
)
defect("counter", "a counter that goes by two")(
    count("accelerator_cmd", lambda raw: (2 * raw - 99) % 256, Rule.JUMP, 0)
)
defect("counter", "a counter that goes down")(count("brake_pressure_cmd", lambda raw: (200 - raw) % 256, Rule.JUMP, 1))


@defect("counter", "a counter that ends at 9")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("brake_pressure_report")
    traffic.set("brake_pressure_report", "brk_pressure_fdbk_counter", rows, np.arange(len(rows)) % 10)
    return expect(Rule.JUMP, "brake_pressure_report", "brk_pressure_fdbk_counter", rows[10])


@defect("counter", "each value of the counter twice")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("ct_report")
    traffic.set("ct_report", "ct_state_rolling_counter", rows, np.arange(len(rows)) // 2)
    return expect(Rule.STUCK, "ct_report", "ct_state_rolling_counter", rows[1])


@defect("counter", "a frame is lost")
def _(traffic: Traffic) -> Expected:
    traffic.drop(traffic.rows("accelerator_cmd")[200:201])
    return expect(Rule.JUMP, "accelerator_cmd", "acc_pedal_cmd_counter", traffic.rows("accelerator_cmd")[200])


@defect("counter", "a frame comes twice")
def _(traffic: Traffic) -> Expected:
    row = traffic.rows("steering_cmd")[200]
    traffic.frames = np.insert(traffic.frames, row, traffic.frames[row])
    return expect(Rule.STUCK, "steering_cmd", "steering_motor_cmd_counter", row + 1)


@defect("counter", "two frames in the wrong order")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("estimate_position")[300:302]
    traffic.frames["data"][rows] = traffic.frames["data"][rows[::-1]]
    return expect(Rule.JUMP, "estimate_position", "estimate_position_counter", rows[0])


# --- CRC --------------------------------------------------------------------------------------------------------------


@defect("CRC", "a bit is changed on the way")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("calb_steer_pos_1")[-1:]
    traffic.frames["data"][rows, 0] ^= 0x10
    return expect(Rule.CRC, "calb_steer_pos_1", "CCIT_CRC", rows[0])


@defect("CRC", "the counter is set after the CRC")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("req_brake_pos")
    traffic.frames["data"][rows, 5] += 1
    return expect(Rule.CRC, "req_brake_pos", "CCIT_CRC", rows[0])


@defect("CRC", "the CRC has its bytes in the other order")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("req_steer_pos")
    swap(traffic, 6, rows)
    data = traffic.frames["data"][rows]
    # A few have both bytes the same and are taken, with what the counter has become in between.
    jump = place(Rule.JUMP, "req_steer_pos", "Appl_Message_counter")
    return expect(Rule.CRC, "req_steer_pos", "CCIT_CRC", rows[np.argmax(data[:, 6] != data[:, 7])], jump)


@defect("CRC", "the CRC leaves the identifier out")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("calb_brake_pos_3")
    for row in rows:
        crc = 0xFFFF
        for byte in traffic.frames["data"][row, :6].tolist():
            crc ^= byte << 8
            for _ in range(8):
                crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
        traffic.frames["data"][row, 6:] = crc & 0xFF, crc >> 8
    return expect(Rule.CRC, "calb_brake_pos_3", "CCIT_CRC", rows[0])


@defect("CRC", "masquerade: frames of one channel under the identifier of another one")
def _(traffic: Traffic) -> Expected:
    one, other = (traffic.rows(f"calb_steer_pos_{i}") for i in (2, 3))
    traffic.frames["data"][other] = traffic.frames["data"][one[: len(other)]]
    return expect(Rule.CRC, "calb_steer_pos_3", "CCIT_CRC", other[0])


# --- timing -----------------------------------------------------------------------------------------------------------


@defect("timing", "gaia: a timer of 20 Hz runs at 5 Hz")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("gnss_a_position")
    traffic.drop(np.setdiff1d(rows, rows[::4]))
    return expect(Rule.CYCLE, "gnss_a_position", "", traffic.rows("gnss_a_position")[0])


@defect("timing", "a message of 10 Hz is sent with 20 Hz")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("base_to_car_timing")
    values = database.message("base_to_car_timing").columns(traffic.frames[rows]).T
    times = traffic.frames["time_us"][rows].astype(np.int64) + 50_000
    traffic.insert(database.message("base_to_car_timing"), values, times)
    return expect(Rule.CYCLE, "base_to_car_timing", "", traffic.rows("base_to_car_timing")[0])


@defect("timing", "a pause that is longer than the time-out")
def _(traffic: Traffic) -> Expected:
    traffic.drop(traffic.rows("wheel_speed_report")[700:711])
    return expect(Rule.TIMEOUT, "wheel_speed_report", "", traffic.rows("wheel_speed_report")[700])


@defect("timing", "a message ends while its sender goes on")
def _(traffic: Traffic) -> Expected:
    traffic.drop(traffic.rows("stat_steer_2", 9.0))
    return expect(Rule.TIMEOUT, "stat_steer_2", "", traffic.rows("stat_steer_2")[-1])


@defect("timing", "the clock of the logger goes back")
def _(traffic: Traffic) -> Expected:
    on_bus = np.flatnonzero(traffic.frames["bus"] == Bus.CAN3)
    after = on_bus[len(on_bus) // 2 :]
    traffic.frames["time_us"][after] -= 20_000
    return Expected(Place(Rule.CLOCK, Bus.CAN3), int(after[0]))


@defect("timing", "awsim: no diagnostic report")
def _(traffic: Traffic) -> Expected:
    traffic.drop(traffic.rows("diagnostic_report"))
    sent = min(
        traffic.rows(codec.name)[0]
        for codec in database
        if codec.bus is Bus.CAN1 and codec.definition.senders[0] == "RAPTOR" and len(traffic.rows(codec.name))
    )
    return expect(Rule.MISSING, "diagnostic_report", "", sent)


@defect("timing", "no acknowledgement of Marelli flags")
def _(traffic: Traffic) -> Expected:
    traffic.drop(traffic.rows("ct_report_2"))
    return expect(Rule.MISSING, "ct_report_2", "", traffic.rows("brake_pressure_cmd")[0])


# --- stuck ------------------------------------------------------------------------------------------------------------


def still_from(traffic: Traffic, message: str, signal: str, after_s: float) -> Rows:
    """Let a value stay what it is."""
    rows = traffic.rows(message, after_s)
    traffic.set(message, signal, rows, traffic.get(message, signal, rows[:1])[0])
    return rows


def overdue(traffic: Traffic, rows: Rows, limit_us: int) -> int:
    """The first of frames that is later than the first one by more than that."""
    times = traffic.frames["time_us"][rows].astype(np.int64)
    return int(rows[np.argmax(times - times[0] > limit_us)])


@defect("stuck", "race control's heartbeat stands still")
def _(traffic: Traffic) -> Expected:
    rows = still_from(traffic, "base_to_car_summary", "base_to_car_heartbeat", DRIVING_S)
    return expect(Rule.FROZEN, "base_to_car_summary", "base_to_car_heartbeat", overdue(traffic, rows, 1_000_000))


@defect("stuck", "race control's clock stands still")
def _(traffic: Traffic) -> Expected:
    rows = still_from(traffic, "base_to_car_timing", "time_stamp", DRIVING_S)
    return expect(Rule.FROZEN, "base_to_car_timing", "time_stamp", overdue(traffic, rows, 1_000_000))


@defect("stuck", "pitt: the vehicle number is never set")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("ct_report")
    traffic.set("ct_report", "veh_num", rows, 0.0)
    return expect(Rule.NEVER_SET, "ct_report", "veh_num", rows[0])


@defect("stuck", "the average steering angle stays at 0")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("steering_report")
    angles = traffic.get("steering_report", "steering_motor_ang_avg_fdbk", rows)
    traffic.set("steering_report", "steering_motor_ang_avg_fdbk", rows, 0.0)
    return expect(Rule.AGREEMENT, "steering_report", "steering_motor_ang_avg_fdbk", rows[np.argmax(angles != 0.0)])


@defect("stuck", "the last brake pressure stays in the report")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("brake_pressure_report", 5.0)
    pressure = traffic.get("brake_pressure_report", "brake_pressure_fdbk_front", rows)
    traffic.set("brake_pressure_report", "brake_pressure_fdbk_front", rows, pressure[0])
    requests = traffic.rows("req_brake_pos")
    wanted = 6000 * (1 - traffic.get("req_brake_pos", "contrl_pos_brk", requests) / 0x4000)
    request_times = traffic.frames["time_us"][requests].astype(np.int64)

    def asked(row: np.intp) -> float:
        """Largest pressure asked for within a second before a frame."""
        time_us = int(traffic.frames["time_us"][row])
        begin = np.searchsorted(request_times, time_us - 1_000_000, side="right") - 1
        end = np.searchsorted(request_times, time_us + 10_000, side="right")
        return float(wanted[begin:end].max())

    first = next(row for row in rows if pressure[0] > asked(row) * 1.15 + 400.0)
    return expect(Rule.AGREEMENT, "brake_pressure_report", "brake_pressure_fdbk_front", first)


@defect("stuck", "a brake channel of the Space Drive stays where it is")
def _(traffic: Traffic) -> Expected:
    rows = still_from(traffic, "calb_brake_pos_3", "cur_brake_pos_brake_pos_3", 5.0)
    both = [traffic.rows(f"calb_brake_pos_{i}", 4.99) for i in (1, 2)]
    still = traffic.get("calb_brake_pos_3", "cur_brake_pos_brake_pos_3", rows[:1])[0]
    others = [
        traffic.get(f"calb_brake_pos_{i}", f"cur_brake_pos_brake_pos_{i}", own)
        for i, own in zip((1, 2), both, strict=True)
    ]
    # Below both by more than 300 kPa, also with what they had two frames before.
    lowest = np.min([np.minimum.reduce([one[2:], one[1:-1], one[:-2]]) for one in others], axis=0)
    first = np.argmax(lowest - still > 300 / 6000 * 0x4000)
    return expect(Rule.AGREEMENT, "calb_brake_pos_3", "cur_brake_pos_brake_pos_3", rows[first + 1])


@defect("stuck", "switches of the driver come back as the default")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("pt_report_3", DRIVING_S)
    traffic.set("pt_report_3", "driver_traction_aim_swicth_fbk", rows, -1.0)
    return expect(Rule.RELAY, "pt_report_3", "driver_traction_aim_swicth_fbk", rows[0])


# --- copies -----------------------------------------------------------------------------------------------------------


def copied(message: str, signal: str, source: str, named: str) -> Plant:
    """A signal has the values of another one of its message; a checker can name only the later one of both."""

    def plant(traffic: Traffic) -> Expected:
        rows = traffic.rows(message)
        traffic.set(message, signal, rows, traffic.get(message, source, rows))
        return expect(Rule.COPY, message, named, rows[0])

    return plant


defect("copy", "pitt: the rear left load is the front left one")(
    copied("wheel_strain_gauge", "wheel_strain_gauge_RL", "wheel_strain_gauge_FL", "wheel_strain_gauge_RL")
)
defect("copy", "awsim: the front left load is the front right one")(
    copied("wheel_strain_gauge", "wheel_strain_gauge_FL", "wheel_strain_gauge_FR", "wheel_strain_gauge_FR")
)
defect("copy", "suspension travel of the rear right wheel is that of the left one")(
    copied("wheel_potentiometer_data", "wheel_potentiometer_RR", "wheel_potentiometer_RL", "wheel_potentiometer_RR")
)
defect("copy", "the rear brake pressure is the front one")(
    copied(
        "brake_pressure_report",
        "brake_pressure_fdbk_rear",
        "brake_pressure_fdbk_front",
        "brake_pressure_fdbk_rear",
    )
)


def warm_up(traffic: Traffic, tyre: str, degrees: float) -> None:
    """Let a tyre get so much warmer within the recording."""
    for part in range(1, 5):
        message = f"Tire_Temp_{tyre}_{part}"
        rows = traffic.rows(message)
        for i in range(1, 5):
            signal = f"{tyre}_Tire_Temp_{4 * (part - 1) + i:02d}"
            traffic.set(message, signal, rows, 40.0 + np.linspace(0.0, degrees, len(rows)))


@defect("copy", "purdue: the means of the rear tyres overwrite those of the front ones")
def _(traffic: Traffic) -> Expected:
    for tyre, degrees in (("FL", 12.0), ("FR", 9.0), ("RL", 12.0), ("RR", 9.0)):
        warm_up(traffic, tyre, degrees)
    parts = [(tyre, part) for tyre in ("RL", "RR") for part in range(1, 5)]
    places = [
        place(Rule.COPY, f"Tire_Temp_{tyre}_{part}", f"{tyre}_Tire_Temp_{4 * part - 3:02d}") for tyre, part in parts
    ]
    rows = traffic.rows("Tire_Temp_RL_1")
    return Expected(places[0], int(rows[0]), frozenset(places[1:]))


@defect("copy", "pitt: the means of the rear left tyre are those of the front left one")
def _(traffic: Traffic) -> Expected:
    for tyre, degrees in (("FL", 12.0), ("FR", 9.0), ("RL", 12.0), ("RR", 6.0)):
        warm_up(traffic, tyre, degrees)
    places = [place(Rule.COPY, f"Tire_Temp_RL_{part}", f"RL_Tire_Temp_{4 * part - 3:02d}") for part in range(1, 5)]
    return Expected(places[0], int(traffic.rows("Tire_Temp_RL_1")[0]), frozenset(places[1:]))


@defect("copy", "tyre pressure of one wheel under the identifier of another one, too")
def _(traffic: Traffic) -> Expected:
    rows, source = traffic.rows("Tire_Pressure_FR"), traffic.rows("Tire_Pressure_FL")
    pressure = 2600.0 + np.arange(len(rows)) // 2
    for message, own, wheel in (("Tire_Pressure_FL", source, "FL"), ("Tire_Pressure_FR", rows, "FR")):
        traffic.set(message, f"{wheel}_Tire_Pressure", own, pressure[: len(own)])
        traffic.set(message, f"{wheel}_Tire_Pressure_Gauge", own, pressure[: len(own)] - 1013.0)
    return expect(Rule.COPY, "Tire_Pressure_FR", "FR_Tire_Pressure", rows[0])


# --- sequence ---------------------------------------------------------------------------------------------------------


@defect("sequence", "ct_state from RACEREADY to NOM_RACE")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("ct_report")
    states = traffic.get("ct_report", "ct_state", rows)
    traffic.set("ct_report", "ct_state", rows, np.where((states == 7) | (states == 8), 9.0, states))
    first = rows[np.argmax((states == 7) | (states == 8))]
    return expect(Rule.SEQUENCE, "ct_report", "ct_state", first, place(Rule.RELAY, "ct_report", "ct_state"))


@defect("sequence", "sys_state back to PWR_ON for a frame")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("misc_report", DRIVING_S)[:1]
    traffic.set("misc_report", "sys_state", rows, 1.0)
    return expect(Rule.SEQUENCE, "misc_report", "sys_state", rows[0])


@defect("sequence", "a gear is skipped")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("gear_shift_cmd")
    gears = traffic.get("gear_shift_cmd", "desired_gear", rows)
    traffic.set("gear_shift_cmd", "desired_gear", rows, np.where(gears == 1, 0.0, gears))
    return expect(Rule.SEQUENCE, "gear_shift_cmd", "desired_gear", rows[np.argmax(gears == 2)])


@defect("sequence", "a gear for two tenths of a second")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("gear_shift_cmd")
    gears = traffic.get("gear_shift_cmd", "desired_gear", rows)
    second = int(np.argmax(gears == 2))
    wrong = gears.copy()
    wrong[int(np.argmax(gears == 1)) : second - 2] = 0.0
    traffic.set("gear_shift_cmd", "desired_gear", rows, wrong)
    return expect(Rule.SEQUENCE, "gear_shift_cmd", "desired_gear", rows[second])


# --- between messages -------------------------------------------------------------------------------------------------


@defect("between messages", "accelerator and brake are commanded together")
def _(traffic: Traffic) -> Expected:
    # The car is braked and does not drive yet.
    rows = traffic.rows("accelerator_cmd", 3.0)[:60]
    traffic.set("accelerator_cmd", "acc_pedal_cmd", rows, 30.0)
    return expect(Rule.PEDALS, "accelerator_cmd", "acc_pedal_cmd", rows[0])


def delayed(traffic: Traffic, message: str, signal: str, by: int) -> Rows:
    """Let a value come so many frames later; gives where it is wrong."""
    rows = traffic.rows(message)
    values = traffic.get(message, signal, rows)
    late = np.concatenate([np.repeat(values[0], by), values[:-by]])
    traffic.set(message, signal, rows, late)
    return rows[late != values]


@defect("between messages", "the flag of the track is acknowledged half a second too late")
def _(traffic: Traffic) -> Expected:
    delayed(traffic, "ct_report", "track_cond_ack", 10)
    rows, flags = traffic.rows("ct_report"), traffic.rows("base_to_car_summary")
    values = traffic.get("base_to_car_summary", "track_flag", flags)
    times, flag_times = (traffic.frames["time_us"][own].astype(np.int64) for own in (rows, flags))
    # The first flag is in the recording from its beginning; it had to be there 200 ms later.
    acknowledged = traffic.get("ct_report", "track_cond_ack", rows)
    before = np.searchsorted(flag_times, times - 200_000, side="right") - 1
    after = np.searchsorted(flag_times, times + 10_000, side="right")
    wrong = [
        begin >= 0 and value not in values[begin:end]
        for value, begin, end in zip(acknowledged, before, after, strict=True)
    ]
    return expect(Rule.ACKNOWLEDGEMENT, "ct_report", "track_cond_ack", rows[np.argmax(wrong)])


@defect("between messages", "the flag of the vehicle is never acknowledged")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("ct_report")
    traffic.set("ct_report", "veh_sig_ack", rows, 0.0)
    flags = traffic.rows("base_to_car_summary")
    raised = flags[np.argmax(traffic.get("base_to_car_summary", "veh_flag", flags) == 4)]
    due_us = int(traffic.frames["time_us"][raised]) + 200_000
    first = rows[np.argmax(traffic.frames["time_us"][rows] >= due_us)]
    return expect(Rule.ACKNOWLEDGEMENT, "ct_report", "veh_sig_ack", first)


@defect("between messages", "flags of track and vehicle are acknowledged in each other's place")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("ct_report", 0.5)
    track, vehicle = (traffic.get("ct_report", name, rows) for name in ("track_cond_ack", "veh_sig_ack"))
    traffic.set("ct_report", "track_cond_ack", rows, vehicle)
    traffic.set("ct_report", "veh_sig_ack", rows, track)
    return expect(
        Rule.ACKNOWLEDGEMENT,
        "ct_report",
        "veh_sig_ack",
        rows[0],
        place(Rule.ACKNOWLEDGEMENT, "ct_report", "track_cond_ack"),
        place(Rule.VALUE, "ct_report", "veh_sig_ack"),
    )


@defect("between messages", "a flag of the Marelli system is not acknowledged")
def _(traffic: Traffic) -> Expected:
    raised = traffic.rows("marelli_report_1", DRIVING_S)
    traffic.set("marelli_report_1", "marelli_vehicle_flag", raised, 25.0)
    rows = traffic.rows("ct_report_2")
    due_us = int(traffic.frames["time_us"][raised[0]]) + 100_000
    return expect(
        Rule.ACKNOWLEDGEMENT,
        "ct_report_2",
        "marelli_vehicle_flag_ack",
        rows[np.argmax(traffic.frames["time_us"][rows] >= due_us)],
    )


@defect("between messages", "one of three steering sensors is 10 deg beside the others")
def _(traffic: Traffic) -> Expected:
    message, signal = "calb_steer_pos_2", "cur_steer_pos_steering_pos_2"
    rows = traffic.rows(message, 7.0)
    traffic.set(message, signal, rows, traffic.get(message, signal, rows) + round(10 / 240 * 0x4000))
    return expect(
        Rule.AGREEMENT,
        message,
        signal,
        rows[0],
        place(Rule.SLEW, message, signal),
        place(Rule.RELAY, "steering_report_extd", "steering_motor_ang_2_fdbk"),
    )


@defect("between messages", "one of three reported steering angles is that of another sensor, a step beside")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("steering_report_extd", 7.0)
    raw = traffic.raw("steering_report_extd", "steering_motor_ang_1_fdbk", rows)
    traffic.set_raw("steering_report_extd", "steering_motor_ang_1_fdbk", rows, raw + 8)
    return expect(Rule.RELAY, "steering_report_extd", "steering_motor_ang_1_fdbk", rows[0])


@defect("between messages", "the car goes on with the steering request of before")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("req_steer_pos", 9.0)
    traffic.set_raw("req_steer_pos", "cntrl_pos", rows, round(0x4000 * (1 - 20 / 240)))
    return expect(
        Rule.RELAY,
        "req_steer_pos",
        "cntrl_pos",
        rows[0],
        place(Rule.AGREEMENT, "steering_report", "steering_motor_ang_avg_fdbk"),
    )


@defect("between messages", "the onboard computer has another gear than the gearbox")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("vehicle_status", DRIVING_S)
    traffic.set("vehicle_status", "obc_gear", rows, 5.0)
    return expect(Rule.RELAY, "vehicle_status", "obc_gear", rows[0])


@defect("between messages", "the onboard computer has another target speed than race control")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("vehicle_status", 7.0)
    traffic.set("vehicle_status", "obc_round_target_speed", rows, 50.0)
    return expect(Rule.RELAY, "vehicle_status", "obc_round_target_speed", rows[0])


@defect("between messages", "laps differ between summary and timing")
def _(traffic: Traffic) -> Expected:
    rows = traffic.rows("base_to_car_timing", DRIVING_S)
    traffic.set("base_to_car_timing", "laps", rows, 1.0)
    return expect(Rule.RELAY, "base_to_car_timing", "laps", rows[0])
