"""Communication faults on the configuration that the operator hands to the onboard computer, frame by frame.

parameter_write and parameter_commit come once and carry neither counter nor CRC. What protects them is the number of
writes and the schema's hash in the commit, the rules for each parameter, and the operator, who compares what the
onboard computer says it has read with what was sent.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from e2e_faults import unpack, with_bit_flipped
from obc_harness import OPERATION, TICK_US, Outbox, cast_frames

from bridge._native import ffi, lib
from bridge.operator import OperatorStation, Verdict
from dbc.codec import database
from dbc.frames import FRAME_SIZE, Bus, iterate
from firmware.parameters import ALTERED, parameter_frames

FRAMES = parameter_frames(OPERATION)
SENT = [FRAMES[i : i + FRAME_SIZE] for i in range(0, len(FRAMES), FRAME_SIZE)]
WRITES, COMMIT = SENT[:-1], SENT[-1]


def heard_at_once(frames: list[bytes]) -> Any:
    """An onboard computer after one tick with these frames."""
    obc, outbox = ffi.new("obc *"), Outbox()
    lib.obc_init(obc)
    array, count = cast_frames(b"".join(frames))
    lib.obc_tick(obc, 0, array, count, outbox.c)
    return obc


def verdict(frames: list[bytes]) -> Verdict:
    return Verdict(heard_at_once(frames).parameters.verdict)


def in_force(obc: Any) -> bytes:
    return bytes(ffi.buffer(obc.parameters.active))


def handed_over(change: Callable[[bytes], bytes]) -> OperatorStation:
    """The operator and an onboard computer after all is said; every parameter frame goes through `change`."""
    operator, obc, outbox = OperatorStation(FRAMES), ffi.new("obc *"), Outbox()
    lib.obc_init(obc)
    said = b""
    for tick in range(30):
        sent = operator.tick(tick * TICK_US, said)
        frames = b"".join(change(sent[i : i + FRAME_SIZE]) for i in range(0, len(sent), FRAME_SIZE))
        array, count = cast_frames(frames)
        lib.obc_tick(obc, tick * TICK_US, array, count, outbox.c)
        said = b"".join(frame.pack() for frame in iterate(outbox.take()) if frame.bus == Bus.CAN_A)
    return operator


def test_without_a_fault_it_is_accepted_and_the_launch_wanted() -> None:
    operator = handed_over(lambda frame: frame)
    assert (operator.verdict, operator.launch_wanted, operator.offences) == (Verdict.ACCEPTED, True, [])
    assert verdict(SENT) is Verdict.ACCEPTED


def test_loss() -> None:
    for index in range(len(WRITES)):
        assert verdict([*WRITES[:index], *WRITES[index + 1 :], COMMIT]) is Verdict.REJECTED
    assert verdict(WRITES) is Verdict.PENDING, "no commit, no driving"


def test_repetition() -> None:
    for frame in WRITES:
        assert verdict([*WRITES, frame, COMMIT]) is Verdict.REJECTED
    once, twice = heard_at_once(SENT), heard_at_once([*SENT, COMMIT, *WRITES[:3]])
    assert in_force(once) == in_force(twice), "what comes after the verdict changes nothing"
    assert (twice.parameters.verdict, twice.parameters.late) == (Verdict.ACCEPTED, 4)


def test_insertion() -> None:
    """A write of a parameter that nobody knows, and of one that everybody knows; before and after the verdict."""
    stranger = database.message("parameter_write").frame(0xFFFFFF, 1, 0)
    known = with_bit_flipped(WRITES[0], 40)
    for frame in (stranger, known):
        assert verdict([*WRITES, frame, COMMIT]) is Verdict.REJECTED
        late = heard_at_once([*SENT, frame])
        assert in_force(late) == in_force(heard_at_once(SENT))
        assert late.conditions.present[lib.FAULT_PARAMETER_WRITE_LATE]


def test_wrong_sequence() -> None:
    backwards = heard_at_once([*WRITES[::-1], COMMIT])
    assert backwards.parameters.verdict == Verdict.ACCEPTED, "the order of the writes says nothing"
    assert in_force(backwards) == in_force(heard_at_once(SENT))
    assert verdict([*WRITES[:-1], COMMIT, WRITES[-1]]) is Verdict.REJECTED


def test_wrong_address_and_frames_that_are_no_data() -> None:
    for fields in ({"bus": Bus.CAN1}, {"flags": 1}, {"flags": 2}, {"flags": 4}, {"dlc": 7}):
        for index in (0, len(WRITES) - 1):
            altered = unpack(WRITES[index])._replace(**fields).pack()  # type: ignore[arg-type]
            assert verdict([*WRITES[:index], altered, *WRITES[index + 1 :], COMMIT]) is Verdict.REJECTED
        no_commit = unpack(COMMIT)._replace(**fields).pack()  # type: ignore[arg-type]
        assert verdict([*WRITES, no_commit]) is Verdict.PENDING


@pytest.mark.parametrize("bit", range(48))
def test_corruption_of_the_commit(bit: int) -> None:
    assert verdict([*WRITES, with_bit_flipped(COMMIT, bit)]) is Verdict.REJECTED


@pytest.mark.parametrize("index", range(len(WRITES)), ids=lambda index: f"write {index}")
def test_corruption_of_a_write(index: int) -> None:
    """Each bit alone. The rules refuse most; what they let pass the operator notices, and does not launch."""
    accepted = 0
    for bit in range(64):
        altered = with_bit_flipped(WRITES[index], bit)
        if verdict([*WRITES[:index], altered, *WRITES[index + 1 :], COMMIT]) is Verdict.REJECTED:
            continue
        accepted += 1
        assert bit >= 32, "keys and types do not pass"
        operator = handed_over(lambda frame, altered=altered: altered if frame == WRITES[index] else frame)  # type: ignore[misc]
        assert (operator.verdict, operator.launch_wanted) == (Verdict.REJECTED, False), bit
        assert [offence.status for offence in operator.offences] == [ALTERED]
    assert accepted < 32


def test_masquerade_with_a_whole_configuration_of_its_own() -> None:
    """Whoever commits first is obeyed, but the true operator, who hears it, does not launch the car."""
    key = int(database.message("parameter_write").decode(unpack(WRITES[0]).data)[0])
    other = with_bit_flipped(WRITES[0], 32 + 16)
    assert verdict([other, *WRITES[1:], COMMIT]) is Verdict.ACCEPTED
    forged = {frame: frame for frame in WRITES} | {WRITES[0]: other}
    operator = handed_over(lambda frame: forged.get(frame, frame))
    assert [(offence.key, offence.status) for offence in operator.offences] == [(key, ALTERED)]
    assert not operator.launch_wanted


def test_the_launch_that_is_withheld_is_told_in_the_frame() -> None:
    altered = with_bit_flipped(WRITES[0], 32 + 16)
    operator = handed_over(lambda frame: altered if frame == WRITES[0] else frame)
    (request,) = iterate(operator.tick(300_000, b""))
    assert database.message("launch_request").decode(request.data)[0] == 0
