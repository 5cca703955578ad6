"""The committed tables are what the design computes now, and the design holds: stability with dead time, smoothness."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from autonomy.controller_design import (
    DEAD_TICKS,
    LOWEST_SPEED,
    PERIOD,
    PREVIEW_STEPS,
    PREVIEW_TICKS,
    SPEED_STEP,
    SPEEDS,
    TABLE_FILE,
    VEHICLE_FILE,
    Matrix,
    error_model,
    gain_table,
    lateral_gains,
    main,
    plant_model,
    source,
    tables,
)
from autonomy.vehicle import load_vehicle
from bridge._native import ffi, lib
from dbc.errors import ConfigurationError

ROW_SPEEDS = np.maximum(np.arange(SPEEDS) * SPEED_STEP, LOWEST_SPEED)
BANKED_TURN = 15.0  # m/s2, normal acceleration at 62 m/s in the 20 degree turns


@pytest.fixture
def car() -> dict[str, float]:
    return load_vehicle(VEHICLE_FILE)


@pytest.fixture(scope="module")
def gains() -> Matrix:
    return committed("lqr_gain")


def committed(name: str) -> Matrix:
    """A field of the tables that the firmware was built with."""
    value = getattr(lib.controller_table, name)
    if isinstance(value, float):
        return np.array(value)

    def nested(item: object) -> object:
        return item if isinstance(item, float) else [nested(part) for part in item]  # type: ignore[attr-defined]

    return np.array(nested(value))


def test_firmware_holds_what_the_design_computes(car: Mapping[str, float]) -> None:
    computed = tables(car)
    fields = [name for name, _ in ffi.typeof("controller_tables").fields]
    assert list(computed) == fields
    for name, value in computed.items():
        np.testing.assert_allclose(committed(name), value, rtol=2e-4, atol=1e-7, err_msg=name)


def test_committed_file_is_of_the_present_vehicle_file() -> None:
    assert source().splitlines()[:2] == TABLE_FILE.read_text(encoding="utf-8").splitlines()[:2]


def test_table_sizes_are_those_of_the_header() -> None:
    assert (lib.CONTROLLER_SPEEDS, lib.CONTROLLER_DEAD_TICKS) == (SPEEDS, DEAD_TICKS)
    assert (lib.CONTROLLER_PREVIEW_STEPS, lib.CONTROLLER_PREVIEW_TICKS) == (PREVIEW_STEPS, PREVIEW_TICKS)


def test_dead_time_covers_the_actuator_and_one_period(car: Mapping[str, float]) -> None:
    covered = (DEAD_TICKS - 1) * PERIOD
    assert covered == pytest.approx(car["steer_delay"])


def test_error_model_turns_like_the_bicycle(car: Mapping[str, float]) -> None:
    """Steady state against the understeer equation, independent of the state-space form."""
    speed, steer = 30.0, 0.01
    a, b = error_model(car, speed)
    # e_y' and e_psi' constant: 0 = A x + B steer in the two accelerations, on a straight reference.
    rate, turn = np.linalg.solve(a[np.ix_([1, 3], [1, 3])], -(b[[1, 3], 0] * steer))
    lf, lr = car["cg_to_front_axle"], car["cg_to_rear_axle"]
    mass = car["mass"]
    stiffness = np.linalg.solve(np.array([[1.0, 1.0], [lf, -lr]]), [a[1, 2] * mass, a[3, 2] * car["yaw_inertia"]])
    gradient = mass / (lf + lr) * (lr / stiffness[0] - lf / stiffness[1])
    # Without the heading's part the lateral speed carries the turn: v r balances the tyres.
    assert b[1, 0] * mass == pytest.approx(stiffness[0])
    assert b[3, 0] * car["yaw_inertia"] == pytest.approx(stiffness[0] * lf)
    body = a[np.ix_([1, 3], [1, 3])] - np.array([[0.0, speed], [0.0, 0.0]])
    _, yaw_rate = np.linalg.solve(body, -(b[[1, 3], 0] * steer))
    assert yaw_rate == pytest.approx(speed * steer / (lf + lr + gradient * speed**2), rel=1e-9)
    assert np.isfinite([rate, turn]).all()


def with_prediction(
    car: Mapping[str, float], gain: Matrix, speed: float, normal: float | None, true_ticks: int
) -> Matrix:
    """Closed loop of the plant with `true_ticks` of dead time under the firmware's law, which predicts over DEAD_TICKS
    with the nominal model: states are the plant's seven and the commands of the last ticks, newest first."""
    a, b = plant_model(car, speed, normal)
    model_a, model_b = plant_model(car, speed)
    queue = max(true_ticks, DEAD_TICKS)
    n = 7 + queue
    prediction = np.zeros((7, n))
    prediction[:, :7] = np.linalg.matrix_power(model_a, DEAD_TICKS)
    for age in range(DEAD_TICKS):  # the command of `age` + 1 ticks ago acts DEAD_TICKS - 1 - age steps before the end
        prediction[:, 7 + age] = (np.linalg.matrix_power(model_a, age) @ model_b)[:, 0]
    prediction[6] = 0.0
    prediction[6, 6] = 1.0  # the integral is not predicted
    closed = np.zeros((n, n))
    closed[:7, :7] = a
    if true_ticks > 0:
        closed[:7, 7 + true_ticks - 1] = b[:, 0]
        closed[7] = -gain @ prediction
    else:
        closed[:7] += b @ (-gain @ prediction)[None, :]
    for i in range(1, queue):
        closed[7 + i, 7 + i - 1] = 1.0
    return closed


@pytest.mark.parametrize("normal", [None, BANKED_TURN])
@pytest.mark.parametrize("extra", [-2, 0, 3])
def test_closed_loop_is_stable_and_damped_at_every_speed(
    car: Mapping[str, float], gains: Matrix, normal: float | None, extra: int
) -> None:
    """With the actuator, the dead time as modelled, 20 ms less and 30 ms more, on the level and in the banking."""
    for speed, gain in zip(ROW_SPEEDS, gains, strict=True):
        poles = np.linalg.eigvals(with_prediction(car, gain, float(speed), normal, DEAD_TICKS + extra))
        assert np.abs(poles).max() < 1.0 - 1e-4, f"{speed} m/s"
        rates = np.log(poles[np.abs(poles) > 1e-6]) / PERIOD
        slow = rates[np.abs(rates) < 12.0]
        assert (-slow.real / np.abs(slow)).min() > (0.45 if extra <= 0 else 0.3), f"{speed} m/s"


def test_instability_would_be_seen(car: Mapping[str, float], gains: Matrix) -> None:
    poles = np.linalg.eigvals(with_prediction(car, 8.0 * gains[24], 60.0, None, DEAD_TICKS + 6))
    assert np.abs(poles).max() > 1.0


def test_gains_are_continuous_over_speed(car: Mapping[str, float], gains: Matrix) -> None:
    change = np.abs(np.diff(gains, axis=0)) / np.abs(gains).max(axis=0)
    assert change.max() < 0.3
    # Between the rows the interpolated gain is close to the one that the design would give there.
    for row in range(2, SPEEDS - 1):
        speed = (row + 0.5) * SPEED_STEP
        exact, _ = lateral_gains(car, speed)
        np.testing.assert_allclose(0.5 * (gains[row] + gains[row + 1]), exact, rtol=0.06)


def test_gains_steer_against_every_error(gains: Matrix) -> None:
    assert (gains > 0.0).all()
    assert (np.diff(gains[10:, 0]) < 0.0).all()  # less steering per metre the faster the car


def test_preview_has_faded_at_its_end(car: Mapping[str, float]) -> None:
    _, preview = gain_table(car)
    fast = preview[ROW_SPEEDS >= 30.0]
    assert (np.abs(fast[:, -1]).max(axis=0) < 0.12 * np.abs(fast).max(axis=(0, 1))).all()


def test_missing_parameter_is_named(car: dict[str, float]) -> None:
    del car["steer_bandwidth"]
    with pytest.raises(ConfigurationError, match="steer_bandwidth"):
        tables(car)


def test_command_writes_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "tables.c"
    monkeypatch.setattr("sys.argv", ["controller_design", "--out", str(out)])
    main()
    assert out.read_text(encoding="utf-8") == source()
