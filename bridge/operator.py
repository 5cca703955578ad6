"""The operator's station on CAN-A: hands the configuration over, asks for launch, reads the verdict.

A parameter_write carries no CRC. Instead the onboard computer says of each one what it has read, and the operator
compares: a car with another configuration than was sent is not launched.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

from dbc.codec import database
from dbc.frames import FRAME_SIZE, iterate
from firmware.parameters import ACCEPTED, ALTERED

#: launch_request repeats every 100 ms while it is wanted.
LAUNCH_PERIOD_US = 100_000

#: Parameters per tick: what the onboard computer answers in one, so that its queue of results never overflows.
WRITES_PER_TICK = 5


class Verdict(IntEnum):
    """parameter_summary.summary_verdict."""

    PENDING = 0
    ACCEPTED = 1
    REJECTED = 2


_VERDICTS = frozenset(Verdict)


@dataclass(frozen=True)
class ParameterResult:
    """One parameter_result frame: the firmware's verdict on one parameter."""

    key: int
    status: int
    value: int


class OperatorStation:
    """Sends a configuration once, then asks for launch until told otherwise.

    Parameters
    ----------
    parameter_frames : parameter_write frames, closed by parameter_commit; 24 bytes each.

    Attributes
    ----------
    launch_wanted : content of launch_request; False from the moment on that a parameter proves to be altered.
    verdict : of the onboard computer on the whole configuration; REJECTED too when it accepted an altered one.
    verdict_us : when it came; None before.
    offences : parameters that it did not accept, or accepted with another value than was sent.
    """

    def __init__(self, parameter_frames: bytes) -> None:
        self._pending = parameter_frames
        write = database.message("parameter_write")
        self._sent = [write.decode(frame.data) for frame in iterate(parameter_frames) if frame.id == write.frame_id]
        self._launch = database.message("launch_request")
        self._result = database.message("parameter_result")
        self._summary = database.message("parameter_summary")
        self._counter = 0
        self.launch_wanted = True
        self.verdict = Verdict.PENDING
        self.verdict_us: int | None = None
        self.offences: list[ParameterResult] = []

    @property
    def listening(self) -> bool:
        """True until the verdict is in: only then does `tick` look at what was received."""
        return self.verdict is Verdict.PENDING

    def tick(self, now_us: int, frames: bytes) -> bytes:
        """Frames to send in this tick, given those received since the last one."""
        if self.listening:
            self._listen(now_us, frames)
        if self._pending:
            # The commit, which is the last frame, has a tick of its own: every parameter is answered before it is.
            size = max(min(WRITES_PER_TICK * FRAME_SIZE, len(self._pending) - FRAME_SIZE), FRAME_SIZE)
            sent, self._pending = self._pending[:size], self._pending[size:]
            return sent
        if now_us % LAUNCH_PERIOD_US == 0:
            self._counter = (self._counter + 1) & 0xFF
            return self._launch.frame(float(self.launch_wanted), 0, self._counter)
        return b""

    def _listen(self, now_us: int, frames: bytes) -> None:
        for frame in iterate(frames):
            if frame.flags or frame.dlc < 8:
                continue
            if frame.id == self._result.frame_id:
                result = ParameterResult(*(int(value) for value in self._result.decode(frame.data)))
                if result.status == ACCEPTED and not self._was_sent(result):
                    result = replace(result, status=ALTERED)
                    self.launch_wanted = False
                if result.status != ACCEPTED:
                    self.offences.append(result)
            elif frame.id == self._summary.frame_id:
                code = int(self._summary.decode(frame.data)[3])
                self.verdict = Verdict(code) if code in _VERDICTS else Verdict.PENDING
                if self.verdict is Verdict.ACCEPTED and not self.launch_wanted:
                    self.verdict = Verdict.REJECTED
                self.verdict_us = None if self.verdict is Verdict.PENDING else now_us

    def _was_sent(self, result: ParameterResult) -> bool:
        return any((key, value) == (result.key, result.value) for key, _, value in self._sent)
