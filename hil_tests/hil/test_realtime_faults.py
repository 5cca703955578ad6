"""Faults of processes in real time, over the hub: full brake in time, and nothing lets go of it afterwards.

Each test drives a car of its own from power-on to motion, because a full brake ends with the next power-on only. The
deadlines come from `reaction_times`; the table of what was measured is printed at the end (`pytest -rP`).
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from reaction_times import EMERGENCY_STOP, reactions_to
from realtime_rig import FULL_BRAKE_PA, MOVING, Measured, car, table
from station_loss import ECUS, FAULTS, LOSSES, SHUT_DOWN, SSM_BRAKES, Loss, comes_back, lose_and_get_back

from bridge._native import lib
from bridge.realtime.link import CanLink
from bridge.realtime.placement import Placement
from bridge.surroundings import TICK_US
from dbc.errors import RaceloopError
from dbc.frames import Bus
from tools.realtime_run import PHASES_US, RealTimeOptions

pytestmark = pytest.mark.realtime

ALLOWANCE_US = 100_000
"""How late this machine may be beyond a deadline: it is shared, and its host takes its cores away now and then."""

PRIORITY = 90
"""Above what else may run in real time here. Who takes a core from the ECUs in a test comes above them."""
ABOVE = 95


def placement(**choices: int) -> Placement:
    """Real-time priority where that is permitted: then only the host delays a cycle."""
    chosen = Placement(priority=PRIORITY, **choices)
    try:
        chosen.check()
    except RaceloopError:
        return Placement(**choices)
    return chosen


@pytest.fixture(scope="module")
def measured() -> Iterator[list[Measured]]:
    """Collects the reactions of the module."""
    all_of_them: list[Measured] = []
    yield all_of_them
    print(f"\n{table(all_of_them)}")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=lambda number: number.name)
@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.gone)
def test_loss_of_a_station(
    loss: Loss, number: signal.Signals, tmp_path: Path, measured: list[Measured], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing is left of it, even of a process that could not clear up behind itself."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setenv("TMPDIR", str(scratch))
    with car(tmp_path, RealTimeOptions(placement=placement())) as it:
        measured += lose_and_get_back(it, loss, number, ALLOWANCE_US)
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=lambda number: number.name)
def test_loss_of_the_hub(number: signal.Signals, tmp_path: Path, measured: list[Measured]) -> None:
    """Nobody hears anybody: each ECU brakes by itself, and all still do when the buses are back."""
    fault = f"hub {number.name}"
    by_wire = next(one for one in reactions_to("hub") if one.by == "space-drive")
    with car(tmp_path, RealTimeOptions(placement=placement())) as it:
        it.drive()
        fault_us = it.signal("hub", number)
        # No bus tells of it; the Space Drive's wires do.
        it.until(lambda: it.brake_demand()[1] > 0.999 * FULL_BRAKE_PA, "the brake")
        wire_us = it.brake_demand()[0] - fault_us
        assert wire_us <= by_wire.deadline_us + ALLOWANCE_US, it.story()
        it.watch(0.3)
        comes_back(it, "hub", number)
        if number == signal.SIGSTOP:  # what was sent meanwhile comes now, with the stamps of then
            measured += it.reacts("hub", fault_us, fault, ALLOWANCE_US)
        else:
            measured.append(Measured(fault, "space-drive, wires", by_wire.deadline_us, wire_us))
        slowest_us = reactions_to("hub")[-1].deadline_us
        it.until(lambda: it.stands, "standstill")
        it.watch(0.5)
        it.still_brakes(fault_us + slowest_us + ALLOWANCE_US, *ECUS)
        assert it.says(*SSM_BRAKES), it.story()
        assert it.says(*SHUT_DOWN), it.story()
        assert it.stands, it.story()


def test_safe_stop_ends_with_a_reset(tmp_path: Path) -> None:
    """Sensors that pause are a safe stop, which only the operator ends, and only at standstill: then it drives on."""
    with car(tmp_path, RealTimeOptions(placement=placement())) as it:
        it.drive()
        fault_us = it.signal("plant", signal.SIGSTOP)
        it.until(lambda: (it.receiver.brakes_since(EMERGENCY_STOP) or 0) > fault_us, "a safe stop")
        it.signal("plant", signal.SIGCONT)
        it.until(lambda: it.stands, "standstill")
        it.watch(0.5)
        assert it.says("ssm_status", "ssm_state", lib.SSM_EMERGENCY), it.story()
        assert it.stands, it.story()
        it.withdraw_launch()  # the operator's own frames ask for it again
        it.until(lambda: it.speed > MOVING, "motion")
        assert it.says("ssm_status", "ssm_state", lib.SSM_NOMINAL), it.story()


def test_busy_core(tmp_path: Path, measured: list[Measured]) -> None:
    """Load and a short stall change nothing; an OBC that misses more drives DEGRADED for a while.

    Who loses the core for long brakes as soon as he has it again.
    """
    core = max(os.sched_getaffinity(0))
    try:
        Placement(PRIORITY, core).check()
    except RaceloopError:
        pytest.skip("no permission for real-time priority")
    with car(tmp_path, RealTimeOptions(placement=Placement(PRIORITY, core))) as it:
        since_us = it.drive()
        it.busy(core, 1.0)
        it.busy(core, 0.02, ABOVE)
        it.watch(0.3)
        it.drives_on(since_us)
        it.pause("obc", 0.06, ABOVE)  # six cycles missed, and the Raptor's patience is ten
        it.until(lambda: it.says("ssm_status", "ssm_worst_fault", FAULTS["executive_late"]), "DEGRADED")
        assert it.says("ssm_status", "ssm_state", lib.SSM_DEGRADED), it.story()
        it.until(lambda: it.says("ssm_status", "ssm_state", lib.SSM_NOMINAL), "NOMINAL")
        it.drives_on(since_us)
        stall_us = 300_000
        fault_us = it.busy(core, stall_us * 1e-6, ABOVE)
        it.until(lambda: all((it.receiver.brakes_since(ecu) or 0) > fault_us for ecu in ECUS), "full brake")
        for ecu in ECUS:
            took_us = (it.receiver.brakes_since(ecu) or 0) - fault_us
            measured.append(Measured("core taken for 300 ms", ecu, stall_us + TICK_US, took_us))
            assert took_us <= measured[-1].deadline_us + ALLOWANCE_US, it.story()
        braking_us = it.run.now_us
        it.until(lambda: it.stands, "standstill")
        it.watch(0.5)
        it.still_brakes(braking_us, *ECUS)
        assert it.stands, it.story()


def seen_or_lost(link: CanLink) -> int:
    """Frames that came to a link, whether it could take them or not."""
    return link.statistics.received + link.statistics.overflows


def test_flooded_bus(tmp_path: Path) -> None:
    """A foreign sender at full speed delays nobody: the hub gives each station its turn, and filters keep the rest out.

    The hub knows no arbitration, so an identifier that wins on copper wins nothing here.
    """
    with car(tmp_path, RealTimeOptions(placement=placement())) as it:
        since_us = it.drive()
        for link in it.run.links:
            if link.bus is Bus.CAN_S:
                continue
            before = seen_or_lost(link)
            sent = it.flood(link.bus, 0.25)
            assert sent > 10_000
            it.until(lambda: seen_or_lost(link) - before >= sent, "the count of what the observer could not take")  # noqa: B023
            it.drives_on(since_us)


def test_second_onboard_computer(tmp_path: Path, measured: list[Measured]) -> None:
    """Two that command the car contradict each other: the one that drives brakes for good, and says so once a bus.

    The second one's frames come just before the first one's, which would overrule them.
    """
    phase_us = PHASES_US["obc"] - 2000
    with car(tmp_path, RealTimeOptions(placement=placement())) as it:
        since_us = it.drive()
        words = it.run.parts["obc"].command_line(it.run.supervisor.epoch_ns)
        words = [word for word in words if not word.startswith(("--cycle-log", "--cycles", "--phase"))]
        second = subprocess.Popen([*words, f"--phase={phase_us}"], stderr=subprocess.PIPE, text=True)
        try:
            it.until(lambda: all((it.receiver.brakes_since(by) or 0) > since_us for by in ("obc", "raptor")), "a brake")
            it.until(lambda: it.says(*SHUT_DOWN) and it.stands, "standstill")
        finally:
            second.terminate()
            complaints = second.communicate()[1].splitlines()
        assert second.returncode == 0
        # The second one, which has just been switched on, begins with a full brake.
        times, brakes = it.receiver.braking("obc")
        fault_us = int(times[(times > since_us) & brakes][0])
        for by in ("obc", "raptor"):
            deadline_us = PHASES_US[by] - phase_us
            measured.append(Measured("second obc", by, deadline_us, (it.receiver.brakes_since(by) or 0) - fault_us))
            assert measured[-1].took_us <= deadline_us + ALLOWANCE_US, it.story()
        it.watch(0.5)
        it.still_brakes(fault_us + ALLOWANCE_US, "obc", "raptor")
        assert FAULTS["second_computer"] in it.receiver.columns("ssm_status")[1]["ssm_worst_fault"]
        assert it.stands, it.story()
        for lines in ([line for name, line in it.lines if name == "obc"], complaints):
            told = re.findall(r"(CAN\w): another station sends \w+ \(\w+\): is a second obc", "\n".join(lines))
            assert told == ["CAN1", "CANA"], lines
