"""Speed profile against closed forms, an ODE and the physics at every point."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp

from autonomy.speed_profile import PathShape, ProfileLimits, closed_profile, corner_speeds, lap_time, open_profile
from autonomy.vehicle import VehicleLimits, load_vehicle
from dbc.errors import ConfigurationError

VEHICLE_FILE = Path(__file__).parents[2] / "scenarios" / "vehicles" / "av21.yaml"


@pytest.fixture(scope="module")
def parameters():
    return load_vehicle(VEHICLE_FILE)


@pytest.fixture(scope="module")
def car(parameters):
    return VehicleLimits.from_parameters(VEHICLE_FILE, parameters)


@pytest.fixture(scope="module")
def plain(car):
    """A car with constant friction, no air and no engine limit, for closed forms."""
    return replace(
        car,
        friction_x=1.2,
        friction_y=1.2,
        friction_slope_x=0.0,
        friction_slope_y=0.0,
        drag=0.0,
        downforce=0.0,
        rolling_resistance=0.0,
        brake_force=1e9,
        drive_share=1.0,
        drive_speeds=np.array([0.0, 200.0]),
        drive_forces=np.array([1e9, 1e9]),
    )


def shape(n, spacing=2.0, curvature=0.0, bank=0.0):
    return PathShape(spacing, np.full(n, curvature), np.full(n, bank))


def test_flat_circle(plain):
    speed = closed_profile(shape(100, curvature=1 / 50.0), plain, ProfileLimits(200.0))
    np.testing.assert_allclose(speed, math.sqrt(1.2 * 9.81 * 50.0), rtol=1e-6)


@pytest.mark.parametrize("degrees", [-5.0, 10.0, 20.0])
def test_banked_circle(plain, degrees):
    bank, radius = math.radians(degrees), 100.0
    # tan of bank plus friction angle is the largest centripetal over g.
    expected = math.sqrt(9.81 * radius * math.tan(bank + math.atan(1.2)))
    speed = closed_profile(shape(50, curvature=1 / radius, bank=bank), plain, ProfileLimits(200.0))
    np.testing.assert_allclose(speed, expected, rtol=1e-6)
    right = closed_profile(shape(50, curvature=-1 / radius, bank=-bank), plain, ProfileLimits(200.0))
    np.testing.assert_allclose(right, speed, rtol=1e-9)


def test_downforce_raises_the_corner_speed(plain):
    winged = replace(plain, downforce=2.0)
    # m v^2 / R = mu (m g + c v^2)
    expected = math.sqrt(1.2 * 790.0 * 9.81 / (790.0 / 60.0 - 1.2 * 2.0))
    assert winged.mass == 790.0
    speed = corner_speeds(shape(3, curvature=1 / 60.0), winged, ProfileLimits(200.0))
    np.testing.assert_allclose(speed, expected, rtol=1e-6)


def test_load_sensitivity_takes_friction_from_a_loaded_tyre(car):
    light, heavy = car.friction(4.0 * 2000.0), car.friction(4.0 * 5000.0)
    assert heavy[0] < light[0]
    assert heavy[1] < light[1]
    x, y = car.friction(4.0 * car.nominal_load)
    assert (x, y) == pytest.approx((1.7168 * 0.93, 1.654 * 0.84))


def test_braking_on_the_flat_is_the_closed_form(plain):
    speed = open_profile(shape(400, spacing=1.0), plain, ProfileLimits(60.0), 60.0, end_speed=0.0)
    ahead = np.arange(400)[::-1]
    expected = np.minimum(60.0, np.sqrt(2.0 * 1.2 * 9.81 * ahead))
    np.testing.assert_allclose(speed, expected, rtol=1e-9)


def test_a_start_that_is_too_fast_shows(plain):
    speed = open_profile(shape(10, spacing=1.0), plain, ProfileLimits(60.0), 60.0, end_speed=0.0)
    assert speed[0] == pytest.approx(math.sqrt(2.0 * 1.2 * 9.81 * 9.0))


def test_acceleration_of_the_car_matches_an_ode(car):
    spacing, count = 2.0, 400
    path = shape(count, spacing=spacing)
    speed = open_profile(path, car, ProfileLimits(90.0, friction_margin=0.9), 15.0)

    def change(_, v):
        return [car.acceleration_range(float(v[0]), 0.0, 0.0, 0.0, 0.9)[1] / float(v[0])]

    s = np.arange(count) * spacing
    reference = solve_ivp(change, (0.0, s[-1]), [15.0], t_eval=s, rtol=1e-9, max_step=1.0).y[0]
    np.testing.assert_allclose(speed, np.minimum(reference, 90.0), rtol=2e-3)


def test_limits_from_outside_hold(car):
    limits = ProfileLimits(50.0, max_acceleration=2.0, max_deceleration=3.0)
    speed = open_profile(shape(600, spacing=2.0), car, limits, 10.0, end_speed=0.0)
    acceleration = np.diff(speed**2) / 4.0
    assert speed.max() == pytest.approx(50.0)
    assert acceleration.max() == pytest.approx(2.0)
    assert acceleration.min() == pytest.approx(-3.0)


def test_drive_margin_is_a_share_of_the_engine(car):
    full = open_profile(shape(3, spacing=0.01), car, ProfileLimits(90.0), 50.0)
    part = open_profile(shape(3, spacing=0.01), car, ProfileLimits(90.0, drive_margin=0.5), 50.0)
    gain = np.diff(full**2), np.diff(part**2)
    np.testing.assert_allclose(gain[1], 0.5 * gain[0], rtol=1e-3)


def wavy(n=600):
    s = np.arange(n) * 2.0
    return PathShape(2.0, 0.012 * np.sin(2 * np.pi * s / 400.0) ** 3, 0.1 * np.cos(2 * np.pi * s / 300.0))


def test_every_point_stays_inside_the_friction_circle(car):
    path, margin = wavy(), 0.9
    speed = closed_profile(path, car, ProfileLimits(90.0, friction_margin=margin))
    after = np.roll(speed, -1)
    assert speed.max() - speed.min() > 10.0  # the path asks something of the car
    for v, w, k, b in zip(speed, after, path.curvature, path.bank, strict=True):
        middle = math.sqrt(0.5 * (v * v + w * w))
        normal, lateral = car.loads(middle, float(k), float(b))
        force = car.mass * (w * w - v * v) / (2.0 * path.spacing) + car.resistance(middle, normal)
        mu_x, mu_y = (margin * mu * normal for mu in car.friction(normal))
        assert math.hypot(force / mu_x, lateral / mu_y) < 1.05
        assert force < car.drive_force(middle) * 1.01


def test_a_closed_profile_does_not_depend_on_where_the_lap_starts(car):
    path = wavy()
    speed = closed_profile(path, car, ProfileLimits(90.0))
    for shift in (1, 133, 299, 450):
        rolled = PathShape(2.0, np.roll(path.curvature, shift), np.roll(path.bank, shift))
        np.testing.assert_allclose(closed_profile(rolled, car, ProfileLimits(90.0)), np.roll(speed, shift), atol=1e-9)


def test_no_faster_profile_exists_nearby(car):
    """Raising the speed of any point breaks a limit at it or towards a neighbour."""
    path, limits = wavy(), ProfileLimits(90.0)
    speed = closed_profile(path, car, limits)
    corner = corner_speeds(path, car, limits)
    for i in range(600):
        v, before, after = speed[i] + 0.3, speed[i - 1], speed[(i + 1) % 600]
        k, b = float(path.curvature[i]), float(path.bank[i])
        most = car.acceleration_range(float(before), float(path.curvature[i - 1]), float(path.bank[i - 1]), 0.0, 1.0)[1]
        least = car.acceleration_range(float(v), k, b, 0.0, 1.0)[0]
        too_fast = v > corner[i]
        too_much_drive = v * v - before * before > 2.0 * path.spacing * most * 0.97
        too_much_brake = after * after - v * v < 2.0 * path.spacing * least * 0.97
        assert too_fast or too_much_drive or too_much_brake


def test_lap_time_of_constant_speed():
    assert lap_time(2.0, np.full(1235, 63.06)) == pytest.approx(2470.0 / 63.06)


def test_the_drive_curve_has_the_cars_power_and_gears(car, parameters):
    speeds = np.linspace(20.0, 80.0, 61)
    power = np.array([car.drive_force(float(v)) * v for v in speeds])
    assert power.max() == pytest.approx(335e3 * parameters["driveline_efficiency"], rel=0.02)
    # First gear carries to the speed of its rev limit; above the top gear's there is no drive at all.
    top = (
        parameters["engine_speed_limit"]
        * parameters["tyre_radius_rear"]
        / (parameters["gear_ratio_6"] * parameters["final_drive_ratio"])
    )
    assert car.drive_force(top - 1.0) > 0.0
    assert car.drive_force(top + 1.0) == 0.0


@pytest.mark.parametrize("key", ["mass", "engine_torque_scale", "tyre_pdy1", "gear_ratio_4", "brake_torque_gain"])
@pytest.mark.parametrize("value", [None, 0.0, -3.0])
def test_a_wrong_vehicle_parameter_is_named(parameters, key, value):
    changed = {k: v for k, v in parameters.items() if k != key}
    if value is not None:
        changed[key] = value
    with pytest.raises(ConfigurationError) as error:
        VehicleLimits.from_parameters("car.yaml", changed)
    assert (error.value.file, error.value.key) == ("car.yaml", key)


def test_engine_torque_points_are_needed(parameters):
    changed = {k: v for k, v in parameters.items() if not k.startswith("engine_torque_") or k == "engine_torque_scale"}
    with pytest.raises(ConfigurationError, match="full-load torque"):
        VehicleLimits.from_parameters("car.yaml", changed)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("mass: heavy", "mass"),
        ("mass: true", "mass"),
        ("mass: .nan", "mass"),
        ("mass: [1]", "mass"),
        ("7", ""),
        ("a: [", "line 1"),
    ],
)
def test_a_wrong_vehicle_file_is_refused(tmp_path, text, key):
    file = tmp_path / "car.yaml"
    file.write_text(text)
    with pytest.raises(ConfigurationError) as error:
        load_vehicle(file)
    assert error.value.key == key
    assert "\n" not in str(error.value)


def test_a_missing_vehicle_file_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_vehicle(tmp_path / "none.yaml")


def test_the_file_and_the_reader_agree(parameters):
    assert parameters == {key: float(value) for key, value in yaml.safe_load(VEHICLE_FILE.read_text()).items()}
