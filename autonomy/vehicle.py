"""What the car can do: the part of the vehicle parameters that limits speed and acceleration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from autonomy.frenet import FloatArray
from dbc.errors import ConfigurationError

#: m, of the AV-21, as in its vehicle file (TUM-RL); sensors are mounted from the rear axle on.
CG_TO_REAR_AXLE = 1.247

_ENGINE_TORQUE = "engine_torque_"
_GEARS = 6


def load_vehicle(path: str | Path) -> dict[str, float]:
    """Flat mapping of vehicle parameters (SI) from YAML.

    Raises
    ------
    ConfigurationError : missing, not a flat mapping, or a value is not a finite number.
    """
    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(path, "", f"cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        raise ConfigurationError(path, f"line {mark.line + 1}" if mark else "", "is not YAML") from None
    if not isinstance(content, dict):
        raise ConfigurationError(path, "", "must be a mapping of parameters to numbers")
    values: dict[str, float] = {}
    for key, value in content.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ConfigurationError(path, str(key), f"is {value!r}; must be a finite number")
        values[str(key)] = float(value)
    return values


@dataclass(frozen=True)
class VehicleLimits:
    """Point-mass limits of the car on a banked road.

    Attributes
    ----------
    mass : kg. gravity : m/s2.
    friction_x, friction_y, nominal_load, friction_slope_x, friction_slope_y : peak friction of the tyres along and
        across at the nominal wheel load (N), and its change per relative load.
    drag, downforce : N per (m/s)^2.
    rolling_resistance : of the load.
    drive_share : share of the weight on the driven axle.
    brake_force : N, largest at the wheels.
    drive_speeds, drive_forces : largest tractive force of engine and gearbox, N over m/s, best gear at each speed.
    """

    mass: float
    gravity: float
    friction_x: float
    friction_y: float
    nominal_load: float
    friction_slope_x: float
    friction_slope_y: float
    drag: float
    downforce: float
    rolling_resistance: float
    drive_share: float
    brake_force: float
    drive_speeds: FloatArray
    drive_forces: FloatArray
    _force_table: list[float] = field(init=False, repr=False, compare=False)

    _TABLE_STEP = 0.25  # m/s

    def __post_init__(self) -> None:
        grid = np.arange(0.0, float(self.drive_speeds[-1]) + self._TABLE_STEP, self._TABLE_STEP)
        # Beyond the rev limit of the last gear there is no drive.
        table = np.interp(grid, self.drive_speeds, self.drive_forces, right=0.0)
        object.__setattr__(self, "_force_table", [*table.tolist(), 0.0])

    @classmethod
    def from_parameters(cls, file: str | Path, parameters: Mapping[str, float]) -> VehicleLimits:
        """Limits from the vehicle parameters that the plant uses too.

        Raises
        ------
        ConfigurationError : a parameter is missing or not positive.
        """

        def value(key: str) -> float:
            if key not in parameters:
                raise ConfigurationError(file, key, "is missing")
            return parameters[key]

        def positive(key: str) -> float:
            if not value(key) > 0.0:
                raise ConfigurationError(file, key, f"is {value(key):g}; must be above 0")
            return value(key)

        half_density = 0.5 * positive("air_density")
        front, rear = positive("cg_to_front_axle"), positive("cg_to_rear_axle")
        speeds, forces = _drive_curve(file, parameters, positive)
        return cls(
            mass=positive("mass"),
            gravity=positive("gravity"),
            friction_x=positive("tyre_pdx1") * positive("tyre_mu_scale_x"),
            friction_y=positive("tyre_pdy1") * positive("tyre_mu_scale_y"),
            nominal_load=positive("tyre_nominal_load"),
            friction_slope_x=value("tyre_pdx2") * positive("tyre_mu_scale_x"),
            friction_slope_y=value("tyre_pdy2") * positive("tyre_mu_scale_y"),
            drag=half_density * positive("drag_area"),
            downforce=half_density * (value("downforce_area_front") + value("downforce_area_rear")),
            rolling_resistance=value("rolling_resistance"),
            drive_share=front / (front + rear),
            brake_force=_brake_force(positive),
            drive_speeds=speeds,
            drive_forces=forces,
        )

    def friction(self, load: float) -> tuple[float, float]:
        """Peak friction along and across at the car's total normal load (N), shared evenly by four wheels."""
        relative = 0.25 * load / self.nominal_load - 1.0
        return (
            max(0.05, self.friction_x + self.friction_slope_x * relative),
            max(0.05, self.friction_y + self.friction_slope_y * relative),
        )

    def loads(self, speed: float, curvature: float, bank: float) -> tuple[float, float]:
        """Return normal load and lateral tyre force (positive left) in a turn on a banked road, N."""
        centripetal = speed * speed * curvature
        cos, sin = math.cos(bank), math.sin(bank)
        normal = self.mass * (self.gravity * cos + centripetal * sin) + self.downforce * speed * speed
        return max(0.0, normal), self.mass * (centripetal * cos - self.gravity * sin)

    def corner_speed(self, curvature: float, bank: float, margin: float, highest: float) -> float:
        """Largest speed, at most `highest`, at which the lateral force stays within `margin` of the friction."""

        def holds(speed: float) -> bool:
            normal, lateral = self.loads(speed, curvature, bank)
            return abs(lateral) <= margin * self.friction(normal)[1] * normal

        if holds(highest):
            return highest
        # From the speed at which gravity alone carries the car through the turn, upwards.
        hands_off = self.gravity * math.tan(bank) / curvature if curvature * bank > 0.0 else 0.0
        low, high = min(math.sqrt(hands_off), highest), highest
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if holds(middle) else (low, middle)
        return low

    def drive_force(self, speed: float) -> float:
        """Largest tractive force of engine and gearbox at a speed (m/s), N."""
        position = speed / self._TABLE_STEP
        i = min(int(position), len(self._force_table) - 2)
        return self._force_table[i] + min(1.0, position - i) * (self._force_table[i + 1] - self._force_table[i])

    def resistance(self, speed: float, normal: float) -> float:
        """Drag and rolling resistance, N."""
        return self.drag * speed * speed + self.rolling_resistance * normal

    def acceleration_range(
        self, speed: float, curvature: float, bank: float, grade: float, margin: float
    ) -> tuple[float, float]:
        """Strongest braking (negative) and strongest acceleration possible in a turn, m/s2."""
        normal, lateral = self.loads(speed, curvature, bank)
        friction_x, friction_y = self.friction(normal)
        used = lateral / max(1.0, margin * friction_y * normal)
        grip = margin * friction_x * normal * math.sqrt(max(0.0, 1.0 - used * used))
        against = self.resistance(speed, normal) + self.mass * self.gravity * math.sin(grade)
        brake = min(grip, self.brake_force)
        drive = min(self.drive_share * grip, self.drive_force(speed))
        return (-brake - against) / self.mass, (drive - against) / self.mass


def _drive_curve(
    file: str | Path, parameters: Mapping[str, float], positive: Callable[[str], float]
) -> tuple[FloatArray, FloatArray]:
    """Tractive force over speed with the best gear everywhere."""
    points = sorted(
        (float(key.removeprefix(_ENGINE_TORQUE)), torque)
        for key, torque in parameters.items()
        if key.startswith(_ENGINE_TORQUE) and key.removeprefix(_ENGINE_TORQUE).isdigit()
    )
    if len(points) < 2:
        raise ConfigurationError(file, _ENGINE_TORQUE + "<rpm>", "needs the full-load torque at two or more speeds")
    engine_speeds = np.array([rpm for rpm, _ in points]) * math.pi / 30.0
    torques = np.array([torque for _, torque in points]) * positive("engine_torque_scale")
    limit = min(positive("engine_speed_limit"), float(engine_speeds[-1]))
    radius = positive("tyre_radius_rear")
    final = positive("final_drive_ratio")
    efficiency = positive("driveline_efficiency")
    ratios = [positive(f"gear_ratio_{gear}") * final for gear in range(1, _GEARS + 1)]
    speeds = np.linspace(0.0, limit * radius / min(ratios), 400)
    best = np.zeros_like(speeds)
    # Below it the clutch slips and holds the engine there.
    launch = positive("clutch_closed_speed")
    for ratio in ratios:
        engine = speeds / radius * ratio
        torque = np.interp(np.maximum(engine, launch), engine_speeds, torques)
        best = np.maximum(best, np.where(engine <= limit, torque * ratio * efficiency / radius, 0.0))
    return speeds, best


def _brake_force(positive: Callable[[str], float]) -> float:
    share = positive("brake_front_share")
    # The stronger axle gets the line pressure, the other one its share of it.
    strong, weak = max(share, 1.0 - share), min(share, 1.0 - share)
    radius = 0.5 * (positive("tyre_radius_front") + positive("tyre_radius_rear"))
    return float(2.0 * positive("brake_torque_gain") * positive("brake_pressure_max") * (1.0 + weak / strong) / radius)
