"""Gear requests: thresholds with hysteresis, pauses, neutral."""

from __future__ import annotations

import pytest

from bridge._native import ffi, lib

READY, LOCKED_OUT, UPSHIFT, DOWNSHIFT = 1, 2, 3, 4
UP = {1: 11.0, 2: 22.0, 3: 28.5, 4: 37.5, 5: 44.0}
DOWN = {2: 9.5, 3: 19.5, 4: 25.0, 5: 35.0, 6: 41.5}
PAUSE = 30


class Shifter:
    """Gear logic with a gearbox that changes one gear in `shift_ticks`."""

    def __init__(self, gear: int = 0, shift_ticks: int = 10) -> None:
        self.state = ffi.new("gear_shift *")
        self.state.requested = gear
        self.gear, self.status, self.shift_ticks = gear, READY, shift_ticks
        self._left = 0
        self.requests: list[int] = []

    def run(self, speed: float, ticks: int, engine: bool = True, drive: bool = True) -> None:
        for _ in range(ticks):
            request = lib.gear_shift_step(self.state, speed, self.gear, self.status, engine, drive)
            self.requests.append(request)
            if self._left > 0:
                self._left -= 1
                if self._left == 0:
                    self.gear += 1 if self.status == UPSHIFT else -1
                    self.status = READY
            elif request != self.gear:
                self.status = UPSHIFT if request > self.gear else DOWNSHIFT
                self._left = self.shift_ticks


@pytest.mark.parametrize("gear", UP)
def test_shifts_up_above_its_speed_only(gear: int) -> None:
    shifter = Shifter(gear)
    shifter.run(UP[gear] - 0.05, 100)
    assert shifter.gear == gear
    shifter.run(UP[gear] + 0.05, 100)
    assert shifter.gear == gear + 1
    shifter.run(UP[gear] - 0.05, 100)
    assert shifter.gear == gear + 1


@pytest.mark.parametrize("gear", DOWN)
def test_shifts_down_below_its_speed_only(gear: int) -> None:
    shifter = Shifter(gear)
    shifter.run(DOWN[gear] + 0.05, 100)
    assert shifter.gear == gear
    shifter.run(DOWN[gear] - 0.05, 100)
    assert shifter.gear == gear - 1


def test_goes_through_all_gears_one_by_one_with_pauses() -> None:
    shifter = Shifter()
    shifter.run(60.0, 400)
    assert shifter.gear == 6
    changes = [i for i in range(1, len(shifter.requests)) if shifter.requests[i] != shifter.requests[i - 1]]
    assert [shifter.requests[i] for i in changes] == [2, 3, 4, 5, 6]
    assert min(b - a for a, b in zip([0, *changes], changes, strict=False)) >= PAUSE
    shifter.run(5.0, 400)
    assert shifter.gear == 1


def test_waits_for_a_slow_gearbox() -> None:
    shifter = Shifter(1, shift_ticks=120)
    shifter.run(60.0, 110)
    assert set(shifter.requests) == {2}
    shifter.run(60.0, 30)
    assert shifter.requests[-1] == 3


def test_first_gear_only_when_drive_is_wanted() -> None:
    shifter = Shifter()
    shifter.run(0.0, 200, drive=False)
    assert set(shifter.requests) == {0}
    shifter.run(0.0, 50)
    assert shifter.gear == 1


def test_neutral_while_the_engine_stands() -> None:
    shifter = Shifter(3)
    shifter.run(25.0, 10)
    assert shifter.requests[-1] == 3
    shifter.run(25.0, 1, engine=False)
    assert shifter.requests[-1] == 0


def test_refused_request_is_given_up() -> None:
    """Locked out of the lower gear: as soon as the speed no longer asks for it, the old gear is requested again."""
    state = ffi.new("gear_shift *")
    state.requested = 4
    for _ in range(60):
        assert lib.gear_shift_step(state, 24.0, 4, LOCKED_OUT, True, True) == 3
    for _ in range(PAUSE + 1):
        request = lib.gear_shift_step(state, 30.0, 4, LOCKED_OUT, True, True)
    assert request == 4


def test_gear_that_does_not_exist_changes_nothing() -> None:
    state = ffi.new("gear_shift *")
    state.requested = 2
    for gear in (7, 255):
        assert lib.gear_shift_step(state, 60.0, gear, READY, True, True) == 2
