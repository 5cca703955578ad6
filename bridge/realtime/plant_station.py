"""The plant as a station: car, road, sensors, operator, race control and safety switch in one process.

Per slot it does what lock step does between two ticks of the ECUs, in the same order: it drives the car by what the
actuator ECUs have put on their wires, steps the FMU to the start of the slot, looks at the car, lets people act, and
hands the sensors' signals to the wires and their frames to CAN-S, the operator's to CAN-A.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any

from bridge.realtime.cloud import CloudSender
from bridge.realtime.truth_file import TruthWriter
from bridge.realtime.wired import Cell, WiredIo
from bridge.scenario import Scenario
from bridge.surroundings import TICK_US, Ending, EndWatch, ReportedStates, Surroundings
from dbc.codec import profile
from dbc.frames import Bus, iterate

#: The plant catches up with slots that passed while it was late, up to this far; beyond, the car stands still for them.
CATCH_UP_US = 200_000

#: Outputs that the Raptor has not refreshed for so long fall off.
FALL_OFF_US = 50_000


class PlantExit(IntEnum):
    """Exit status of the plant's process."""

    STOPPED = 0
    """It was asked to stop."""
    USER_ERROR = 2
    """A mistake in what was given; also argparse's."""
    FINISHED = 10
    """The scenario's finish was reached."""
    TIME_UP = 11
    """The scenario's time limit was reached."""
    REJECTED = 12
    """The onboard computer has rejected the configuration."""


_EXITS = {Ending.FINISHED: PlantExit.FINISHED, Ending.TIME_UP: PlantExit.TIME_UP, Ending.REJECTED: PlantExit.REJECTED}


class PlantStation:
    """Steps the surroundings of the ECUs by slots.

    Simulated time is never skipped while it can be helped: slots that passed while the station was late are stepped
    at once, one after the other, and their frames go out together. After more than `CATCH_UP_US` it gives up: the
    car has stood still meanwhile, and one line says for how long.

    The Raptor's outputs have a watchdog, as its hardware has: when they were not refreshed for `FALL_OFF_US` they fall
    off as without power, throttle closed, ignition and starter off. The Space Drive's motors stay where they are.

    Parameters
    ----------
    surroundings : of the ECUs, made from the scenario.
    scenario : how the run ends.
    wires : to the actuator ECUs.
    truth : gets the plant's outputs once per slot.
    say : takes a line for people.
    clouds : takes the LiDARs' points; None for a car without LiDARs.

    Attributes
    ----------
    ending : why the run ended by itself; None while it goes on.
    simulated_us : by how much the FMU was stepped.
    caught_up : slots that were stepped late.
    lost_us : simulated time given up.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        scenario: Scenario,
        wires: WiredIo,
        truth: TruthWriter | None = None,
        say: Callable[[str], None] = lambda _line: None,
        clouds: CloudSender | None = None,
    ) -> None:
        self.surroundings = surroundings
        self.ending: Ending | None = None
        self.simulated_us = 0
        self.caught_up = 0
        self.lost_us = 0
        self._wires = wires
        self._truth = truth
        self._say = say
        self._clouds = clouds
        self._watch = EndWatch(scenario.finish, scenario.time_limit_us)
        self._states = ReportedStates(profile(scenario.profile))
        self._misc_data = self._ct_data = bytes(8)
        self._now_us: int | None = None
        self._raptor_written_ns = 0
        self._raptor_us = -FALL_OFF_US

    @property
    def over(self) -> bool:
        """True when the run has ended by itself."""
        return self.ending is not None

    def step(self, now_us: int, received: bytes) -> bytes:
        """Bring the car to `now_us`, see `bridge.realtime.station.Station`.

        Parameters
        ----------
        received : frames of CAN1 and CAN-A; others are ignored.

        Returns
        -------
        bytes
            Frames for CAN-S, CAN-A and CAN-R.
        """
        for_operator = self._sort(received)
        self._read_wires(now_us)
        frames = b""
        for slot_us in range(self._first_slot(now_us), now_us + 1, TICK_US):
            frames += self._slot(slot_us, for_operator)
            for_operator = b""
            if self.over:
                return frames
        wiring = self.surroundings.wiring
        self._wires.write(Cell.RAPTOR_IN, wiring.raptor_in)
        self._wires.write(Cell.SPACE_DRIVE_IN, wiring.space_drive_in)
        return frames

    def end(self) -> bytes:
        """No frames: sensors fall silent without a word."""
        return b""

    @property
    def exit_status(self) -> PlantExit:
        """Status for whoever started the process."""
        return PlantExit.STOPPED if self.ending is None else _EXITS[self.ending]

    def report(self) -> dict[str, Any]:
        """What became of the run, as plain data."""
        surroundings = self.surroundings
        operator = surroundings.operator
        return {
            "finished": self.ending is Ending.FINISHED,
            "reason": "stopped" if self.ending is None else self.ending.value,
            "simulated_s": self.simulated_us * 1e-6,
            "laps_s": surroundings.laps.laps_s,
            "verdict": operator.verdict.name,
            "offences": [[offence.key, offence.status, offence.value] for offence in operator.offences],
            "caught_up_slots": self.caught_up,
            "lost_ms": self.lost_us // 1000,
            "scans_lost": 0 if self._clouds is None else self._clouds.lost,
        }

    def _sort(self, received: bytes) -> bytes:
        """Keep the states of CAN1; returns the frames of CAN-A."""
        misc, report = self._states.misc_report, self._states.ct_report
        for_operator = b""
        for frame in iterate(received):
            if frame.bus == Bus.CAN_A:
                for_operator += frame.pack()
            elif frame.bus == Bus.CAN1 and frame.flags == 0:
                if (frame.id, frame.dlc) == (misc.frame_id, misc.length):
                    self._misc_data = frame.data
                elif (frame.id, frame.dlc) == (report.frame_id, report.length):
                    self._ct_data = frame.data
        return for_operator

    def _read_wires(self, now_us: int) -> None:
        wiring = self.surroundings.wiring
        written_ns = self._wires.read(Cell.RAPTOR_OUT, wiring.raptor_out)
        if written_ns not in (0, self._raptor_written_ns):
            self._raptor_written_ns, self._raptor_us = written_ns, now_us
        elif now_us - self._raptor_us >= FALL_OFF_US:
            wiring.release_raptor()
        self._wires.read(Cell.SPACE_DRIVE_OUT, wiring.space_drive_out)

    def _first_slot(self, now_us: int) -> int:
        """The slot to begin with: the next one, unless that lies too far back."""
        if self._now_us is None:
            return now_us
        late_us = now_us - self._now_us - TICK_US
        if late_us > CATCH_UP_US:
            self.lost_us += late_us
            self._say(f"lost {late_us // 1000} ms of simulated time")
            return now_us
        self.caught_up += late_us // TICK_US
        return now_us - late_us

    def _slot(self, now_us: int, for_operator: bytes) -> bytes:
        surroundings = self.surroundings
        if self._now_us is not None:
            surroundings.advance(self.simulated_us * 1e-6)
            self.simulated_us += TICK_US
        self._now_us = now_us
        surroundings.observe(now_us, *self._states.decode(self._misc_data, self._ct_data))
        if self._truth is not None:
            self._truth.add(now_us, surroundings.plant.outputs)
        self.ending = self._watch.update(surroundings)
        if self.ending is not None:
            return b""
        surroundings.act()
        if self._clouds is not None and (cloud := surroundings.scan(now_us)) is not None:
            self._clouds.send(now_us, cloud)
        return surroundings.sense(now_us) + surroundings.operator.tick(now_us, for_operator)
