"""Drives the reference of a campaign, and from it every run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge.campaign.file import Campaign, CampaignFault, run_id
from bridge.faults.injector import Injection
from bridge.observed_bench import ObservedBench
from bridge.safety.monitor import Violation
from bridge.safety.track import TrackEdges
from dbc.codec import profile
from dbc.errors import RaceloopError
from dbc.frames import FRAME_DTYPE
from dbc.states import CtState, SysState
from firmware.tables import REACTIONS, own_faults

#: The brake has risen when the front line has so much more than at the onset, Pa.
BRAKE_RISE_PA = 500_000.0

#: Of the log before an onset, so much tells what was said before: longer than any cycle of a message looked at.
_BEFORE_US = 300_000

_SHUTDOWNS = (
    SysState.EMERGENCY_SHUTDOWN,
    SysState.ACT_TEST_FAIL,
    SysState.CRANK_CHECKS_FAIL,
    SysState.ENG_FAILED_TO_START,
)


class CampaignDriver:
    """Drives the reference once, and every run from it.

    Parameters
    ----------
    campaign : what to run.
    bench : at power-on, of the campaign's scenario.
    folder : where `bench.finish` writes the recording of a single run.
    """

    def __init__(self, campaign: Campaign, bench: ObservedBench, folder: Path = Path()) -> None:
        self._campaign = campaign
        self._bench = bench
        bench.keep_log(folder)
        self._edges = TrackEdges(*bench.surroundings.road.boundaries())

    def run(self, onset_us: int, faults: Iterable[CampaignFault]) -> Iterator[dict[str, Any]]:
        """Results of the runs of some faults from one onset on, which is not before that of the last call.

        Raises
        ------
        RaceloopError
            When the reference drive breaks a safety property by itself.
        """
        bench = self._bench
        self.drive_to(onset_us)
        bench.log.forget(onset_us - _BEFORE_US)
        state = bench.save()
        for fault in faults:
            bench.restore(state)
            yield self.inject(fault)
        bench.restore(state)

    def drive_to(self, onset_us: int) -> None:
        """Go on with the reference."""
        bench = self._bench
        while bench.now_us < onset_us:
            bench.tick()
        bench.drain()
        bench.safety.look()
        if bench.safety.violations:
            raise RaceloopError(f"{self._campaign.scenario.path}: the drive by itself: {bench.safety.violations[0]}")

    def inject(self, fault: CampaignFault) -> dict[str, Any]:
        """Run one fault from here on, and say what came of it."""
        bench = self._bench
        onset_us, events = bench.now_us, len(bench.monitor.faults)
        begin = _Moment.of(bench, self._edges)
        injections = [bench.inject(plan) for plan in fault.plans]
        end_us = onset_us + max(fault.watch_us, self._campaign.onsets_us[onset_us])
        while bench.now_us < end_us:
            bench.tick()
        bench.drain()
        bench.safety.finish()
        first_us = min((one.first_us for one in injections if one.first_us is not None), default=None)
        trace = _Trace(bench, onset_us, injections)
        reaction, told_us = _reaction(bench, events)
        return {
            "id": run_id(fault, onset_us),
            "fault": fault.name,
            "onset_s": onset_us * 1e-6,
            "begin": begin.content,
            "befallen": sum(one.count for one in injections),
            "told": _told(bench, events),
            "reaction": reaction,
            "reaction_ms": _since_ms(told_us, first_us),
            "can1_ms": _since_ms(trace.can1_us(first_us), first_us),
            "brake_ms": _since_ms(trace.brake_us(first_us), first_us),
            "violations": [_violation(one, fault) for one in bench.safety.violations],
            "excursion_m": bench.safety.excursion_m,
            "end": _Moment.of(bench, self._edges).content,
        }


@dataclass(frozen=True)
class _Moment:
    """Where the car is, and in which states."""

    content: Mapping[str, Any]

    @classmethod
    def of(cls, bench: ObservedBench, edges: TrackEdges) -> _Moment:
        now, truth = bench.situation, bench.truth
        beyond = edges.beyond(np.array([truth.x]), np.array([truth.y]))
        return cls(
            {
                "sys_state": _name(SysState, now.sys_state),
                "ct_state": _name(CtState, now.ct_state),
                "ssm_state": bench.monitor.state("ssm"),
                "speed_kmh": round(truth.vx * 3.6, 3),
                "lateral_mps2": round(truth.vx * truth.yaw_rate, 3),
                "station_m": round(bench.station, 2),
                "beyond_edge_m": round(float(beyond[0]), 3),
            }
        )


class _Trace:
    """Frames and truth of one run, and what was shortly before it."""

    def __init__(self, bench: ObservedBench, onset_us: int, injections: Iterable[Injection]) -> None:
        self._database = profile(bench.scenario.profile)
        frames: NDArray[np.void] = np.concatenate([np.empty(0, FRAME_DTYPE), *bench.log.frames])
        self._frames = frames[frames["time_us"] >= max(onset_us - _BEFORE_US, 0)]
        self._truth = [row for row in bench.log.truth if row[0] >= onset_us]
        self._full_kpa = bench.safety.limits.steered_brake_kpa
        self._front = bench.plant.output_names.index("brake_pressure_front")
        altered = {getattr(one.fault, "message", None) for one in injections}
        self._wanted = [name for name in ("brake_pressure_cmd", "ct_report", "misc_report") if name not in altered]

    def can1_us(self, since_us: int | None) -> int | None:
        """When CAN1 first says full brake or shutdown, which it did not say before; of what the fault left alone."""
        if since_us is None:
            return None
        return min(filter(None, (self._onset(name, since_us) for name in self._wanted)), default=None)

    def _onset(self, name: str, since_us: int) -> int | None:
        codec = self._database.message(name)
        frames = self._frames[(self._frames["id"] == codec.frame_id) & (self._frames["bus"] == codec.bus)]
        values = dict(zip(codec.signals, codec.columns(frames), strict=True))
        says: NDArray[np.bool_]
        if name == "ct_report":
            says = values["ct_state"] == CtState.EMRG_SHUTDOWN
        elif name == "misc_report":
            says = np.isin(values["sys_state"], _SHUTDOWNS)
        else:
            signal = next(signal for signal in codec.signals if signal.endswith("brake_pressure_cmd"))
            says = values[signal] >= self._full_kpa - 1.0
        rises = says & ~np.concatenate((says[:1], says[:-1])) & (frames["time_us"] >= since_us)
        return int(frames["time_us"][rises.argmax()]) if rises.any() else None

    def brake_us(self, since_us: int | None) -> int | None:
        """When the front brake line has risen."""
        if since_us is None or not self._truth:
            return None
        times = np.array([time_us for time_us, _ in self._truth])
        pressure = np.array([outputs[self._front] for _, outputs in self._truth])
        risen = (times >= since_us) & (pressure > pressure[0] + BRAKE_RISE_PA)
        return int(times[risen.argmax()]) if risen.any() else None


def _reaction(bench: ObservedBench, since: int) -> tuple[str, int | None]:
    """The most severe reaction of the SSM to faults told since then, and when it was first told."""
    events = [event for event in bench.monitor.faults[since:] if event.active]
    if not events:
        return REACTIONS[0], None
    worst = max(event.reaction for event in events)
    name = REACTIONS[worst] if worst < len(REACTIONS) else str(worst)
    return name, min(event.time_us for event in events if event.reaction == worst)


def _told(bench: ObservedBench, since: int) -> list[str]:
    """Names of the faults told since then, in order."""
    names = {fault.id: fault.name for fault in own_faults()}
    active = (event.fault_id for event in bench.monitor.faults[since:] if event.active)
    return [names.get(number, str(number)) for number in dict.fromkeys(active)]


def _violation(one: Violation, fault: CampaignFault) -> dict[str, Any]:
    return {
        "property": one.property_id,
        "time_s": one.time_us * 1e-6,
        "frame": one.frame,
        "seen": one.seen,
        "allowed": one.allowed,
        "excused": one.property_id in fault.excused,
    }


def _since_ms(time_us: int | None, since_us: int | None) -> float | None:
    return None if time_us is None or since_us is None else (time_us - since_us) / 1000.0


def _name(states: type[SysState] | type[CtState], code: int) -> str:
    return states(code).name if code in states._value2member_map_ else str(code)
