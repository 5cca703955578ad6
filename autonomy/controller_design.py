"""Offline design of the controllers: from the vehicle's parameters to the const tables of the firmware.

``python -m autonomy.controller_design`` writes ``firmware/obc/controller_tables.c`` from a vehicle file. The lateral
model is the error dynamics of the bicycle (R. Rajamani, Vehicle Dynamics and Control, 2nd ed., section 2.5), with the
steering actuator and the integral of the lateral error behind it. Its dead time is not in the model: the firmware
predicts the car over it (firmware/obc/motion_predictor.h).
"""

from __future__ import annotations

import argparse
import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from autonomy.vehicle import load_vehicle
from dbc.errors import ConfigurationError

Matrix = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
VEHICLE_FILE = ROOT / "scenarios" / "vehicles" / "av21.yaml"
TABLE_FILE = ROOT / "firmware" / "obc" / "controller_tables.c"

PERIOD = 0.01  # s, of control
DEAD_TICKS = 5  # CONTROLLER_DEAD_TICKS: the actuator's dead time and one period on the buses
SPEEDS = 31
SPEED_STEP = 2.5  # m/s
PREVIEW_STEPS = 16
PREVIEW_TICKS = 3  # control periods per preview step
LOWEST_SPEED = 2.5  # m/s, below it the gains stay
ENGINE_SPEEDS = 32
ENGINE_SPEED_STEP = 250.0 * math.pi / 30.0  # rad/s
THROTTLES = 11
GEARS = 6
CORNERING_SHARE = 0.85  # of the longitudinal slip stiffness that side slip and drive leave in a fast turn
STEER_STEP = math.radians(0.5)  # at the motor: steering_cmd's step on CAN1


@dataclass(frozen=True)
class Weights:
    """What a lateral error is worth in steering effort.

    Attributes
    ----------
    error : m, lateral error that is worth the whole effort.
    error_rate : m/s, lateral error rate that is worth it.
    integral : m2, integral of the error over distance that is worth it.
    effort : m/s2, lateral acceleration of a steering angle that counts as the whole effort at speed.
    steer_max : rad, largest angle that counts as the whole effort, at low speed.
    """

    error: float = 0.5
    error_rate: float = 1.5
    integral: float = 25.0
    effort: float = 6.0
    steer_max: float = 0.03


class _Car:
    """Vehicle parameters by name; a missing one is the user's mistake."""

    def __init__(self, file: Path, values: Mapping[str, float]) -> None:
        self._file = file
        self._values = values

    def __getitem__(self, key: str) -> float:
        if key not in self._values:
            raise ConfigurationError(self._file, key, "is missing")
        return self._values[key]

    @property
    def wheelbase(self) -> float:
        return self["cg_to_front_axle"] + self["cg_to_rear_axle"]

    def axle_stiffness(self, axle: str, load: float) -> float:
        """Cornering stiffness (N/rad) of the "front" or "rear" axle that carries `load` (N)."""
        q = load / (2.0 * self["tyre_pky2"] * self["tyre_nominal_load"])
        return self.stiffness_peak(axle) * 2.0 * q / (1.0 + q * q)

    def stiffness_peak(self, axle: str) -> float:
        return 2.0 * self["tyre_nominal_load"] * self["tyre_pky1"] * self[f"tyre_stiffness_scale_{axle}"]

    def axle_loads(self, speed: float, normal_acceleration: float) -> tuple[float, float]:
        weight = self["mass"] * normal_acceleration
        pressure = 0.5 * self["air_density"] * speed * speed
        return (
            weight * self["cg_to_rear_axle"] / self.wheelbase + pressure * self["downforce_area_front"],
            weight * self["cg_to_front_axle"] / self.wheelbase + pressure * self["downforce_area_rear"],
        )


def _discretise(a: Matrix, b: Matrix, period: float) -> tuple[Matrix, Matrix]:
    """Zero-order hold: ``x' = A x + B u`` over one period."""
    n, m = b.shape
    block = expm(np.block([[a, b], [np.zeros((m, n + m))]]) * period)
    return block[:n, :n], block[:n, n:]


def actuator_model(parameters: Mapping[str, float]) -> tuple[Matrix, Matrix]:
    """Steering actuator without its dead time, continuous; states angle and rate, shapes (2, 2) and (2, 1)."""
    car = _Car(VEHICLE_FILE, parameters)
    omega = 2.0 * math.pi * car["steer_bandwidth"]
    a = np.array([[0.0, 1.0], [-omega * omega, -2.0 * car["steer_damping"] * omega]])
    return a, np.array([[0.0], [omega * omega]])


def error_model(
    parameters: Mapping[str, float], speed: float, normal_acceleration: float | None = None
) -> tuple[Matrix, Matrix]:
    """Continuous lateral error model; states e_y, de_y/dt, e_psi, de_psi/dt, input steering angle.

    Parameters
    ----------
    parameters : vehicle parameters, SI.
    speed : m/s, above 0.
    normal_acceleration : m/s2 that presses the car on the road; gravity when not given. More in a banked turn.

    Returns
    -------
    A (4, 4), B (4, 1) : Rajamani, equation 2.45.
    """
    car = _Car(VEHICLE_FILE, parameters)
    loads = car.axle_loads(speed, car["gravity"] if normal_acceleration is None else normal_acceleration)
    cf = car.axle_stiffness("front", loads[0])
    cr = car.axle_stiffness("rear", loads[1])
    mass, inertia = car["mass"], car["yaw_inertia"]
    lf, lr = car["cg_to_front_axle"], car["cg_to_rear_axle"]
    moment = cf * lf - cr * lr
    damping = cf * lf * lf + cr * lr * lr
    a = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [0.0, -(cf + cr) / (mass * speed), (cf + cr) / mass, -moment / (mass * speed)],
            [0.0, 0.0, 0.0, 1.0],
            [0.0, -moment / (inertia * speed), moment / inertia, -damping / (inertia * speed)],
        ]
    )
    return a, np.array([[0.0], [cf / mass], [0.0], [cf * lf / inertia]])


def plant_model(
    parameters: Mapping[str, float], speed: float, normal_acceleration: float | None = None
) -> tuple[Matrix, Matrix]:
    """One control period of car, actuator and integral of e_y: A (7, 7), B (7, 1), states as in the gain table."""
    a_car, b_car = error_model(parameters, speed, normal_acceleration)
    a_steer, b_steer = actuator_model(parameters)
    a = np.zeros((7, 7))
    b = np.zeros((7, 1))
    a[:4, :4] = a_car
    a[:4, 4:5] = b_car
    a[4:6, 4:6] = a_steer
    a[6, 0] = 1.0
    b[4:6] = b_steer
    return _discretise(a, b, PERIOD)


def lateral_gains(
    parameters: Mapping[str, float], speed: float, weights: Weights | None = None
) -> tuple[Matrix, Matrix]:
    """LQR at a speed (m/s, above 0): gains (7,) of the states and gains (PREVIEW_STEPS, 3) of the path ahead.

    When the path's curvature or bank changes, so does the steady state that the errors are taken from; to the error
    model that is a disturbance, known in advance. The optimal answer to a disturbance d at i periods from now is
    ``-(R + B'PB)^-1 B' (A - BK)'^i P d``. It is kept for the steady state's sideslip, yaw rate and steering angle,
    averaged over the periods of each preview step.
    """
    w = weights or Weights()
    car = _Car(VEHICLE_FILE, parameters)
    a, b = plant_model(parameters, speed)
    effort = min(w.effort * car.wheelbase / (speed * speed), w.steer_max)
    q = np.zeros((7, 7))
    q[0, 0] = w.error**-2
    q[1, 1] = w.error_rate**-2
    q[6, 6] = (speed / w.integral) ** 2
    r = np.array([[effort**-2]])
    p = solve_discrete_are(a, b, q, r)
    factor = np.linalg.solve(r + b.T @ p @ b, b.T)
    gain = factor @ p @ a
    closed = (a - b @ gain).T
    answer = np.empty((PREVIEW_STEPS * PREVIEW_TICKS, 7))
    state = p
    for row in answer:
        row[:] = (factor @ state)[0]
        state = closed @ state
    answer = answer.reshape(PREVIEW_STEPS, PREVIEW_TICKS, 7).mean(axis=1)
    # Errors are state minus steady state (e_psi + sideslip), so a change of the reference enters with its sign.
    preview = np.stack([-answer[:, 2], answer[:, 3], answer[:, 4]], axis=1)
    return gain[0], preview


def gain_table(parameters: Mapping[str, float], weights: Weights | None = None) -> tuple[Matrix, Matrix]:
    """Gains (SPEEDS, 7) and preview gains (SPEEDS, PREVIEW_STEPS, 3) at multiples of SPEED_STEP."""
    speeds = np.maximum(np.arange(SPEEDS) * SPEED_STEP, LOWEST_SPEED)
    rows = [lateral_gains(parameters, float(v), weights) for v in speeds]
    return np.array([gain for gain, _ in rows]), np.array([preview for _, preview in rows])


def engine_map(parameters: Mapping[str, float]) -> Matrix:
    """Engine torque (ENGINE_SPEEDS, THROTTLES), N m: full load times the throttle's share, less drag."""
    car = _Car(VEHICLE_FILE, parameters)
    speeds = np.arange(ENGINE_SPEEDS) * ENGINE_SPEED_STEP
    throttles = np.linspace(0.0, 1.0, THROTTLES)
    rpm = np.arange(500.0, 7501.0, 500.0)
    full = car["engine_torque_scale"] * np.interp(
        speeds * 30.0 / math.pi, rpm, [car[f"engine_torque_{n:.0f}"] for n in rpm]
    )
    on_boost = np.array([0.0, *(car[f"throttle_fraction_{k}0"] for k in range(1, 10)), 1.0])
    off_boost = 1.0 - (1.0 - throttles) ** car["throttle_low_speed_exponent"]
    low, high = car["throttle_boost_speed_low"], car["throttle_boost_speed_high"]
    boost = np.clip((speeds - low) / max(high - low, 1.0), 0.0, 1.0)[:, None]
    share = off_boost + boost * (on_boost - off_boost)
    drag = (car["engine_brake_torque"] + car["engine_brake_slope"] * speeds) * np.clip(speeds / 10.0, 0.0, 1.0)
    pumping = np.clip(1.0 - throttles / car["engine_brake_throttle_span"], 0.0, 1.0)
    torque: Matrix = full[:, None] * share - drag[:, None] * pumping
    return torque


def tables(parameters: Mapping[str, float], file: Path = VEHICLE_FILE) -> dict[str, float | Matrix]:
    """Every field of the firmware's ``controller_tables``, by name, in its order.

    Raises
    ------
    ConfigurationError : a parameter is missing.
    """
    car = _Car(file, parameters)
    half_density = 0.5 * car["air_density"]
    gains, preview = gain_table(parameters)
    transition, steer_input = _discretise(*actuator_model(parameters), PERIOD)
    ratios = np.array([0.0] + [car[f"gear_ratio_{g}"] * car["final_drive_ratio"] for g in range(1, GEARS + 1)])
    front, rear = car["tyre_radius_front"], car["tyre_radius_rear"]
    wheels = 2.0 * car["wheel_inertia_front"] / front**2 + 2.0 * car["wheel_inertia_rear"] / rear**2
    share = car["brake_front_share"]
    # The stronger axle gets the line pressure, the other one its share of it.
    front_line = min(1.0, share / (1.0 - share))
    rear_line = min(1.0, (1.0 - share) / share)
    brake_gain = 2.0 * car["brake_torque_gain"] * (front_line / front + rear_line / rear) / front_line
    return {
        "mass": car["mass"],
        "yaw_inertia": car["yaw_inertia"],
        "cg_to_front": car["cg_to_front_axle"],
        "cg_to_rear": car["cg_to_rear_axle"],
        "gravity": car["gravity"],
        "drag_factor": half_density * car["drag_area"],
        "downforce_front": half_density * car["downforce_area_front"],
        "downforce_rear": half_density * car["downforce_area_rear"],
        "rolling_resistance": car["rolling_resistance"],
        "stiffness_peak_front": car.stiffness_peak("front"),
        "stiffness_peak_rear": car.stiffness_peak("rear"),
        "stiffness_peak_load": 2.0 * car["tyre_pky2"] * car["tyre_nominal_load"],
        "slip_stiffness": CORNERING_SHARE * car["tyre_pkx1"],
        "track_rear": car["track_width_rear"],
        "load_transfer_rear": car["cg_height"] * (1.0 - car["roll_stiffness_front_share"]) / car["track_width_rear"],
        "differential_preload": car["differential_preload"],
        "differential_ratio": car["differential_lock_ratio"],
        "steer_transition": transition,
        "steer_input": steer_input[:, 0],
        "steer_max": car["steer_motor_limit"] / car["steer_ratio"],
        "steer_rate_max": car["steer_motor_rate_limit"] / car["steer_ratio"],
        "steer_step": STEER_STEP / car["steer_ratio"],
        "steer_lag": 2.0 * car["steer_damping"] / (2.0 * math.pi * car["steer_bandwidth"]),
        "lqr_speed_step": SPEED_STEP,
        "lqr_gain": gains,
        "lqr_preview": preview,
        "gear_ratio": ratios,
        "effective_mass": car["mass"] + wheels + car["engine_inertia"] * (ratios / rear) ** 2,
        "driveline_efficiency": car["driveline_efficiency"],
        "clutch_engage_speed": car["clutch_engage_speed"],
        "driven_radius": rear,
        "engine_speed_step": ENGINE_SPEED_STEP,
        "engine_torque": engine_map(parameters),
        "brake_gain": brake_gain,
    }


def _literal(value: float) -> str:
    text = f"{value:.6g}"
    if "." not in text and "e" not in text:
        text += ".0"
    return text + "f"


def _initialiser(value: float | Matrix, indent: str) -> str:
    if isinstance(value, float):
        return _literal(value)
    if value.ndim == 1:
        return "{" + ", ".join(_literal(float(v)) for v in value) + "}"
    rows = "".join(f"{indent}    {_initialiser(row, indent + '    ')},\n" for row in value)
    return "{\n" + rows + indent + "}"


def render(values: Mapping[str, float | Matrix], file_name: str, digest: str) -> str:
    """C source of the tables. file_name, digest: the vehicle file and its SHA-256, for the head line."""
    fields = "".join(f"    .{name} = {_initialiser(value, '    ')},\n" for name, value in values.items())
    return (
        f"/* Written by autonomy/controller_design.py from {file_name}. Do not edit.\n"
        f" * Vehicle file SHA-256: {digest} */\n"
        '#include "obc/controller_tables.h"\n\n'
        "/* clang-format off */\n"
        f"const controller_tables controller_table = {{\n{fields}}};\n"
    )


def source(vehicle_file: Path = VEHICLE_FILE) -> str:
    """C source for a vehicle file.

    Raises
    ------
    ConfigurationError : the file is missing, broken or lacks a parameter.
    """
    values = tables(load_vehicle(vehicle_file), vehicle_file)
    digest = hashlib.sha256(vehicle_file.read_bytes()).hexdigest()
    return render(values, vehicle_file.name, digest)


def main() -> None:
    """Write the tables of a vehicle file into the firmware."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--vehicle", type=Path, default=VEHICLE_FILE)
    parser.add_argument("--out", type=Path, default=TABLE_FILE)
    arguments = parser.parse_args()
    arguments.out.write_text(source(arguments.vehicle), encoding="utf-8")


if __name__ == "__main__":
    main()
