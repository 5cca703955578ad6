"""docs/estimation.md says what the code does: tuning, limits, the bound of a step, the example, the printed tables."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import pytest

from autonomy.estimation import FilterTuning
from autonomy.localisation import QualityLimits
from bridge.sensors.gnss import ERRORS_A, ERRORS_B
from bridge.sensors.imu import ImuErrors
from tools.estimation_bench import INNOVATION, ONCE_IN, PARTS, REPORTED
from tools.estimation_scene import RACING_US, TICK_S, drive

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "estimation.md").read_text()
TEXT = " ".join(PAGE.split())


def test_the_example_runs():
    (example,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    names: dict = {}
    exec(compile(example, "docs/estimation.md", "exec"), names)
    estimate = names["estimate"]
    assert (estimate.source, estimate.x, estimate.vx) == (1, pytest.approx(60.0 * 1.99, abs=0.05), pytest.approx(60.0))


def test_the_tables_state_every_figure_in_force():
    stated = {name: float(value) for name, value in re.findall(r"^\| `(\w+)`.* \| ([\d.]+) \|$", PAGE, re.MULTILINE)}
    assert stated == {
        field.name: field.default for one in (FilterTuning, QualityLimits) for field in dataclasses.fields(one)
    }


def test_what_it_says_of_the_sensors_is_so():
    errors = ImuErrors()
    tuning = FilterTuning()
    noise = [tuning.acceleration_noise / TICK_S**0.5, tuning.yaw_rate_noise / TICK_S**0.5]
    assert noise == pytest.approx([errors.acceleration_white, errors.gyro_white])
    wander = errors.acceleration_drift * (2.0 / errors.time_constant_s) ** 0.5
    assert 1.5 < tuning.acceleration_bias_noise / wander < 2.5, "twice as fast"
    for receiver in (ERRORS_A, ERRORS_B):
        assert receiver.position_drift / receiver.position_std == pytest.approx(tuning.position_drift, abs=0.01)
        yaw_std = math.hypot(receiver.yaw_white, receiver.yaw_drift)
        assert receiver.yaw_drift / yaw_std == pytest.approx(tuning.yaw_drift, abs=0.01)
        assert receiver.time_constant_s == tuning.drift_time_s
    speed = [float((v**2).sum() ** 0.5) for v in drive(48.0).state[:, 2:4]]
    for said in (
        f"{100 * ERRORS_A.position_drift:g} of the {100 * ERRORS_A.position_std:.1f} cm that receiver A states",
        f"({100 * ERRORS_B.position_drift:g} of {100 * ERRORS_B.position_std:.1f} cm of B)",
        f"the bench's, {errors.acceleration_white:g} m/s2 and {errors.gyro_white:g} rad/s per sample",
        f"from its second {RACING_US // 1_000_000} on",
        f"at {min(speed):.0f} to {max(speed):.0f} m/s",
        f"in {ONCE_IN - 1} of {ONCE_IN} studies",
    ):
        assert said in TEXT, said
    assert ERRORS_A.time_constant_s == ERRORS_B.time_constant_s == 60.0, "a drift of a minute"


def test_the_printed_tables_have_every_part():
    (block,) = re.findall(r"^```text\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in block.splitlines() if line[:1] == "│"]
    motion = [*list(PARTS)[1:], INNOVATION]
    of_the_bench = [*motion, REPORTED, *motion]
    names = [*PARTS, INNOVATION, *of_the_bench * 2, "Localiser.step", "plain filterpy"]
    assert [row[0] for row in rows] == names
    for row in rows[: len(PARTS) + 1 + len(of_the_bench)]:
        low, high = map(float, row[5].split())
        assert low <= float(row[4]) <= high, row
