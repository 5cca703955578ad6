"""Sensor models: their statistics are what they claim, their streams independent and reproducible."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bridge.sensors.gnss import ERRORS_A, ERRORS_B, Gnss, GnssErrors
from bridge.sensors.imu import Imu, ImuErrors, body_rates
from bridge.sensors.noise import BLOCK, DriftingNoise
from bridge.sensors.suite import SensorSuite
from bridge.sensors.truth import Truth, TruthReader
from bridge.sensors.wgs84 import TrackFrame
from dbc.codec import database
from dbc.frames import iterate
from plant_fmu.driver import Plant

SEED = 1729
QUIET = ImuErrors(0.0, 0.0, 0.0, 0.0)


class Origin:
    latitude_deg, longitude_deg, height = 36.27222469, -115.0102968, 605.0


TRUTH = Truth(
    x=-215.3, y=261.2, z=7.0, yaw=-2.5, vx=60.0, vy=-0.4, yaw_rate=0.25,
    roll=0.005, pitch=0.002, body_roll=0.005, body_pitch=0.002,
    specific_force_x=1.0, specific_force_y=14.0, specific_force_z=11.0, distance=0.0,
)  # fmt: skip


def generator() -> np.random.Generator:
    print(f"seed {SEED}")
    return np.random.default_rng(SEED)


def decode(frames: bytes) -> dict[str, tuple[float, ...]]:
    messages = {}
    for frame in iterate(frames):
        message = database.find(frame.bus, frame.id)
        assert message is not None
        messages[message.name] = message.decode(frame.data)
    return messages


def test_noise_has_the_variance_and_correlation_of_its_model():
    noise = DriftingNoise(generator(), white=[0.02, 1.0], drift=[0.05, 0.0], time_constant_s=2.0, period_s=0.05)
    samples = noise.block(400_000)
    assert samples.std(axis=0) == pytest.approx([math.hypot(0.02, 0.05), 1.0], rel=0.03)
    drift_channel = samples[:, 0] - samples[:, 0].mean()
    for lag in (1, 20, 40, 80):
        measured = float(np.mean(drift_channel[lag:] * drift_channel[:-lag]))
        assert measured == pytest.approx(0.05**2 * math.exp(-lag * 0.05 / 2.0), abs=2e-4), lag
    white = samples[:, 1]
    assert abs(np.mean(white[1:] * white[:-1])) < 0.01


def test_noise_starts_in_its_stationary_distribution_and_runs_on_over_blocks():
    starts = []
    for child in np.random.SeedSequence(SEED).spawn(4000):
        noise = DriftingNoise(
            np.random.default_rng(child), white=[0.0], drift=[1.0], time_constant_s=100.0, period_s=0.01
        )
        starts.append(noise.block(1)[0, 0])
    assert np.std(starts) == pytest.approx(1.0, rel=0.05)
    noise = DriftingNoise(generator(), white=[0.0], drift=[1.0], time_constant_s=100.0, period_s=0.01)
    samples = [noise.next()[0] for _ in range(2 * BLOCK + 1)]
    steps = np.abs(np.diff(samples))
    assert steps.max() < 6 * math.sqrt(2 * 0.01 / 100.0)  # no jump where one block ends and the next begins


def test_imu_reads_truth_with_its_noise():
    imu, errors = Imu(generator()), ImuErrors()
    rows = []
    for _ in range(4000):
        messages = decode(imu.emit(TRUTH))
        rows.append(messages["imu_rates"][:3] + messages["imu_specific_force"][:3])
    samples = np.array(rows)
    expected = [0.0, 0.0, TRUTH.yaw_rate, TRUTH.specific_force_x, TRUTH.specific_force_y, TRUTH.specific_force_z]
    drift = np.array([errors.gyro_drift] * 3 + [errors.acceleration_drift] * 3)
    white = np.array([errors.gyro_white] * 3 + [errors.acceleration_white] * 3)
    assert np.all(np.abs(samples.mean(axis=0) - expected) < 4 * drift + 4 * white / math.sqrt(4000))
    assert np.diff(samples, axis=0).std(axis=0) / math.sqrt(2) == pytest.approx(white, rel=0.08)


def test_imu_feels_the_body_roll_and_pitch():
    imu = Imu(generator(), QUIET)
    imu.emit(TRUTH)
    moved = TRUTH._replace(roll=0.008, body_roll=0.008, pitch=0.001, body_pitch=0.001)
    rates = decode(imu.emit(moved))["imu_rates"]
    assert rates[:2] == pytest.approx([0.3, -0.1], abs=1e-4)


def test_gyroscope_on_a_bank_and_a_grade_is_that_of_the_rotation_matrix():
    rng = generator()
    for _ in range(200):
        yaw, pitch, roll = rng.uniform(-math.pi, math.pi), rng.uniform(-0.1, 0.1), rng.uniform(-0.5, 0.5)
        yaw_rate, pitch_rate, roll_rate = rng.uniform(-0.5, 0.5, 3)
        before, after = (
            Rotation.from_euler("ZYX", [yaw + h * yaw_rate, pitch + h * pitch_rate, roll + h * roll_rate])
            for h in (-0.5e-2, 0.5e-2)
        )
        expected = (before.inv() * after).as_rotvec() / 1e-2
        # The plant's yaw rate is that about the road's normal, from the heading's rate on the bank alone.
        still = {"body_roll": 0.0, "body_pitch": 0.0, "yaw_rate": yaw_rate * math.cos(roll)}
        last = TRUTH._replace(pitch=pitch - 1e-2 * pitch_rate, roll=roll - 1e-2 * roll_rate, **still)
        measured = body_rates(TRUTH._replace(pitch=pitch, roll=roll, **still), last)
        assert measured == pytest.approx(expected[:2], abs=4e-3)


def test_integrated_gyroscope_follows_the_attitude_through_a_banked_turn():
    """What inertial navigation does with the three rates must give the attitude that the plant has."""
    imu = Imu(generator(), QUIET)
    start = {"v0": 40.0, "gear0": 4, "gear_demand": 4, "engine_running0": True, "ignition": True}
    with Plant(start | {"road_bank": math.radians(9.0)}) as car:
        names = TruthReader(list(Truth._fields))
        attitude, rates, largest = None, np.zeros(3), 0.0
        for tick in range(900):
            bank = math.radians(9.0 + 11.0 * min(1.0, tick / 300.0))
            steer = 1.0 * (min(1.0, tick / 200.0) * 40.0 / 233.1 * math.cos(bank) - float(car["yaw_rate"]))
            car.step(steer_motor_demand=0.25 + steer, throttle_demand=0.4, road_bank=bank)
            truth = names.read(np.array([float(car[name]) for name in Truth._fields]))
            last, rates = rates, np.array(decode(imu.emit(truth))["imu_rates"][:3])
            true = Rotation.from_euler("ZYX", [truth.yaw, truth.pitch, truth.roll])
            if attitude is None:
                attitude = true
                continue
            # p and q are means over the tick but for their heading part; the yaw rate is taken as its mean.
            attitude = attitude * Rotation.from_rotvec(0.01 * np.array([*rates[:2], 0.5 * (last[2] + rates[2])]))
            largest = max(largest, (attitude.inv() * true).magnitude())
        assert truth.yaw > 1.0, "no turn"
        assert truth.roll < math.radians(-19.0)
        assert largest < 0.005


def test_imu_saturates_instead_of_wrapping():
    imu = Imu(generator())
    wild = TRUTH._replace(specific_force_y=500.0, specific_force_x=-500.0, yaw_rate=-40.0)
    messages = decode(imu.emit(wild))
    assert messages["imu_specific_force"][1] == pytest.approx(65.0, abs=0.01)
    assert messages["imu_specific_force"][0] == pytest.approx(-65.0, abs=0.01)
    assert messages["imu_rates"][2] == pytest.approx(-6.5, abs=0.01)


@pytest.mark.parametrize(("name", "errors"), [("a", ERRORS_A), ("b", ERRORS_B)])
def test_gnss_errors_have_the_reported_deviation(name: str, errors):
    frame = TrackFrame(Origin.latitude_deg, Origin.longitude_deg, Origin.height)
    metres = math.radians(1.0) * 6.37e6
    east, north, yaw, v_east = [], [], [], []
    for child in np.random.SeedSequence(SEED).spawn(150):
        receiver = Gnss(name, Origin(), np.random.default_rng(child), errors)
        for _ in range(4):
            messages = decode(receiver.emit(TRUTH))
        latitude, longitude = messages[f"gnss_{name}_position"]
        true_latitude, true_longitude, _ = frame.geodetic(TRUTH.x, TRUTH.y, 0.0)
        north.append((latitude - true_latitude) * metres)
        east.append((longitude - true_longitude) * metres * math.cos(math.radians(true_latitude)))
        yaw.append(messages[f"gnss_{name}_attitude"][0] - TRUTH.yaw)
        v_east.append(messages[f"gnss_{name}_velocity"][0])
        quality = messages[f"gnss_{name}_quality"]
    for measured, claimed in ((east, quality[0]), (north, quality[1])):
        assert np.std(measured) == pytest.approx(claimed, rel=0.25)
        assert abs(np.mean(measured)) < 4 * claimed / math.sqrt(150)
    assert np.std(yaw) == pytest.approx(messages[f"gnss_{name}_attitude"][1], rel=0.25)
    true_east = TRUTH.vx * math.cos(TRUTH.yaw) - TRUTH.vy * math.sin(TRUTH.yaw)
    assert np.mean(v_east) == pytest.approx(true_east, abs=0.02)
    assert np.std(v_east) == pytest.approx(errors.velocity_white, rel=0.25)


def test_gnss_climbs_with_the_grade_and_not_with_the_bank():
    silent = GnssErrors(*[0.0] * 7)
    receiver = Gnss("a", Origin(), generator(), silent)
    start = {"v0": 40.0, "road_grade": math.radians(3.0), "road_bank": math.radians(9.0)}
    names = TruthReader(list(Truth._fields))
    with Plant(start | {"oval_asymmetry": 0.0}) as car:
        climbed, last, first = 0.0, None, None
        for tick in range(200):
            car.step()
            truth = names.read(np.array([float(car[name]) for name in Truth._fields]))
            if tick % 5:
                continue
            messages = decode(receiver.emit(truth))
            height, speed = messages["gnss_a_attitude"][2], messages["gnss_a_velocity"][:3]
            assert math.hypot(*speed) == pytest.approx(truth.vx, rel=2e-3)
            assert math.atan2(speed[2], math.hypot(*speed[:2])) == pytest.approx(math.radians(3.0), abs=1e-3)
            if last is None:
                first = height
            else:
                climbed += 0.05 * 0.5 * (last + speed[2])
            last = speed[2]
        assert climbed > 3.0
        # The Earth's curvature adds s^2 / 2R, less than a millimetre here.
        assert height - first == pytest.approx(climbed, abs=5e-3)
        assert abs(truth.vy) > 0.05, "the bank does not act"


def test_gnss_heading_wraps_at_pi():
    receiver = Gnss("a", Origin(), generator(), ERRORS_A)
    headings = [decode(receiver.emit(TRUTH._replace(yaw=math.pi)))["gnss_a_attitude"][0] for _ in range(50)]
    assert all(-math.pi - 1e-4 <= heading <= math.pi + 1e-4 for heading in headings)
    assert min(headings) < -3.0 < 3.0 < max(headings)


def test_wgs84_against_an_iterated_inverse():
    # Independent: straight ECEF of the result must be the point itself, by the textbook's forward formulas.
    frame = TrackFrame(Origin.latitude_deg, Origin.longitude_deg, Origin.height)
    origin = ecef(Origin.latitude_deg, Origin.longitude_deg, Origin.height)
    for east, north, up in ((0.0, 0.0, 0.0), (900.0, -600.0, 3.0), (-5000.0, 5000.0, -20.0)):
        point = ecef(*frame.geodetic(east, north, up))
        latitude, longitude = math.radians(Origin.latitude_deg), math.radians(Origin.longitude_deg)
        axes = np.array(
            [
                [-math.sin(longitude), math.cos(longitude), 0.0],
                [
                    -math.sin(latitude) * math.cos(longitude),
                    -math.sin(latitude) * math.sin(longitude),
                    math.cos(latitude),
                ],
                [
                    math.cos(latitude) * math.cos(longitude),
                    math.cos(latitude) * math.sin(longitude),
                    math.sin(latitude),
                ],
            ]
        )
        assert axes @ (point - origin) == pytest.approx([east, north, up], abs=1e-4)


def ecef(latitude_deg: float, longitude_deg: float, height: float) -> np.ndarray:
    major, flattening = 6378137.0, 1 / 298.257223563
    square = flattening * (2 - flattening)
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    normal = major / math.sqrt(1 - square * math.sin(latitude) ** 2)
    return np.array(
        [
            (normal + height) * math.cos(latitude) * math.cos(longitude),
            (normal + height) * math.cos(latitude) * math.sin(longitude),
            (normal * (1 - square) + height) * math.sin(latitude),
        ]
    )


def test_suite_emits_at_its_rates():
    suite = SensorSuite(Origin(), SEED)
    emitted = [(now_us, list(decode(suite.emit(now_us, TRUTH)))) for now_us in range(0, 1_000_000, 10_000)]
    times = {
        name: [now_us for now_us, names in emitted if name in names]
        for name in ("imu_rates", "gnss_a_position", "gnss_b_position")
    }
    assert times["imu_rates"] == list(range(0, 1_000_000, 10_000))
    assert times["gnss_a_position"] == list(range(0, 1_000_000, 50_000))
    assert times["gnss_b_position"] == list(range(20_000, 1_000_000, 50_000))


def test_streams_repeat_with_the_seed_and_do_not_depend_on_each_other():
    def positions(seed: int, with_imu: bool) -> list[tuple[float, ...]]:
        suite = SensorSuite(Origin(), seed)
        result = []
        for now_us in range(0, 2_000_000, 10_000):
            if with_imu:
                suite.imu.emit(TRUTH)
            if suite.gnss_b.due(now_us):
                result.append(decode(suite.gnss_b.emit(TRUTH))["gnss_b_position"])
        return result

    assert positions(SEED, True) == positions(SEED, False)
    assert positions(SEED, True) != positions(SEED + 1, True)


def test_receivers_are_independent():
    suite = SensorSuite(Origin(), SEED)
    a, b = [], []
    for _ in range(4000):
        a.append(decode(suite.gnss_a.emit(TRUTH))["gnss_a_velocity"][0])
        b.append(decode(suite.gnss_b.emit(TRUTH))["gnss_b_velocity"][0])
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.06


def test_truth_reader_picks_by_name():
    names = ["gear", *reversed(Truth._fields), "extra"]
    values = [float(place) for place in range(len(names))]
    truth = TruthReader(names).read(np.array(values))
    assert truth == Truth(*(values[names.index(field)] for field in Truth._fields))
