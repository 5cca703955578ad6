"""`raceloop dbw check`: everything in a recording or on a bus that is not what the DBC files say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from rich.console import Console

from dbc.codec import Codec, MessageCodec
from tools.dbw.bus_option import bus_of
from tools.dbw.conformance import Conformance
from tools.dbw.counters import CounterMode
from tools.dbw.findings import Finding, Place, Rule
from tools.dbw.source import read_source
from tools.exit_status import ExitStatus
from tools.output_files import write_json, write_text


@dataclass(frozen=True)
class Outputs:
    """What to write besides the findings.

    Attributes
    ----------
    json, junit : files; None for none.
    timing : whether the page has the times between the frames of each message.
    """

    json: Path | None = None
    junit: Path | None = None
    timing: bool = False


def check(
    database: Codec,
    sources: Sequence[str],
    bus: str | None,
    seconds: float | None,
    counter_mode: CounterMode,
    outputs: Outputs,
    console: Console,
) -> int:
    """Check a recording, or buses in use, and print what was found; returns the exit status.

    It is a miss when there is something. For the sources see `tools.dbw.source.read_source`.

    Raises
    ------
    RaceloopError
        When the source cannot be read at all, the bus does not exist, or a file cannot be written.
    """
    chosen = None if bus is None else bus_of(bus)
    conformance = Conformance(database, counter_mode)

    def broken(frame: int, text: str) -> None:
        conformance.note(Place(Rule.BROKEN), 1, frame, 0, text)

    for chunk in read_source(sources, chosen, seconds, broken):
        conformance.update(chunk)
    conformance.finish()
    source = " ".join(sources)
    findings = sorted(conformance.findings.values(), key=lambda finding: finding.first_frame)
    if outputs.json is not None:
        write_json(outputs.json, as_json(source, conformance, findings))
    if outputs.junit is not None:
        write_text(outputs.junit, as_junit(source, conformance, findings))
    _show(source, conformance, findings, outputs.timing, console)
    return ExitStatus.MISSED if findings else ExitStatus.DONE


def _show(source: str, conformance: Conformance, findings: list[Finding], timing: bool, console: Console) -> None:
    """A line per finding, so that other programs can search them."""
    for finding in findings:
        console.print(f"{finding.place.subject}: {_words(finding)}", markup=False)
    if timing:
        for line in _timing_table(conformance):
            console.print(line, markup=False)
    counts = f"{conformance.frames} frames of {len(conformance.timings)} messages"
    console.print(f"{source}: {counts}, {len(findings)} finding{'' if len(findings) == 1 else 's'}", markup=False)


def _words(finding: Finding) -> str:
    frame = f"frame {finding.first_frame} at {finding.first_us * 1e-6:.6f} s"
    times = f"{finding.count} time{'' if finding.count == 1 else 's'}, first in"
    # What never came has no frames, but a beginning.
    where = f"{times} {frame}" if finding.count else f"from {frame} on"
    return f"{finding.place.rule.value}, {where}: {finding.text}"


def _timing_table(conformance: Conformance) -> Iterator[str]:
    """Times between the frames of each message that was seen, in the order of buses and identifiers."""
    seen = [codec for codec in conformance.database if codec.name in conformance.timings]
    width = max((len(codec.name) for codec in seen), default=0)
    columns = ("frames", "cycle", "mean", "jitter", "p99", "longest", "time-outs")
    yield f"{'bus':<5}  {'message':<{width}}  " + "  ".join(f"{name:>9}" for name in columns)
    for codec in seen:
        timing = conformance.timings[codec.name]
        times_us = (_cycle_us(conformance, codec), timing.mean, timing.jitter, timing.percentile(99.0), timing.longest)
        times = "  ".join(f"{time_us / 1000:9.3f}" if time_us else f"{'-':>9}" for time_us in times_us)
        yield (
            f"{codec.bus.label:<5}  {codec.name:<{width}}  {timing.count + 1:9}  {times}"
            f"  {_timeouts(conformance, codec):9}"
        )
    yield "times in ms"


def _cycle_us(conformance: Conformance, codec: MessageCodec) -> float:
    """Nominal time from frame to frame."""
    return codec.cycle_us / conformance.database.facts(codec.name).frames_per_cycle


def _timeouts(conformance: Conformance, codec: MessageCodec) -> int:
    found = conformance.findings.get(Place(Rule.TIMEOUT, codec.bus, codec.name))
    return 0 if found is None else found.count


def as_json(source: str, conformance: Conformance, findings: list[Finding]) -> dict[str, Any]:
    """Findings, and the times between the frames of every message."""
    return {
        "source": source,
        "frames": conformance.frames,
        "findings": [
            {
                "rule": finding.place.rule.value,
                "bus": None if finding.place.bus is None else finding.place.bus.label,
                "message": finding.place.message,
                "signal": finding.place.signal,
                "frames": finding.count,
                "first_frame": finding.first_frame,
                "first_us": finding.first_us,
                "text": finding.text,
            }
            for finding in findings
        ],
        "messages": {
            codec.name: {
                "bus": codec.bus.label,
                "frames": timing.count + 1,
                "cycle_us": codec.cycle_us,
                "mean_us": timing.mean,
                "jitter_us": timing.jitter,
                "p99_us": timing.percentile(99.0),
                "shortest_us": timing.shortest,
                "longest_us": timing.longest,
                "timeouts": _timeouts(conformance, codec),
            }
            for codec, timing in (
                (conformance.database.message(name), one) for name, one in conformance.timings.items()
            )
        },
    }


def as_junit(source: str, conformance: Conformance, findings: list[Finding]) -> str:
    """A test case per message that was seen or has findings; JUnit XML."""
    by_message: dict[str, list[Finding]] = {name: [] for name in conformance.timings}
    for finding in findings:
        by_message.setdefault(finding.place.message or finding.place.subject, []).append(finding)
    failed = sum(bool(found) for found in by_message.values())
    suite = ElementTree.Element("testsuite", name=source, tests=str(len(by_message)), failures=str(failed))
    for name, found in by_message.items():
        case = ElementTree.SubElement(suite, "testcase", classname="dbw", name=name)
        if found:
            lines = [f"{one.place.subject}: {_words(one)}" for one in found]
            ElementTree.SubElement(case, "failure", message=lines[0]).text = "\n".join(lines)
    return ElementTree.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"
