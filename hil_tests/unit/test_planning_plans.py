"""Invariants of plans over whole runs: limits, continuity over replans, path geometry, stops."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from autonomy.localisation import Estimate, Quality
from autonomy.planning import POINTS, Planner, PlannerSettings
from autonomy.race_path import RacePath
from autonomy.status import Mission, SsmStatus, VehicleStatus
from autonomy.track_files import load_track
from autonomy.vehicle import VehicleLimits, load_vehicle
from dbc.states import SsmState

SCENARIOS = Path(__file__).parents[2] / "scenarios"
SEED = 99
MAX_SPEED, MAX_ACCELERATION, MAX_DECELERATION = 63.06, 5.0, 8.0
PIT_SPEED = 13.86
TICK = 0.05


@pytest.fixture(scope="module")
def track():
    return load_track(SCENARIOS / "tracks" / "lvms.yaml")


@pytest.fixture(scope="module")
def car():
    file = SCENARIOS / "vehicles" / "av21.yaml"
    return VehicleLimits.from_parameters(file, load_vehicle(file))


@pytest.fixture(scope="module")
def race_path(track, car):
    return RacePath(track, car)


def estimate(x, y, yaw, vx):
    return Estimate(x, y, yaw, vx, 0.0, 0.0, 0.0, 0.0, 1, Quality.GOOD, 2.0, 2.0, 0.05)


class Drive:
    """A car that follows its plans, with noise on what the planner is told."""

    def __init__(self, track, race_path, car, start=(60.0, 5.5), noise=0.0, seed=SEED):
        print("seed", seed)
        self.rng = np.random.default_rng(seed)
        self.noise = noise
        self.planner = Planner(race_path, car)
        self.x, self.y, self.yaw = track.pose_at(*start)
        self.v = 0.0
        self.ssm = SsmStatus(SsmState.NOMINAL, MAX_SPEED, MAX_ACCELERATION, MAX_DECELERATION)
        self.vehicle = VehicleStatus(8, 0, PIT_SPEED)

    def step(self):
        n = self.noise * self.rng.normal(size=4)
        plan = self.planner.plan(
            estimate(self.x + 0.05 * n[0], self.y + 0.05 * n[1], self.yaw + 0.003 * n[2], self.v + 0.1 * n[3]),
            self.ssm,
            self.vehicle,
        )
        self.follow(plan)
        return plan

    def follow(self, plan):
        """Move along the plan's polyline for one planning period at the planned speed."""
        s, station = along(plan), project(plan, self.x, self.y)
        for _ in range(5):
            squared = np.interp(station, s, plan.speed**2)
            self.v = math.sqrt(max(0.0, float(squared)))
            station += self.v * TICK / 5
        i = min(int(np.searchsorted(s, station, side="right")) - 1, POINTS - 2)
        t = station - s[i]
        heading = plan.yaw[i] + 0.5 * plan.curvature[i] * t
        self.x, self.y = plan.x[i] + t * math.cos(heading), plan.y[i] + t * math.sin(heading)
        self.yaw = math.remainder(plan.yaw[i] + plan.curvature[i] * t, math.tau)

    def run(self, seconds):
        return [(self.step(), self.v) for _ in range(round(seconds / TICK))]


def along(plan):
    chord = np.hypot(np.diff(plan.x), np.diff(plan.y))
    turn = np.array([math.remainder(t, math.tau) for t in np.diff(plan.yaw)])
    return np.concatenate(([0.0], np.cumsum(chord * (1.0 + turn**2 / 24.0))))


def project(plan, x, y):
    i = int(np.argmin(np.hypot(plan.x - x, plan.y - y)))
    return along(plan)[i] + (x - plan.x[i]) * math.cos(plan.yaw[i]) + (y - plan.y[i]) * math.sin(plan.yaw[i])


@pytest.fixture(scope="module")
def lap(track, race_path, car):
    """Hold, pit-out, caution, race for a lap, chequered stop, all with noise."""
    drive = Drive(track, race_path, car, noise=1.0)
    drive.vehicle = VehicleStatus(6, 0, 0.0)
    history = drive.run(1.0)
    drive.vehicle = VehicleStatus(8, 0, PIT_SPEED)
    history += drive.run(25.0)
    drive.vehicle = VehicleStatus(9, 0, PIT_SPEED)
    history += drive.run(60.0)
    drive.vehicle = VehicleStatus(9, 4, PIT_SPEED)
    history += drive.run(0.5)
    drive.vehicle = VehicleStatus(8, 4, PIT_SPEED)
    history += drive.run(30.0)
    return history


def test_the_missions_come_in_order(lap):
    missions = [plan.mission for plan, _ in lap]
    order = [m for i, m in enumerate(missions) if i == 0 or missions[i - 1] is not m]
    assert order == [Mission.HOLD, Mission.PIT_OUT, Mission.CAUTION, Mission.RACE, Mission.STOP]


def test_hold_plans_stand_still(lap):
    for plan, speed in lap:
        if plan.mission is Mission.HOLD:
            assert not plan.speed.any()
            assert plan.ends_in_stop
            assert speed == 0.0


def test_no_plan_is_faster_than_the_limits(lap, race_path):
    for plan, _ in lap:
        cap = PIT_SPEED if plan.mission in (Mission.PIT_OUT, Mission.CAUTION) else MAX_SPEED
        assert plan.speed.max() <= cap + 1e-9
        assert plan.speed.min() >= 0.0
        assert np.all(np.isfinite(plan.speed))
        assert plan.speed.max() <= race_path.race.speed_limit.max()


def test_the_target_speeds_are_reached(lap):
    caution = [speed for plan, speed in lap if plan.mission is Mission.CAUTION]
    race = [speed for plan, speed in lap if plan.mission is Mission.RACE]
    assert caution[-1] == pytest.approx(PIT_SPEED, abs=0.01)
    assert max(race) == pytest.approx(MAX_SPEED, abs=0.01)


def test_planned_acceleration_keeps_to_the_limits(lap):
    comfortable = PlannerSettings().deceleration
    for plan, _ in lap:
        acceleration = np.diff(plan.speed**2) / (2.0 * plan.spacing)
        assert acceleration.max() <= MAX_ACCELERATION + 1e-6
        # A stop that starts from full acceleration may ask for a little more than comfort at its end.
        assert acceleration.min() >= -1.35 * comfortable


def test_jerk_is_limited_while_driving(lap):
    for plan, _ in lap:
        v = plan.speed
        if plan.mission is Mission.HOLD or v.min() < 3.0:
            continue
        acceleration = np.diff(v**2) / (2.0 * plan.spacing)
        dt = plan.spacing / v[1:-1]
        # The one exception is the arrival at the cap, cut off by a step of the grid.
        assert np.sort(np.abs(np.diff(acceleration)) / dt)[-2] < 2.5 * PlannerSettings().jerk


def speed_at(plan, x, y):
    return math.sqrt(float(np.interp(project(plan, x, y), along(plan), plan.speed**2)))


def test_speeds_are_continuous_over_replans(lap):
    """Where two successive plans overlap they agree, unless the mission changed; measurement noise is not in them."""
    worst = 0.0
    for (old, _), (new, _) in itertools.pairwise(lap):
        if old.mission is not new.mission:
            continue
        count = 8  # the near part: farther on a coarser grid sees other points
        for i in range(1, count):
            if along(old)[-1] > project(old, new.x[i], new.y[i]) > 0.0:
                worst = max(worst, abs(speed_at(old, new.x[i], new.y[i]) - new.speed[i]))
    assert worst < 0.35


def test_the_plan_at_the_car_never_steps(lap):
    speeds = np.array([speed for _, speed in lap])
    # A speed over the place has no start from standstill: the first point lies behind the car.
    change = np.diff(speeds)[speeds[:-1] > 4.0] / TICK
    assert change.max() < MAX_ACCELERATION * 1.05
    assert change.min() > -1.4 * PlannerSettings().deceleration


def test_plans_share_their_points_while_the_spacing_stays(lap):
    for (old, _), (new, _) in itertools.pairwise(lap):
        if old.spacing != new.spacing or old.mission is not new.mission:
            continue
        gap = np.hypot(new.x[0] - old.x, new.y[0] - old.y)
        assert gap.min() < 1e-9


def test_points_form_the_path_they_describe(lap):
    for plan, _ in lap:
        heading = np.arctan2(np.diff(plan.y), np.diff(plan.x))
        middle = plan.yaw[:-1] + 0.5 * np.array([math.remainder(t, math.tau) for t in np.diff(plan.yaw)])
        error = np.array([math.remainder(t, math.tau) for t in heading - middle])
        assert np.max(np.abs(error)) < 2e-3
        turn = np.array([math.remainder(t, math.tau) for t in np.diff(plan.yaw)])
        mean_curvature = 0.5 * (plan.curvature[:-1] + plan.curvature[1:])
        assert np.max(np.abs(turn / np.diff(along(plan)) - mean_curvature)) < 3e-4
        assert np.all(np.abs(plan.yaw) <= math.pi)
        assert np.max(np.abs(plan.bank)) < 0.5


def test_the_horizon_reaches_far_enough(lap, track):
    for plan, speed in lap:
        ahead = along(plan)[-1]
        if plan.mission is Mission.RACE and speed > 62.5:
            assert ahead > 230.0
        # Room to stop with what the SSM allows, at any speed.
        assert ahead > 5.0 + speed * speed / (2.0 * MAX_DECELERATION) * 0.85
        assert 0.0 <= plan.origin_s < track.length


def test_the_stop_is_reached_and_kept(lap):
    stops = [(plan, speed) for plan, speed in lap if plan.mission is Mission.STOP]
    assert stops[-1][1] == 0.0
    assert stops[-1][0].ends_in_stop
    places = []
    for plan, _ in stops:
        assert plan.ends_in_stop == (plan.speed[-1] == 0.0)
        if plan.ends_in_stop:
            first = int(np.argmax(plan.speed == 0.0))
            assert not plan.speed[first:].any()
            places.append((plan.spacing, plan.x[first], plan.y[first]))
    # One place to stop, seen ever more finely.
    last = places[-1]
    assert all(math.hypot(x - last[1], y - last[2]) < spacing + 2.0 for spacing, x, y in places)


def test_the_pit_out_path_leads_from_the_car_to_the_race_line(track, race_path):
    x, y, yaw = track.pose_at(60.0, 5.5)
    station, offset = race_path.project(x, y)
    path, length = race_path.blend(x, y, yaw + 0.02)
    near = int(np.argmin(np.hypot(path.x - x, path.y - y)))
    heading = path.yaw[near]
    assert abs(math.cos(heading) * (y - path.y[near]) - math.sin(heading) * (x - path.x[near])) < 0.02
    assert math.remainder(heading - yaw - 0.02, math.tau) == pytest.approx(0.0, abs=5e-3)
    assert abs(offset) > 0.3  # the case is worth its name
    nodes = np.arange(race_path.count)
    ahead = (nodes * race_path.spacing - station) % race_path.length
    beyond = (ahead > length + 2.0) & (ahead < race_path.length - 25.0)
    np.testing.assert_array_equal(path.x[beyond], race_path.race.x[beyond])
    np.testing.assert_array_equal(path.curvature[beyond], race_path.race.curvature[beyond])


@pytest.mark.parametrize("aside", [0.0, 0.28, -0.28])
def test_the_curvature_of_the_pit_out_path_is_that_of_its_points(track, race_path, aside):
    x, y, yaw = track.pose_at(60.0, 5.5)
    path, length = race_path.blend(x, y, yaw + aside)
    station, _ = race_path.project(x, y)
    nodes = (np.arange(0, int(length / race_path.spacing)) + math.ceil(station / race_path.spacing)) % race_path.count
    px, py = path.x[nodes], path.y[nodes]
    heading = np.unwrap(np.arctan2(np.diff(py), np.diff(px)))
    step = np.hypot(np.diff(px), np.diff(py))
    numeric = np.diff(heading) / (0.5 * (step[1:] + step[:-1]))
    np.testing.assert_allclose(path.curvature[nodes][1:-1], numeric, atol=2e-5)
    assert np.max(np.abs(path.curvature[nodes])) < 0.02


def test_the_pit_out_path_is_not_anchored_anew(track, race_path, car):
    """A car that slides off its path sees the path stay."""
    drive = Drive(track, race_path, car)
    history = drive.run(4.0)
    before = history[-1][0]
    drive.x += 0.8 * math.sin(drive.yaw)
    drive.y -= 0.8 * math.cos(drive.yaw)
    after = drive.planner.plan(estimate(drive.x, drive.y, drive.yaw, drive.v), drive.ssm, drive.vehicle)
    gap = [np.hypot(before.x - x, before.y - y).min() for x, y in zip(after.x[:10], after.y[:10], strict=True)]
    assert min(gap) < 1e-9
    assert drive.planner.cross_track == pytest.approx(-0.8, abs=0.05)


def test_a_lower_limit_is_approached_not_jumped_to(track, race_path, car):
    drive = Drive(track, race_path, car)
    drive.vehicle = VehicleStatus(9, 0, PIT_SPEED)
    drive.run(40.0)
    assert drive.v > 60.0
    drive.ssm = SsmStatus(SsmState.DEGRADED, 40.0, MAX_ACCELERATION, MAX_DECELERATION)
    history = drive.run(12.0)
    speeds = np.array([v for _, v in history])
    assert speeds[-1] == pytest.approx(40.0, abs=0.05)
    assert speeds.min() > 39.9
    assert (np.diff(speeds) / TICK).min() > -PlannerSettings().deceleration * 1.1


def test_a_plan_gives_way_to_a_car_that_cannot_follow(track, race_path, car):
    drive = Drive(track, race_path, car)
    drive.vehicle = VehicleStatus(9, 0, PIT_SPEED)
    drive.run(10.0)
    slow = drive.v - 15.0
    plan = drive.planner.plan(estimate(drive.x, drive.y, drive.yaw, slow), drive.ssm, drive.vehicle)
    assert speed_at(plan, drive.x, drive.y) == pytest.approx(slow + PlannerSettings().lead, abs=0.5)


def test_a_target_speed_of_zero_is_no_permission(track, race_path, car):
    drive = Drive(track, race_path, car)
    drive.vehicle = VehicleStatus(8, 0, 0.0)
    assert all(v == 0.0 and not plan.speed.any() for plan, v in drive.run(2.0))


def test_after_a_red_flag_stop_driving_goes_on(track, race_path, car):
    drive = Drive(track, race_path, car)
    drive.run(15.0)
    drive.vehicle = VehicleStatus(10, 0, PIT_SPEED)
    drive.run(15.0)
    assert drive.v == 0.0
    drive.vehicle = VehicleStatus(8, 0, PIT_SPEED)
    drive.run(10.0)
    assert drive.v == pytest.approx(PIT_SPEED, abs=0.05)


def test_noise_does_not_move_the_speeds(track, race_path, car):
    quiet, noisy = (Drive(track, race_path, car, noise=n) for n in (0.0, 1.0))
    a, b = ([v for _, v in drive.run(20.0)] for drive in (quiet, noisy))
    # The only difference left is the place of the first point at the start.
    assert abs(a[-1] - b[-1]) < 0.01
