"""A car that goes straight along a bank crabs. How much is a matter of statics, computed here without the plant."""

from __future__ import annotations

import math

import pytest
from scipy.optimize import brentq

from plant_fmu.driver import Plant, Value

START: dict[str, Value] = {"oval_asymmetry": 0.0, "differential_preload": 0.0, "differential_lock_ratio": 0.0}


def side_force(car: Plant, load: float, fx: float, slip: float) -> float:
    """Magic Formula side force to the left at a lateral slip, with the longitudinal force `fx` on top.

    Pacejka's similarity method: both slips, each times its stiffness over its peak and shape factor, form one
    vector; its length gives the share of the peak in its direction.
    """

    def value(name: str) -> float:
        return float(car[f"tyre_{name}"])

    nominal = value("nominal_load")
    change = load / nominal - 1.0
    peak_x = (value("pdx1") + value("pdx2") * change) * value("mu_scale_x") * load
    peak_y = (value("pdy1") + value("pdy2") * change) * value("mu_scale_y") * load
    stiffness = nominal * value("pky1") * math.sin(2.0 * math.atan(load / (value("pky2") * nominal)))
    sy = stiffness * slip / (value("pcy1") * peak_y)

    def force(sx: float, axis: str, peak: float, part: float) -> float:
        length = math.hypot(sx, sy)
        c, e = value(f"pc{axis}1"), value(f"pe{axis}1")
        curve = math.sin(c * math.atan(length - e * (length - math.atan(length))))
        return peak * curve * part / length

    sx = brentq(lambda s: force(s, "x", peak_x, s) - fx, -0.8, 0.8)
    return force(sx, "y", peak_y, sy)


def static_side_slip(car: Plant, bank: float, speed: float, rate: float) -> float:
    """Side-slip angle of the car that goes straight along the bank while it slows at `rate` (m/s2, >= 0).

    The axles share the side force of the slope by the lever rule, as the car does not turn. The rear wheels point
    along the car, so the slip at which they give their share is the side slip.
    """
    mass, gravity, height = float(car["mass"]), float(car["gravity"]), float(car["cg_height"])
    lf, lr = float(car["cg_to_front_axle"]), float(car["cg_to_rear_axle"])
    radius, inertia = float(car["tyre_radius_rear"]), float(car["wheel_inertia_rear"])
    pressure = 0.5 * 1.2 * speed**2
    axle = mass * gravity * math.cos(bank) * lf / (lf + lr) - mass * rate * height / (lf + lr)
    axle += pressure * float(car["downforce_area_rear"])
    drag = pressure * float(car["drag_area"])
    axle += drag * height / (lf + lr)  # drag acts at the height of the CG and slows without unloading the rear
    roll_moment = mass * gravity * math.sin(bank) * height
    transfer = roll_moment * (1.0 - float(car["roll_stiffness_front_share"])) / float(car["track_width_rear"])
    brake = float(car["brake_torque_gain"]) * float(car["brake_pressure_rear"])
    loads = [0.5 * axle + transfer, 0.5 * axle - transfer]  # the low wheel carries more
    along = [-(brake - inertia * rate / radius) / radius - float(car["rolling_resistance"]) * load for load in loads]

    def missing(slip: float) -> float:
        # The slope pulls down to the left; braking along the path has a part across a car that points off it.
        wanted = -mass * (gravity * math.sin(bank) + rate * slip) * lf / (lf + lr)
        return sum(side_force(car, load, fx, -slip) for load, fx in zip(loads, along, strict=True)) - wanted

    return math.atan(brentq(missing, 1e-4, 0.1))


@pytest.mark.parametrize("pressure", [0.0, 0.7e6, 1.5e6])
@pytest.mark.parametrize("bank_deg", [9.0, 20.0])
def test_a_straight_run_on_a_bank_crabs_as_statics_say(bank_deg: float, pressure: float) -> None:
    bank = math.radians(bank_deg)
    with Plant({**START, "v0": 30.0, "road_bank": bank}) as car:
        steer, compared = 0.0, 0
        speeds = [16.0, 10.0, 5.0, 2.0] if pressure > 0.0 else [16.0]
        while speeds and car.time < 40.0:
            # Hold the heading's rate at zero by hand.
            steer -= 10.0 * float(car["yaw_rate"]) * car.step_s
            car.step(steer_motor_demand=steer, brake_pressure_demand=pressure)
            if float(car["vx"]) < speeds[0]:
                speed = speeds.pop(0)
                expected = static_side_slip(car, bank, speed, -float(car["ax"]))
                assert abs(float(car["yaw_rate"])) < 2e-3
                assert car["slip_angle"] == pytest.approx(expected, rel=0.01), f"at {speed} m/s"
                compared += 1
        assert not speeds, "too slow"
        assert compared > 0
