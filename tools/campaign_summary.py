"""What a campaign has found: the table of its page, JSON and JUnit."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any
from xml.etree import ElementTree

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bridge.campaign.file import Campaign, run_id
from bridge.safety.monitor import properties
from firmware.tables import REACTIONS
from tools.campaign_results import line

_WIDTH = 140
"""Columns of the table: a narrower terminal breaks its lines, and loses nothing."""

_SHOWN = 20
"""Violations on the page; the others are in the file."""


def as_json(campaign: Campaign, results: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Summary of a campaign that is complete."""
    ordered = [results[run_id(fault, onset_us)] for fault in campaign.faults for onset_us in campaign.onsets_us]
    runs = len(campaign.onsets_us)
    broken = [one for one in ordered if _broken(one)]
    return {
        "campaign": campaign.name,
        "scenario": campaign.scenario.name,
        "runs": len(ordered),
        "faults": [
            _of_fault(fault.name, fault.excused, ordered[place * runs : (place + 1) * runs])
            for place, fault in enumerate(campaign.faults)
        ],
        "violations": [
            {"id": one["id"], "violations": _broken(one), "begin": one["begin"], "reaction": one["reaction"]}
            for one in broken
        ],
        "results_sha256": hashlib.sha256(b"".join(sorted(line(one) for one in ordered))).hexdigest(),
    }


def _broken(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [one for one in result["violations"] if not one["excused"]]


def _of_fault(name: str, excused: Mapping[str, str], results: list[dict[str, Any]]) -> dict[str, Any]:
    excursions = [one for one in results if one["excursion_m"] > 0.0]
    violated = [one for one in results if _broken(one)]
    return {
        "fault": name,
        "runs": len(results),
        "without_effect": sum(not one["befallen"] for one in results),
        "reactions": {
            reaction: count for reaction in REACTIONS if (count := sum(one["reaction"] == reaction for one in results))
        },
        **{f"worst_{key}": _worst(one[key] for one in results) for key in ("reaction_ms", "can1_ms", "brake_ms")},
        "violations": len(violated),
        "violated": sorted({one["property"] for result in violated for one in _broken(result)}),
        "excused": dict(excused),
        "excused_runs": sum(any(one["excused"] for one in result["violations"]) for result in results),
        "excursions": len(excursions),
        "worst_excursion_m": _worst(one["excursion_m"] for one in excursions),
        "worst_excursion_id": max(excursions, key=lambda one: float(one["excursion_m"]))["id"] if excursions else None,
    }


def _worst(values: Iterable[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)


def as_junit(summary: Mapping[str, Any]) -> str:
    """A test case per fault; JUnit XML."""
    by_fault: dict[str, list[str]] = {fault["fault"]: [] for fault in summary["faults"]}
    for run in summary["violations"]:
        by_fault[run["id"].rpartition("@")[0]] += [f"{run['id']}: {_words(one)}" for one in run["violations"]]
    failed = sum(bool(found) for found in by_fault.values())
    suite = ElementTree.Element("testsuite", name=summary["campaign"], tests=str(len(by_fault)), failures=str(failed))
    for name, found in by_fault.items():
        case = ElementTree.SubElement(suite, "testcase", classname="campaign", name=name)
        if found:
            ElementTree.SubElement(case, "failure", message=found[0]).text = "\n".join(found)
    return ElementTree.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def show_summary(summary: Mapping[str, Any], again: str, console: Console) -> None:
    """Print the table, and each violation with the command that runs it alone.

    Parameters
    ----------
    again : the command up to the id of the run.
    """
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    table.add_column("fault", no_wrap=True)
    counted = ("runs", "warn", "degr", "switch", "stop", "brake")
    for heading in (*counted, "SSM ms", "CAN1 ms", "line ms", "off m", "broken"):
        table.add_column(heading, justify="right", no_wrap=True)
    for fault in summary["faults"]:
        counts = fault["reactions"]
        table.add_row(
            escape(fault["fault"]),
            str(fault["runs"]),
            *(str(counts.get(reaction, "")) for reaction in REACTIONS[1:]),
            *(_cell(fault[key], ".0f") for key in ("worst_reaction_ms", "worst_can1_ms", "worst_brake_ms")),
            _cell(fault["worst_excursion_m"], ".1f"),
            f"[red]{fault['violations']}[/red]" if fault["violations"] else "",
        )
    Console(file=console.file, width=max(console.width, _WIDTH), highlight=False).print(table)
    console.print()
    idle = [fault["fault"] for fault in summary["faults"] if fault["without_effect"] == fault["runs"]]
    if idle:
        console.print(f"Befell nothing in any run: {', '.join(idle)}", markup=False)
    excursions = sum(fault["excursions"] for fault in summary["faults"])
    worst = _worst(fault["worst_excursion_m"] for fault in summary["faults"])
    if excursions:
        console.print(f"Nobody could steer: {excursions} runs left the track, by {worst:.1f} m at most")
    excused = sum(fault["excused_runs"] for fault in summary["faults"])
    if excused:
        console.print(f"Excused: {excused} runs, in which the fault itself breaks a property; see the campaign file")
    found = [(run["id"], one) for run in summary["violations"] for one in run["violations"]]
    for identifier, one in found[:_SHOWN]:
        console.print(f"[red]{escape(identifier)}[/red]: {escape(_words(one))}")
        console.print(f"  {again} {identifier}", markup=False)
    if len(found) > _SHOWN:
        console.print(f"[red]and {len(found) - _SHOWN} more[/red]")
    for name in sorted({one["property"] for _, one in found}):
        console.print(f"{name}: {escape(properties()[name].text)}")
    state = f"[red]{len(summary['violations'])} of them break a property[/red]" if found else "no property broken"
    faults = len(summary["faults"])
    console.print(f"{summary['runs']} runs of {faults} fault{'s' if faults > 1 else ''}: {state}")
    console.print(f"Results SHA-256\n  {summary['results_sha256']}")


def show_result(result: Mapping[str, Any], console: Console) -> None:
    """Print what came of one run."""
    begin, end = result["begin"], result["end"]
    console.print(f"[bold]{escape(result['id'])}[/bold]: befallen {result['befallen']} times")
    for name, moment in (("at the onset", begin), ("at the end", end)):
        console.print(
            f"{name}: SSM {moment['ssm_state']}, ct_state {moment['ct_state']}, sys_state {moment['sys_state']},"
            f" {moment['speed_kmh']:.1f} km/h, {moment['station_m']:.1f} m along the lap"
        )
    console.print(f"told: {', '.join(result['told']) or 'nothing'}; reaction {result['reaction']}", markup=False)
    times = (("SSM", "reaction_ms"), ("CAN1", "can1_ms"), ("brake line", "brake_ms"))
    console.print("; ".join(f"{name} {_cell(result[key], '.1f') or '-'} ms" for name, key in times))
    if result["excursion_m"] > 0.0:
        console.print(f"Nobody could steer: {result['excursion_m']:.2f} m beyond the edge of the track")
    for one in result["violations"]:
        colour = "yellow" if one["excused"] else "red"
        excused = ", excused" if one["excused"] else ""
        console.print(f"[{colour}]{escape(_words(one))}{excused}[/{colour}]")


def _words(one: Mapping[str, Any]) -> str:
    return f"{one['property']} at {one['time_s']:.3f} s, frame {one['frame']}: {one['seen']}; allowed: {one['allowed']}"


def _cell(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
