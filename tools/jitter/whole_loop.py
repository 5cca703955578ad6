"""Measures an ECU inside the whole loop: every station a process of its own, for a whole scenario."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace

from bridge.realtime.cycle_log import read_cycle_log
from bridge.realtime.link import CanLink
from bridge.realtime.plant_station import PlantExit
from bridge.realtime.supervisor import Ended
from bridge.scenario import Scenario
from dbc.errors import RaceloopError
from tools.jitter.alone import machine_limit, receiver_notes
from tools.jitter.cyclictest import may_start
from tools.jitter.measurement import Cycles, Measurement
from tools.jitter.receiver import Receiver
from tools.jitter.setup import Setup
from tools.realtime_run import STATIONS, RealTimeRun

#: How long the plant may take beyond the scenario's time limit, us.
_PATIENCE_US = 10_000_000

_PLANT = "plant"


def measure_whole_loop(setup: Setup, scenario: Scenario, condition: str) -> Measurement:
    """Drive a scenario in real time, from power-on to its end.

    Parameters
    ----------
    setup : which ECU, and where; rate and length are the scenario's.
    condition : what else runs, for people.

    Raises
    ------
    RaceloopError
        When a part does not start, or ends before the scenario does.
    """
    with RealTimeRun(scenario, setup.options) as run, ExitStack() as exits:
        run.start()
        epoch_ns = run.supervisor.epoch_ns
        links = [exits.enter_context(CanLink(address, bus, epoch_ns)) for bus, address in run.addresses().items()]
        receiver = Receiver(links)
        beside = None
        test = setup.cyclictest(epoch_ns, run.shared.folder / "cyclictest.json")
        tried = over = False
        while not over:
            if not tried and may_start(now_ns := time.monotonic_ns()):
                tried, beside = True, test.start(now_ns)
                if beside is not None:
                    exits.enter_context(beside)
            for ended in run.poll():
                over = ended.name == _PLANT and ended.status == PlantExit.FINISHED
                if not over:
                    raise RaceloopError(_why(ended, scenario, run.seconds(ended.time_ns)))
            receiver.poll()
            if run.now_us > scenario.time_limit_us + _PATIENCE_US:
                raise RaceloopError(f"{scenario.name} has not ended in time")
        run.finish()
        receiver.poll()
        machine, notes = machine_limit(test, beside)
        logs = {name: read_cycle_log(run.shared.cycle_log(name)) for name in STATIONS}
    # The scenario ends with the plant's last cycle; while the plant's process goes, the others miss their input.
    end_ns = int(logs[_PLANT].records["sent_ns"][-1])
    logs = {name: replace(log, records=log.records[log.records["sent_ns"] <= end_ns]) for name, log in logs.items()}
    frames = receiver.frames()
    return Measurement(
        condition=condition,
        ecu=setup.ecu,
        cycles=Cycles(logs.pop(setup.ecu.name)),
        frames=frames[frames["time_us"] < (end_ns - epoch_ns) // 1000],
        machine=machine,
        stations={name: Cycles(log) for name, log in logs.items()},
        notes=(*notes, *receiver_notes(receiver)),
    )


def _why(ended: Ended, scenario: Scenario, seconds: float) -> str:
    """Why a run that has not finished is over."""
    if ended.name == _PLANT and ended.status in (PlantExit.TIME_UP, PlantExit.REJECTED):
        return f"{scenario.path}: did not come to its finish: {PlantExit(ended.status).name.lower().replace('_', ' ')}"
    return f"{ended} at {seconds:.2f} s"
