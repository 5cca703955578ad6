"""The onboard computer alone on its buses: healthy frames of everybody else, any of which a test can change or stop."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import FRAME_SIZE, FRAME_STRUCT, Frame, iterate
from firmware.parameters import encode_operation, load_operation
from firmware.tables import own_parameters

TICK_US = 10_000
OPERATIONS = Path(__file__).resolve().parents[1] / "scenarios" / "operations"
OPERATION = OPERATIONS / "solo.yaml"
CAPACITY = 256

#: Signals of each sensor in whose last bit its noise shows, and that bit's worth.
NOISY = {
    "gnss_a_position": ("gnss_a_latitude", 1e-7), "gnss_a_velocity": ("gnss_a_velocity_up", 0.005),
    "gnss_a_attitude": ("gnss_a_yaw", 1e-4),
    "gnss_b_position": ("gnss_b_latitude", 1e-7), "gnss_b_velocity": ("gnss_b_velocity_up", 0.005),
    "gnss_b_attitude": ("gnss_b_yaw", 1e-4),
    "imu_rates": ("imu_roll_rate", 2e-4), "imu_specific_force": ("imu_specific_force_x", 0.002),
}  # fmt: skip

#: What an obedient car reports: report, its signal, and the command that it follows.
OBEDIENCE = {
    "steering_report": ("steering_motor_ang_avg_fdbk", "steering_cmd", "steering_motor_ang_cmd"),
    "brake_pressure_report": ("brake_pressure_fdbk_front", "brake_pressure_cmd", "brake_pressure_cmd"),
    "accelerator_report": ("acc_pedal_fdbk", "accelerator_cmd", "acc_pedal_cmd"),
    "pt_report_1": ("current_gear", "gear_shift_cmd", "desired_gear"),
}
EARTH_RADIUS = 6_378_137.0  # m, equatorial, WGS 84


def cast_frames(frames: bytes) -> tuple[object, int]:
    """C array of the frames (keeps the bytes alive as long as it lives) and its length."""
    count = len(frames) // FRAME_SIZE
    array = ffi.new("can_frame[]", max(count, 1))
    ffi.memmove(array, frames, len(frames))
    return array, count


class Outbox:
    """A can_outbox with its storage."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self.storage = ffi.new("can_frame[]", max(capacity, 1))
        self.c = ffi.new("can_outbox *", {"frames": self.storage, "capacity": capacity})

    def take(self) -> bytes:
        """Frames that were sent; the box is empty afterwards."""
        content = bytes(ffi.buffer(self.storage, self.c.count * FRAME_SIZE))
        self.c.count = 0
        return content


class ObcHarness:
    """An onboard computer and, message by message, what it hears.

    `signals` holds the values of every message that is sent, by name (counters are filled in, and so are, where they
    say nothing, the noise of sensors and what an obedient car reports of its commands); a message that is not in
    `periods` is silent. Both are the test's to change. `received` holds the newest frame by message name.

    With `perception` it is the computer of a car that sees others: the nodes of perception report, and there is notice
    of scans: `scans` holds its signals and `scan_periods` its period by sensor_id.
    """

    def __init__(self, perception: bool = False) -> None:
        self.obc = ffi.new("obc *")
        lib.obc_init(self.obc)
        self.outbox = Outbox()
        self.now_us = 0
        self.received: dict[str, tuple[float, ...]] = {}
        self.sent: bytes = b""
        self.log: list[Frame] = []
        self.counters: dict[str, int] = {}
        self.extra: list[bytes] = []
        self.operation = OPERATIONS / "perception.yaml" if perception else OPERATION
        nodes = range(lib.NODE_COUNT if perception else lib.NODE_PERCEPTION)
        self.progress: dict[int, int] = dict.fromkeys(nodes, 0)
        self.node_periods = dict.fromkeys(nodes, TICK_US)
        self.node_codes = dict.fromkeys(nodes, 0)
        self.node_reliability = dict.fromkeys(nodes, 100.0)
        sizes = {3: 60_000, 4: 64} if perception else {}
        self.scans: dict[int, dict[str, float]] = {sensor: {"sensor_data_size": size} for sensor, size in sizes.items()}
        self.scan_periods = dict.fromkeys(sizes, 50_000)
        self.sequences = dict.fromkeys(sizes, 0)
        self.frozen_scans: set[int] = set()
        self.frozen_nodes: set[int] = set()
        self.frozen_sensors: set[str] = set()
        self.travelled_m = 0.0
        self.silent_nodes: set[int] = set()
        self.plan_speed = 0.0
        self.plan_counter = 0
        self.planning = True
        self.filters: list[Callable[[bytes], bytes]] = []
        self.signals: dict[str, dict[str, float]] = {
            "gnss_a_position": {}, "gnss_a_velocity": {}, "gnss_a_attitude": {}, "gnss_a_quality": {},
            "gnss_b_position": {}, "gnss_b_velocity": {}, "gnss_b_attitude": {}, "gnss_b_quality": {},
            "imu_rates": {}, "imu_specific_force": {"imu_specific_force_z": 9.806},
            "estimate_position": {}, "estimate_motion": {}, "estimate_quality": {"estimate_quality_level": 3},
            "wall_line": {"wall_offset": -8.0, "wall_order": 1}, "wall_bend": {"wall_begin": -20.0, "wall_end": 60.0},
            "wheel_speed_report": {}, "brake_pressure_report": {}, "steering_report": {}, "accelerator_report": {},
            "misc_report": {"sys_state": 1, "battery_voltage": 13.2}, "pt_report_1": {"gear_shift_status": 1},
            "diagnostic_report": {}, "base_to_car_summary": {"track_flag": 1, "round_target_speed": 31},
            "marelli_report_1": {}, "launch_request": {"launch_wanted": 1},
        }  # fmt: skip
        self.periods = {name: database.message(name).cycle_us for name in self.signals}

    # --- what others send ---

    def message(self, name: str, **signals: float) -> bytes:
        """One frame; every counter in it moves."""
        codec = database.message(name)
        values = dict.fromkeys(codec.signals, 0.0) | signals
        for signal in codec.signals:
            if signal.endswith(("_counter", "_heartbeat")) and signal not in signals:
                self.counters[name] = self.counters.get(name, 0) + 1
                top = int(codec.limits(signal)[1])
                values[signal] = self.counters[name] % (top + 1)
        return codec.frame(*(values[signal] for signal in codec.signals))

    def configure(self, operation: dict[str, object] | None = None) -> None:
        """Queue an operation file's frames for the next tick."""
        values = dict(load_operation(self.operation)) if operation is None else operation
        self.extra.extend(encode_operation(values.items(), own_parameters()))

    def plan(self) -> list[bytes]:
        """A straight path of 20 points, 5 m apart, ahead of the origin along x."""
        self.plan_counter = (self.plan_counter + 1) % 16
        frames = [self.message("trajectory_header", plan_counter=self.plan_counter, plan_point_count=20)]
        for index in range(20):
            address = {"plan_counter": self.plan_counter, "index": index}
            pose = {f"pose_{k}": v for k, v in address.items()} | {"pose_x": 5.0 * index}
            motion = {f"motion_{k}": v for k, v in address.items()} | {"motion_speed": self.plan_speed}
            frames.append(self.message("trajectory_pose", **pose))
            frames.append(self.message("trajectory_motion", **motion))
        return frames

    def world(self, name: str) -> dict[str, float]:
        """What the sensors and the car say of themselves: noise in the last bit, the way travelled, obedience."""
        values: dict[str, float] = {}
        if name in NOISY and not name.startswith(tuple(self.frozen_sensors)):
            noisy, last_bit = NOISY[name]
            values[noisy] = last_bit * (self.now_us // self.periods[name] % 2)
        if name in ("gnss_a_position", "gnss_b_position"):
            values[name.replace("position", "longitude")] = math.degrees(self.travelled_m / EARTH_RADIUS)
        if name in OBEDIENCE:
            signal, command, commanded = OBEDIENCE[name]
            values[signal] = self.value(command, commanded) if command in self.received else 0.0
        return values

    def due(self) -> Iterable[bytes]:
        """Yield frames of this tick."""
        for name, period in self.periods.items():
            if self.now_us % period == 0:
                yield self.message(name, **self.world(name) | self.signals[name])
        for node, code in self.node_codes.items():
            if node in self.silent_nodes:
                continue
            if node not in self.frozen_nodes and self.now_us % self.node_periods[node] == 0:
                self.progress[node] = (self.progress[node] + 1) & 0xFFFF
            word = "perception" if node >= lib.NODE_PERCEPTION else "node"
            report = {
                "id": node,
                "status_code": code,
                "reliability": self.node_reliability[node],
                "heartbeat": self.progress[node],
            }
            yield self.message(f"{word}_status", **{f"{word}_{key}": value for key, value in report.items()})
        for sensor, scan in self.scans.items():
            if self.now_us % self.scan_periods[sensor] == 0:
                if sensor not in self.frozen_scans:
                    self.sequences[sensor] = (self.sequences[sensor] + 1) & 0xFFFF
                yield self.message(
                    "sensor_notice", **{"sensor_id": sensor, "sensor_sequence": self.sequences[sensor]} | scan
                )
        if self.planning and self.now_us % 50_000 == 0:
            yield from self.plan()

    # --- time ---

    def tick(self, frames: bytes | None = None) -> bytes:
        """One tick; the frames that the onboard computer sent."""
        if frames is None:
            frames = b"".join([*self.extra, *self.due()])
            self.extra.clear()
        for change in self.filters:
            frames = change(frames)
        array, count = cast_frames(frames)
        lib.obc_tick(self.obc, self.now_us, array, count, self.outbox.c)
        self.sent = self.outbox.take()
        for frame in iterate(self.sent):
            codec = database.find(frame.bus, frame.id)
            assert codec is not None
            self.received[codec.name] = codec.decode(frame.data)
            self.log.append(frame)
        self.now_us += TICK_US
        speed = self.signals["gnss_a_velocity"].get("gnss_a_velocity_east", 0.0)
        self.travelled_m += speed * TICK_US * 1e-6
        return self.sent

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            self.tick()

    # --- what the onboard computer says ---

    def value(self, message: str, signal: str) -> float:
        """Newest value of a signal that the onboard computer sent."""
        return self.received[message][database.message(message).signals.index(signal)]

    @property
    def state(self) -> int:
        return int(self.value("ssm_status", "ssm_state"))

    @property
    def brake_kpa(self) -> float:
        return self.value("brake_pressure_cmd", "brake_pressure_cmd")

    @property
    def throttle(self) -> float:
        return self.value("accelerator_cmd", "acc_pedal_cmd")

    @property
    def ct_state(self) -> int:
        return int(self.value("vehicle_status", "obc_ct_state"))

    def launch(self) -> None:
        """Configure and run until NOMINAL; sensors need their full second."""
        self.configure()
        self.run(130)
        assert self.state == lib.SSM_NOMINAL, (self.state, self.blocking())

    def drive(self, vehicle_flag: int = 0) -> None:
        """Walk the whole run-up to NOM_RACE (ct 9)."""
        self.launch()
        for sys_state, track_flag, ct_state in (
            (4, 1, 3), (5, 1, 4), (6, 2, 5), (8, 2, 6), (8, 3, 7), (9, 3, 8), (9, 4, 9),
        ):  # fmt: skip
            self.signals["misc_report"]["sys_state"] = sys_state
            self.signals["base_to_car_summary"] |= {"track_flag": track_flag, "veh_flag": vehicle_flag}
            if sys_state >= 8:
                self.signals["pt_report_1"] |= {"engine_state": 1, "engine_speed_rpm": 2500}
            self.run(12)
            assert self.ct_state == ct_state, (self.ct_state, ct_state)

    def set_speed(self, speed: float) -> None:
        """Put the same speed (m/s), along the path, in wheels, GNSS and estimate."""
        kmh = speed * 3.6
        self.signals["wheel_speed_report"] = {f"wheel_speed_{wheel}": kmh for wheel in ("FL", "FR", "RL", "RR")}
        self.signals["estimate_motion"]["estimate_vx"] = speed
        for receiver in ("gnss_a", "gnss_b"):
            self.signals[f"{receiver}_velocity"][f"{receiver}_velocity_east"] = speed

    def active_faults(self) -> set[int]:
        return {index for index in range(lib.FAULT_COUNT) if self.obc.ssm.faults.faults[index].active}

    def blocking(self) -> list[int]:
        """Faults whose condition is present and keeps the launch back."""
        present = self.obc.conditions.present
        return [i for i in range(lib.FAULT_COUNT) if present[i] and lib.fault_table[i].blocks_launch]


def drop(*names: str) -> Callable[[bytes], bytes]:
    """Filter that loses all frames of these messages."""
    addresses = {(database.message(name).bus, database.message(name).frame_id) for name in names}

    def apply(frames: bytes) -> bytes:
        kept = (frames[i : i + FRAME_SIZE] for i in range(0, len(frames), FRAME_SIZE))
        return b"".join(f for f in kept if (FRAME_STRUCT.unpack(f)[2], FRAME_STRUCT.unpack(f)[1]) not in addresses)

    return apply
