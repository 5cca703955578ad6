"""docs/ssm.md says what the firmware does: states, transitions, reactions, latches, and times measured again here."""

from __future__ import annotations

import itertools
import random
import re
from pathlib import Path
from typing import Any

import pytest
from actuator_ecus import STEERED_BRAKE, Requests, SpaceDrive, car_in
from obc_harness import TICK_US, ObcHarness

from bridge._native import ffi, lib
from dbc.states import CtState, SysState
from firmware.tables import LATCHES, REACTIONS

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE, FAULT_PAGE = ((DOCS / name).read_text() for name in ("ssm.md", "faults.md"))
SSM_STATES = ["BOOT", "CONFIG_CHECK", "LAUNCHING", "NOMINAL", "DEGRADED", "EMERGENCY", "FULL_BRAKE"]

Edges = set[tuple[int, int]]


def section(title: str) -> str:
    return PAGE.split(f"## {title}\n")[1].split("\n## ")[0]


def rows(text: str, header: str) -> list[list[str]]:
    """Cells of the table that begins with this header cell."""
    table = re.search(rf"^\| {header} \|.*\n\| ---.*\n((?:\|.*\n)+)", text, re.MULTILINE)
    assert table, header
    return [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in table[1].splitlines()]


def numbered(cells: list[list[str]]) -> dict[str, int]:
    return {row[0]: int(row[1]) for row in cells}


def test_names_and_numbers() -> None:
    page = numbered(rows(section("States"), "state"))
    assert page == {name: getattr(lib, f"SSM_{name}") for name in SSM_STATES}
    assert list(page) == SSM_STATES
    text = section("Reactions and latches")
    assert list(numbered(rows(text, "reaction"))) == list(REACTIONS)
    assert numbered(rows(text, "reaction")) == {n: getattr(lib, f"FAULT_REACTION_{n.upper()}") for n in REACTIONS}
    assert numbered(rows(text, "latch")) == {n: getattr(lib, f"FAULT_LATCH_{n.upper()}") for n in LATCHES}


def transitions(page: str) -> set[tuple[str, str]]:
    return set(re.findall(r"^    (\w+) --> (\w+)", page, re.MULTILINE))


def test_ssm_diagram_has_every_transition_and_no_other() -> None:
    drawn = transitions(PAGE)
    assert drawn == transitions(FAULT_PAGE)
    generator = random.Random(1)
    done = set()
    for _ in range(300):
        ssm, out, conditions = ffi.new("ssm *"), ffi.new("ssm_output *"), ffi.new("fault_conditions *")
        state = lib.SSM_BOOT
        rate = generator.choice((0.0, 0.002, 0.02))
        for tick in range(150):
            for fault in range(1, lib.FAULT_COUNT):
                conditions.present[fault] = generator.random() < rate and lib.fault_table[fault].debounce_cycles < 4
            verdicts = (lib.PARAMETER_VERDICT_PENDING, lib.PARAMETER_VERDICT_ACCEPTED)
            values = {
                "conditions": conditions,
                "now_us": tick * TICK_US,
                "verdict": generator.choice(verdicts),
                "degraded_allowed": True,
                "launch_wanted": generator.random() < 0.8,
                "driving": generator.random() < 0.5,
                "standing_still": generator.random() < 0.5,
                "wall_followed": generator.random() < 0.5,
            }
            lib.ssm_step(ssm, ffi.new("ssm_input *", values), out)
            if out.state != state:
                done.add((SSM_STATES[state], SSM_STATES[out.state]))
                state = out.state
    assert done == drawn


def edges_of(title: str) -> Edges:
    """(from, to) of a table; `from` may be a list, a span, or all but one."""
    edges: Edges = set()
    for origin, to, _ in rows(section(title), "from"):
        numbers = [int(n) for n in re.findall(r"\d+", origin)]
        if " to " in origin:
            numbers = list(range(numbers[0], numbers[1] + 1))
        elif origin.startswith("any but"):
            numbers = [n for n in (*range(12), 13, 14, 15, 17) if n not in numbers]
        edges |= {(number, int(to.split()[0])) for number in numbers}
    return edges


def test_ct_state_table() -> None:
    edges: Edges = set()
    flags = list(itertools.product((False, True), repeat=5))
    for state, sys_state, track, vehicle in itertools.product(
        (*range(13), 255), (0, 4, 5, 6, 8, 9), range(5), (0, 4, 8)
    ):
        for alive, accepted, nominal, full_brake, standing in flags:
            inputs = (sys_state, track, vehicle, alive, accepted, nominal, full_brake, standing)
            following = lib.ct_state_next(state, ffi.new("ct_input *", inputs))
            if following != state:
                edges.add((state, following))
    assert edges == edges_of("Run-up: ct_state of the onboard computer")


def random_sys_input(generator: random.Random) -> Any:
    def chance(share: float) -> bool:
        return generator.random() < share

    return ffi.new(
        "raptor_sys_input *",
        {
            "subsystems_ready": chance(0.7),
            "emergency": chance(0.05),
            "track_flag_valid": chance(0.9),
            "track_flag": generator.randint(1, 4),
            "ct_state": generator.randrange(13),
            "safety_switch": generator.choice((2, 3, 4, 4, 4, 4)),
            "test_result": generator.randrange(3),
            "crank_conditions": chance(0.7),
            "engine_running": chance(0.5),
            "engine_stopped": chance(0.5),
        },
    )


def test_sys_state_table() -> None:
    generator = random.Random(1)
    edges: Edges = set()
    for _ in range(6000):
        state = generator.choice((*range(12), 13, 14, 15, 16, 17))
        machine = ffi.new("raptor_sys_machine *", {"state": state, "started": True})
        now_us = 0
        for _ in range(6):
            before = machine.state
            now_us += generator.choice((10_000, 1_000_000, 6_000_000))
            lib.raptor_sys_step(machine, ffi.addressof(CONFIG), random_sys_input(generator), now_us)
            if machine.state != before:
                edges.add((before, machine.state))
    assert edges == edges_of("Run-up: sys_state of the Raptor")


CONFIG = ffi.new("raptor_config *", lib.raptor_config_default)[0]


@pytest.mark.parametrize(
    ("title", "states"),
    [("Run-up: ct_state of the onboard computer", CtState), ("Run-up: sys_state of the Raptor", SysState)],
)
def test_names_of_the_run_up(title: str, states: Any) -> None:
    for number, name in re.findall(r"\| (?:any but )?(\d+) ([A-Z_]+) ", section(title)):
        assert states(int(number)).name == name


# --- times ---


def obc_silent(*names: str, walled: bool = True) -> int:
    """Milliseconds from the last frame to the full brake on CAN1."""
    harness = ObcHarness()
    if not walled:
        del harness.periods["wall_line"]
    harness.drive()
    harness.set_speed(20.0)
    harness.run(20)
    while any((harness.now_us - TICK_US) % harness.periods[name] for name in names):
        harness.tick()  # until all of them have just been heard
    for name in names:
        harness.periods.pop(name)
    for ticks in range(1, 60):
        harness.tick()
        if harness.brake_kpa >= 3500 and harness.throttle == 0:
            return ticks * TICK_US // 1000
    raise AssertionError(names)


def raptor_without(name: str, stuck: bool) -> int:
    car = car_in(9)
    car.computer.brake_kpa = 0.0
    car.run(5)
    while name == "ct_report" and car.computer.tick % 5 != 1:
        car.tick()  # until the newest one has just been heard
    (car.computer.stuck if stuck else car.computer.silent).add(name)
    if stuck:
        car.tick()  # the last counter that moves
    for ticks in range(1, 60):
        car.tick()
        if car.c.demand.brake >= STEERED_BRAKE:
            return ticks * TICK_US // 1000
    raise AssertionError(name)


def space_drive_without(axis: int, bad: bool) -> int:
    drive, requests = SpaceDrive(), Requests(brake=0.0)
    for _ in range(20):
        drive.tick(requests.frames())
    assert drive.drive.brake_pressure_demand < STEERED_BRAKE
    for ticks in range(1, 60):
        frames = requests.frames()
        frames[axis] = frames[axis][:16] + bytes(8) if bad else b""
        drive.tick(frames)
        if drive.drive.brake_pressure_demand >= STEERED_BRAKE:
            return ticks * TICK_US // 1000
    raise AssertionError(axis)


def test_measured_times() -> None:
    measured = [int(row[3]) for row in rows(section("Three layers of full brake"), "layer")]
    first = ObcHarness()
    first.tick()
    commands = ("brake_pressure_cmd", "accelerator_cmd", "steering_cmd")
    assert measured[0] == 0
    assert (first.brake_kpa, first.throttle) == (4500, 0)
    assert [
        obc_silent("misc_report"),
        obc_silent("estimate_position", "estimate_motion", "estimate_quality", walled=False),
        obc_silent("wall_line", "estimate_position", "estimate_motion", "estimate_quality"),
    ] == measured[1:4]
    assert {raptor_without(name, stuck=False) for name in commands} == {measured[4]}
    assert {raptor_without(name, stuck=True) for name in commands} == {measured[5]}
    assert raptor_without("ct_report", stuck=False) == measured[6]
    assert {space_drive_without(axis, bad=False) for axis in (0, 1)} == {measured[7]}
    assert {space_drive_without(axis, bad=True) for axis in (0, 1)} == {measured[8]}
