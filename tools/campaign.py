"""`raceloop campaign`: every fault of a list at every onset of a grid, on all cores, to be interrupted at any time."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from rich.console import Console

import scenarios
from bridge.campaign.driver import CampaignDriver
from bridge.campaign.file import Campaign, CampaignFault, load_campaign, run_id
from bridge.observed_bench import ObservedBench
from dbc.errors import ConfigurationError, RaceloopError
from tools.campaign_results import ResultFile
from tools.campaign_summary import as_json, as_junit, show_result, show_summary
from tools.exit_status import ExitStatus
from tools.output_files import write_json, write_text
from tools.progress import ProgressBar
from tools.run import SUMMARY, load_road, make_autonomy, make_folder, refused, run_summary
from tools.stop_signal import asked_to_stop_is_ctrl_c
from tools.summary import show_summary as show_run
from tools.summary import write_summary


@dataclass(frozen=True)
class Options:
    """What the command was given.

    Attributes
    ----------
    out : folder of the results; of the recording with `only`. None with `only` for no recording.
    workers : processes; None for one per core.
    only : id of a run to do alone.
    restart : begin anew, whatever there is.
    json, junit : files of the summary; None for none.
    """

    out: Path | None = None
    workers: int | None = None
    only: str | None = None
    restart: bool = False
    json: Path | None = None
    junit: Path | None = None


def find_campaign(name: str) -> Path:
    """A campaign by its path, or by the name of one that comes with raceloop.

    Raises
    ------
    ConfigurationError
        When there is neither.
    """
    path = Path(name)
    if path.exists():
        return path
    folder = scenarios.DIRECTORY / "campaigns"
    shipped = folder / f"{name}.yaml"
    if shipped.exists():
        return shipped
    raise ConfigurationError(name, "", f"no such campaign file; those that are shipped are in {folder}")


def campaign(name: str, options: Options, console: Console) -> int:
    """Run a campaign, or what is left of it, and sum it up; returns the exit status.

    Raises
    ------
    RaceloopError
        When a file is wrong or cannot be written, the results there are of something else, or a worker has died.
    """
    plan = load_campaign(find_campaign(name))
    if options.only is not None:
        return _run_alone(plan, options.only, options.out, console)
    folder = options.out or Path("out")
    make_folder(folder)
    with ResultFile.opened(folder, plan, options.restart) as results:
        begun, had = time.monotonic(), len(results.by_id)
        interrupted = _complete(plan, results, options.workers or _cores(), console)
        spent_s = time.monotonic() - begun
    if interrupted:
        left = plan.count - len(results.by_id)
        console.print(f"Interrupted: {left} of {plan.count} runs are left; the same command goes on", markup=False)
        return ExitStatus.INTERRUPTED
    summary = as_json(plan, results.by_id)
    if options.json is not None:
        write_json(options.json, summary)
    if options.junit is not None:
        write_text(options.junit, as_junit(summary))
    console.print(f"{plan.name}: {plan.count - had} runs in {spent_s:.0f} s, {had} were there", markup=False)
    show_summary(summary, f"raceloop campaign {name} --only", console)
    console.print(f"Results in {results.path}", markup=False)
    return ExitStatus.MISSED if summary["violations"] else ExitStatus.DONE


def _run_alone(plan: Campaign, only: str, out: Path | None, console: Console) -> int:
    fault, onset_us = plan.find(only)
    with _bench(plan) as bench:
        if out is not None:
            make_folder(out)
        driver = CampaignDriver(plan, bench, out or Path())
        begun = time.perf_counter()
        driver.drive_to(onset_us)
        result = driver.inject(fault)
        loop_s = time.perf_counter() - begun
        if out is not None:
            with console.status("Completing the recording"):
                recording = bench.finish()
            assert recording is not None
            whole_s = time.perf_counter() - begun
            summary = run_summary(bench, recording, False, refused(bench), loop_s, whole_s, out)
            write_summary(summary, out / SUMMARY)
            show_run(summary, console)
    show_result(result, console)
    return ExitStatus.MISSED if any(not one["excused"] for one in result["violations"]) else ExitStatus.DONE


@contextmanager
def _bench(plan: Campaign) -> Iterator[ObservedBench]:
    scenario = plan.scenario
    with ObservedBench.from_scenario(scenario, partial(load_road, scenario), make_autonomy) as bench:
        yield bench


def _cores() -> int:
    return len(os.sched_getaffinity(0))


# --- workers


def _missing(plan: Campaign, known: Mapping[str, Any]) -> dict[int, list[CampaignFault]]:
    """Faults that are yet to be run, by onset."""
    left = {
        onset_us: [fault for fault in plan.faults if run_id(fault, onset_us) not in known]
        for onset_us in plan.onsets_us
    }
    return {onset_us: faults for onset_us, faults in left.items() if faults}


def _complete(plan: Campaign, results: ResultFile, workers: int, console: Console) -> bool:
    """Do the runs that are missing; returns whether it was interrupted."""
    left = _missing(plan, results.by_id)
    onsets = list(left)
    count = min(workers, len(onsets))
    shares = [{onset_us: left[onset_us] for onset_us in onsets[number::count]} for number in range(count)]
    interrupted = False
    context = get_context("spawn")
    processes, ends = [], []
    try:
        with asked_to_stop_is_ctrl_c(), ProgressBar(console, plan.name, plan.count) as bar:
            for share in shares:
                mine, theirs = context.Pipe(duplex=False)
                names = {onset_us: [fault.name for fault in faults] for onset_us, faults in share.items()}
                process = context.Process(target=_work, args=(plan.path, names, theirs), daemon=True)
                process.start()
                theirs.close()
                processes.append(process)
                ends.append(mine)
            _collect(plan, results, ends, bar)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        for process in processes:
            process.kill()
            process.join()
    return interrupted


def _collect(plan: Campaign, results: ResultFile, ends: list[Connection], bar: ProgressBar) -> None:
    open_ends = list(ends)
    while open_ends:
        for end in wait(open_ends):
            assert isinstance(end, Connection)
            try:
                result = end.recv()
            except EOFError:
                raise RaceloopError(f"a worker has died; {len(results.by_id)} runs are in {results.path}") from None
            if result is None:
                open_ends.remove(end)
            elif isinstance(result, str):
                raise RaceloopError(result)
            else:
                results.add(result)
                bar.show(len(results.by_id), f"{len(results.by_id)} of {plan.count} runs")


def _work(path: Path, share: Mapping[int, list[str]], end: Connection) -> None:
    """One worker: results of its runs, one after the other, then None; a text when it cannot go on."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for whoever collects; without him, the pipe breaks
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        plan = load_campaign(path)
        faults = {fault.name: fault for fault in plan.faults}
        with _bench(plan) as bench:
            driver = CampaignDriver(plan, bench)
            for onset_us, names in share.items():
                for result in driver.run(onset_us, [faults[name] for name in names]):
                    end.send(result)
        end.send(None)
    except RaceloopError as error:
        end.send(str(error))
    except BrokenPipeError:
        pass
