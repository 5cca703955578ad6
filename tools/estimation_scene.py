"""Laps for `tools.estimation_bench`, on paper and of the bench's car, and what sensors say of them.

On paper the car goes round an ellipse, x = a cos wt and y = b sin wt: it brakes into both turns and accelerates out of
them, and position, velocity, acceleration and turn rate are exact at any time. The bench's car drives the solo lap.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from autonomy.estimation import GRAVITY, FilterTuning, GnssSample, ImuSample
from autonomy.frenet import FloatArray
from autonomy.messages import Inbox
from autonomy.track import Origin
from bridge.scenario import load_scenario
from bridge.sensors.gnss import ERRORS_A
from bridge.sensors.suite import SensorSuite
from bridge.sensors.truth import Truth
from tools.run import DEFAULT_SCENARIO, build_bench, load_road

TICK_US = 10_000
TICK_S = TICK_US * 1.0e-6
EPOCH_TICKS = 5  # per epoch of a receiver

#: As long and as fast as the Las Vegas oval: 2.37 km, 34 to 63 m/s (227 km/h); bank of its turns and straights.
HALF_LENGTH, HALF_WIDTH = 480.0, 260.0  # m
LAP_S = 48.0
BANK_TURN, BANK_STRAIGHT = math.radians(20.0), math.radians(9.0)
SLIP = 0.02  # rad, of the heading inwards of the course
ORIGIN = Origin(36.272, -115.010, 605.0)

#: The solo lap is looked at from here on: at racing speed, until after the second flying lap.
RACING_US = 60_000_000

Road = Callable[[float, float], tuple[float, float]]


class Tick(NamedTuple):
    """What arrives in one tick; epochs only in those in which a receiver has one."""

    imu: ImuSample
    gnss_a: GnssSample | None
    gnss_b: GnssSample | None


@dataclass(frozen=True)
class Motion:
    """True motion at the ticks, from 0 on.

    Attributes
    ----------
    state : shape (n, 5); x and y, m, velocity east and north, m/s, heading, rad, as the filter's first five.
    acceleration : shape (n, 2), m/s2, horizontal, along and across the heading.
    yaw_rate, bank : shape (n,), rad/s of the heading, and rad.
    """

    state: FloatArray
    acceleration: FloatArray
    yaw_rate: FloatArray
    bank: FloatArray


class Course(NamedTuple):
    """A drive as the bench's sensors sense it, tick by tick, and what it is judged by.

    Attributes
    ----------
    state : shape (n, 5), as in `Motion`.
    truths : n of them. road : as the map has it. origin : of the track frame.
    """

    state: FloatArray
    truths: Sequence[Truth]
    road: Road
    origin: Origin


def road(x: float, y: float) -> tuple[float, float]:  # noqa: ARG001
    """Bank and grade at a position, rad."""
    turn = min(1.0, (x / HALF_LENGTH) ** 2)
    return BANK_STRAIGHT + (BANK_TURN - BANK_STRAIGHT) * turn, 0.0


def drive(seconds: float, start: float = 0.0) -> Motion:
    """Drive round the oval.

    Parameters
    ----------
    seconds : how long. start : angle at the start, rad; 0 is the middle of a turn.
    """
    rate = math.tau / LAP_S
    angle = start + rate * TICK_S * np.arange(round(seconds / TICK_S) + 1)
    cos, sin = np.cos(angle), np.sin(angle)
    place = np.column_stack((HALF_LENGTH * cos, HALF_WIDTH * sin))
    velocity = rate * np.column_stack((-HALF_LENGTH * sin, HALF_WIDTH * cos))
    acceleration = -(rate**2) * place
    yaw = np.arctan2(velocity[:, 1], velocity[:, 0]) + SLIP
    east, north = acceleration.T
    along = east * np.cos(yaw) + north * np.sin(yaw)
    across = north * np.cos(yaw) - east * np.sin(yaw)
    # Of the course, and with constant slip of the heading, too: (v x a) / v^2.
    yaw_rate = (velocity[:, 0] * north - velocity[:, 1] * east) / np.sum(velocity**2, axis=1)
    state = np.column_stack((place, velocity, np.arctan2(np.sin(yaw), np.cos(yaw))))
    bank = BANK_STRAIGHT + (BANK_TURN - BANK_STRAIGHT) * cos**2
    return Motion(state, np.column_stack((along, across)), yaw_rate, bank)


def assumed_sensors(
    motion: Motion, tuning: FilterTuning, generator: np.random.Generator, louder: float = 1.0
) -> tuple[list[Tick], FloatArray]:
    """Samples of sensors that are what the filter assumes: white noise, and biases as random walks.

    The receiver has the deviations that receiver A states, the share of drift in them is the tuning's.

    Parameters
    ----------
    motion : to sense. tuning : noise of the IMU and its biases, drift of the receiver.
    louder : the receiver's noise by what it states.

    Returns
    -------
    ticks : with epochs of one receiver, A.
    hidden : shape (n, 6), true biases of acceleration along and across, m/s2, and yaw rate, rad/s, and true drifts of
        the receiver in x and y, m, and heading, rad.
    """
    count = len(motion.state)
    walk = np.array([tuning.acceleration_bias_noise] * 2 + [tuning.yaw_rate_bias_noise]) * math.sqrt(TICK_S)
    first = np.array([tuning.start_acceleration_bias] * 2 + [tuning.start_yaw_rate_bias])
    white = np.array([tuning.acceleration_noise] * 2 + [tuning.yaw_rate_noise]) / math.sqrt(TICK_S)
    steps = walk * generator.standard_normal((count, 3))
    steps[0] = first * generator.standard_normal(3)
    biases = np.cumsum(steps, axis=0)
    sensed = np.column_stack((motion.acceleration, motion.yaw_rate)) + biases
    sensed += white * generator.standard_normal((count, 3))
    deviations = (
        *(ERRORS_A.position_std,) * 2,
        ERRORS_A.velocity_white,
        math.hypot(ERRORS_A.yaw_white, ERRORS_A.yaw_drift),
    )
    place_x, place_y, velocity, yaw = deviations
    scatter = louder * np.array([place_x, place_y, velocity, velocity, yaw])
    share = np.array([tuning.position_drift, tuning.position_drift, 0.0, 0.0, tuning.yaw_drift])
    drifts = scatter * share * _markov(generator.standard_normal((count, 5)), math.exp(-TICK_S / tuning.drift_time_s))
    epochs = motion.state + drifts + scatter * np.sqrt(1.0 - share**2) * generator.standard_normal((count, 5))
    ticks = []
    for k, (imu, epoch) in enumerate(zip(_imu(sensed, motion.bank), epochs.tolist(), strict=True)):
        ticks.append(Tick(imu, GnssSample._make((*epoch, *deviations)) if k % EPOCH_TICKS == 0 else None, None))
    return ticks, np.column_stack((biases, drifts[:, [0, 1, 4]]))


def _markov(noise: FloatArray, decay: float) -> FloatArray:
    """Stationary Gauss-Markov processes of deviation 1 out of white noise, shape (n, k)."""
    process = noise.copy()
    renewed = math.sqrt(1.0 - decay**2)
    for k in range(1, len(process)):
        process[k] = decay * process[k - 1] + renewed * noise[k]
    return process


def on_paper(seconds: float) -> Course:
    """The ellipse, as `drive` has it."""
    motion = drive(seconds)
    return Course(motion.state, truths(motion), road, ORIGIN)


def solo_lap(seconds: float) -> Course:
    """The solo lap as the plant drives it from `RACING_US` on, with the track's map: neither is the filter's model."""
    scenario = load_scenario(DEFAULT_SCENARIO)
    track = load_road(scenario, scenario.track)
    assert track.origin is not None
    sensed = []
    with build_bench(scenario) as bench:
        while bench.now_us <= RACING_US + seconds * 1_000_000:
            if bench.now_us >= RACING_US:
                sensed.append(bench.truth)
            bench.tick()
    return Course(np.array([plane_state(truth) for truth in sensed]), sensed, track.road_at, track.origin)


def plane_state(truth: Truth) -> tuple[float, float, float, float, float]:
    """Motion in plan view, as the rows of `Motion.state`: velocity out of the road's plane."""
    cos, sin = math.cos(truth.yaw), math.sin(truth.yaw)
    along, across = truth.vx * math.cos(truth.road_pitch), truth.vy * math.cos(truth.road_roll)
    return truth.x, truth.y, along * cos - across * sin, along * sin + across * cos, truth.yaw


def bench_sensors(course: Course, seed: int) -> list[Tick]:
    """Samples of the bench's own sensors, through their frames: drift, coloured noise, resolution of the wire."""
    suite, inbox = SensorSuite(course.origin, seed), Inbox(course.origin.tangent_plane())
    ticks = []
    for k, truth in enumerate(course.truths):
        inbox.push(suite.emit(k * TICK_US, truth))
        imu = inbox.imu()
        assert imu is not None
        ticks.append(Tick(imu, *inbox.gnss()))
    return ticks


def truths(motion: Motion) -> list[Truth]:
    """Motion as the sensor models read it: in the road's axes."""
    x, y, east, north, yaw = motion.state.T
    cos, sin = np.cos(yaw), np.sin(yaw)
    sensed = np.column_stack((motion.acceleration, motion.yaw_rate))
    rows = np.column_stack(
        (x, y, yaw, east * cos + north * sin, (north * cos - east * sin) / np.cos(motion.bank), -motion.bank)
    )
    return [
        Truth(x, y, 0.0, yaw, vx, vy, imu.yaw_rate, roll, 0.0, 0.0, 0.0, *imu[:3], 0.0)
        for (x, y, yaw, vx, vy, roll), imu in zip(rows.tolist(), _imu(sensed, motion.bank), strict=True)
    ]


def _imu(horizontal: FloatArray, bank: FloatArray) -> Sequence[ImuSample]:
    """Turn accelerations and heading rate, shape (n, 3), out of the horizontal plane: the reverse of `level`."""
    along, across, rate = horizontal.T
    cos, sin = np.cos(bank), np.sin(bank)
    rows = (along, across * cos - GRAVITY * sin, across * sin + GRAVITY * cos, 0.0 * rate, -rate * sin, rate * cos)
    return [ImuSample(*row) for row in np.column_stack(rows).tolist()]
