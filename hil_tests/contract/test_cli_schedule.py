"""`raceloop dbw schedule`: what it prints against the analysis, and the bus model with the same messages."""

from __future__ import annotations

import re

import pytest
from simcan_wire import NEVER_NS, Wire

from dbc.buses import Bus
from dbc.codec import database
from tools.cli import main
from tools.dbw.schedule import analyse

MS = 1_000_000


def page(capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, list[str]]:
    status = main(["dbw", "schedule", *options])
    return status, capsys.readouterr().out.splitlines()


def test_page_lists_the_cyclic_messages_by_importance(capsys: pytest.CaptureFixture[str]):
    status, lines = page(capsys)
    cyclic = sorted((codec for codec in database if codec.bus is Bus.CAN1 and codec.cycle_us), key=lambda c: c.frame_id)
    assert [line.split()[0] for line in lines[1:-1]] == [codec.name for codec in cyclic]
    assert [float(line.split()[3]) * 1000 for line in lines[1:-1]] == [codec.cycle_us for codec in cyclic]
    assert status == 1  # the commands, in the worst case
    late = [line.split()[0] for line in lines if line.endswith("late")]
    assert {"steering_cmd", "brake_pressure_cmd", "accelerator_cmd"} <= set(late)
    assert re.search(rf"load [0-9.]+% .*; {len(late)} of {len(cyclic)} do not fit", lines[-1])


def test_everything_at_100_hz_is_more_than_the_bus_has(capsys: pytest.CaptureFixture[str]):
    status, lines = page(capsys, "--all-at", "10")
    assert status == 1
    codecs = [codec for codec in database if codec.bus is Bus.CAN1]
    bits = sum(8 * codec.length + 47 + (34 + 8 * codec.length - 1) // 4 for codec in codecs)
    assert f"load {bits / 5000:.1%}" in lines[-1]
    assert "no bound" in lines[-2]


@pytest.mark.parametrize("bus", ["CAN3", "CAN-A", "CAN-S", "CAN-R"])
def test_other_buses_fit(capsys: pytest.CaptureFixture[str], bus: str):
    status, lines = page(capsys, "--bus", bus)
    assert status == 0
    assert "all are through before their next ones" in lines[-1]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--bus", "CAN2"], "--bus CAN2: no such bus; allowed are CAN1, CAN3, CAN-A, CAN-S, CAN-R"),
        (["--bit-rate", "700001"], "--bit-rate 700001; allowed are divisors of 1000000000 from 1000 to 1000000"),
    ],
)
def test_a_mistake_is_one_line(capsys: pytest.CaptureFixture[str], options: list[str], told: str):
    assert main(["dbw", "schedule", *options]) == 2
    assert capsys.readouterr().err == f"raceloop: {told}\n"


@pytest.mark.parametrize("bus", list(Bus))
def test_bus_with_all_messages_ready_at_once_keeps_and_nears_the_bounds(bus: Bus):
    """The longest data of each message, all queued just after a frame of the least important one has begun."""
    wire = Wire(1_000_000 if bus is Bus.CAN_A else 500_000)
    _, rows = analyse(database, bus, 1_000_000_000 // wire.bit_ns, None)
    sender, _ = wire.join(), wire.join()
    releases = []
    for row in rows:
        frame = wire.frame(row.codec.frame_id, bytes(row.codec.length), flags=int(row.codec.extended))
        for at in range(0 if row is rows[-1] else 1, 40 * MS, row.cycle_ns):
            releases += [(at, frame)] * row.frames
    for at, frame in sorted(releases, key=lambda release: release[0]):
        wire.run(at)
        assert wire.submit(sender, frame, at)
    wire.run(NEVER_NS)
    for row in rows:
        assert row.response_ns is not None
        measured = wire.worst_response_ns(row.codec.frame_id)
        assert measured <= row.response_ns, row.codec.name
        # The least important one had the bus to itself when it began.
        assert measured > 0.7 * row.response_ns or row is rows[-1], row.codec.name
