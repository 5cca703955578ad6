"""The page on opponents: its example runs, and its tables state the figures in force."""

import dataclasses
import inspect
import re
from pathlib import Path

import pytest

from autonomy.opponents.imm_pdaf import ImmPdaf, SensorModel
from autonomy.opponents.motion_models import ConstantTurnRate, ConstantVelocity, RandomMotion
from autonomy.opponents.prediction import PredictionLimits
from autonomy.opponents.tracker import TrackerLimits

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "opponents.md").read_text()


def test_the_example_runs_and_predicts(monkeypatch: pytest.MonkeyPatch):
    (example,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(ROOT)
    names: dict[str, object] = {}
    exec(compile(example, "docs/opponents.md", "exec"), names)
    (car,), (prediction,) = names["objects"], names["predictions"]
    assert car.vx**2 + car.vy**2 == pytest.approx(55.0**2, rel=0.05)
    assert prediction.s[0] == pytest.approx(55.0 * 0.98, abs=0.5)
    assert names["status"] == 0


def in_force() -> dict[str, float]:
    """Every figure with a default, by the name that the page has for it."""
    figures = {
        field.name: field.default
        for limits in (TrackerLimits, PredictionLimits)
        for field in dataclasses.fields(limits)
    }
    for part in (ConstantVelocity, ConstantTurnRate, RandomMotion, SensorModel):
        figures |= {f"{part.__name__}.{field.name}": field.default for field in dataclasses.fields(part)}
    for name, parameter in inspect.signature(ImmPdaf).parameters.items():
        if isinstance(parameter.default, float):
            figures[f"ImmPdaf.{name}"] = parameter.default
    del figures["SensorModel.name"]
    return figures


def test_the_tables_state_every_figure_in_force():
    stated = {name: float(value) for name, value in re.findall(r"^\| `([\w.]+)`.* \| ([\d.]+) \|$", PAGE, re.MULTILINE)}
    assert stated == in_force()
