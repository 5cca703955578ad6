"""Fault campaigns: every fault of a list, at every onset of a grid, each from the saved state of one reference drive.

A campaign is a YAML file, checked against ``bridge/schemas/campaign.schema.json``; docs/campaign.md tells its keys.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from bridge import _native
from bridge.condition import microseconds
from bridge.faults.plan import FaultPlan
from bridge.faults.provocations import LAYERS, Duration, Provoker, load_provocations
from bridge.faults.reading import fault_schema, read_faults
from bridge.safety.monitor import properties
from bridge.scenario import Scenario, load_scenario
from bridge.surroundings import TICK_US
from bridge.yaml_file import check_schema, read_yaml
from dbc import _codec
from dbc.codec import Codec, profile
from dbc.errors import ConfigurationError
from plant_fmu import fmu_path


@dataclass(frozen=True)
class CampaignFault:
    """One fault of a campaign.

    Attributes
    ----------
    name : unique in the campaign.
    plans : what is injected, all at the onset.
    watch_us : how long the run goes on after it.
    excused : ids of safety properties that the fault breaks by itself, with the reason.
    """

    name: str
    plans: tuple[FaultPlan, ...]
    watch_us: int
    excused: Mapping[str, str]


@dataclass(frozen=True)
class Campaign:
    """Faults by onsets.

    Attributes
    ----------
    path, name : of the campaign.
    scenario : the reference drive.
    faults : in the order of the file.
    onsets_us : ascending, whole ticks; by each how long its runs go on at least, us.
    sources : all files that it was read from.
    """

    path: Path
    name: str
    scenario: Scenario
    faults: tuple[CampaignFault, ...]
    onsets_us: Mapping[int, int]
    sources: tuple[Path, ...]

    @property
    def count(self) -> int:
        """Runs."""
        return len(self.faults) * len(self.onsets_us)

    def find(self, run_id: str) -> tuple[CampaignFault, int]:
        """Fault and onset of one run, us.

        Raises
        ------
        ConfigurationError
            When it is none of the campaign's.
        """
        name, _, onset = run_id.rpartition("@")
        fault = next((fault for fault in self.faults if fault.name == name), None)
        if fault is None:
            raise ConfigurationError(self.path, "faults", f"there is none for run {run_id!r}; a run is FAULT@ONSET_MS")
        if not onset.isdecimal() or int(onset) * 1000 not in self.onsets_us:
            raise ConfigurationError(self.path, "onsets", f"none is {onset!r} ms; a run is FAULT@ONSET_MS")
        return fault, int(onset) * 1000

    def inputs(self) -> list[Path]:
        """Files that the results follow from: those of the campaign, code, libraries and FMUs."""
        root = Path(__file__).resolve().parents[2]
        code = (
            path
            for package in ("autonomy", "bridge", "dbc", "firmware", "plant_fmu", "tools")
            for path in sorted((root / package).rglob("*"))
            if path.suffix in (".py", ".dbc", ".yaml", ".json")
        )
        scenario = self.scenario
        fmu = scenario.fmu or fmu_path(scenario.fmi_version)
        libraries = (Path(_native.__file__), Path(_codec.__file__))
        return [*self.sources, scenario.track, scenario.vehicle, scenario.operation, fmu, *libraries, *code]

    def fingerprint(self) -> str:
        """SHA-256 over the contents of `inputs`."""
        digest = hashlib.sha256()
        for path in self.inputs():
            digest.update(hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()


def run_id(fault: CampaignFault, onset_us: int) -> str:
    """What a run is called."""
    return f"{fault.name}@{onset_us // 1000}"


def load_campaign(path: Path) -> Campaign:
    """Read and check a campaign file and what it names.

    Raises
    ------
    ConfigurationError
        With file, key, what is wrong and what is allowed: the first offence.
    """
    content = read_yaml(path)
    check_schema(path, content, _schema())
    scenario_path = _beside(path, content["scenario"], "scenario")
    scenario = load_scenario(scenario_path)
    if scenario.faults:
        raise ConfigurationError(path, "scenario", f"{content['scenario']} injects faults; the reference must not")
    database = profile(scenario.profile)
    watch_us = microseconds(content["watch_s"])
    faults = [
        CampaignFault(
            name,
            _plans(path, f"faults.{name}", entry["faults"], database),
            microseconds(entry["watch_s"]) if "watch_s" in entry else watch_us,
            _excused(path, f"faults.{name}.excused", entry.get("excused", {})),
        )
        for name, entry in content.get("faults", {}).items()
    ]
    sources = [path, scenario_path]
    if "provocations" in content:
        provocations = _beside(path, content["provocations"]["file"], "provocations.file")
        sources.append(provocations)
        faults += _provoked(path, provocations, content["provocations"], scenario, watch_us)
    names = [fault.name for fault in faults]
    for name in names:
        if names.count(name) > 1:
            raise ConfigurationError(path, f"faults.{name}", "is in the file of provocations too; needs another name")
    if not faults:
        raise ConfigurationError(path, "faults", "is missing; there must be faults or provocations")
    return Campaign(path, content["name"], scenario, tuple(faults), _onsets(path, content, scenario), tuple(sources))


def _schema() -> dict[str, Any]:
    folder = resources.files("bridge").joinpath("schemas")
    schema: dict[str, Any] = json.loads(folder.joinpath("campaign.schema.json").read_text(encoding="utf-8"))
    scenario = json.loads(folder.joinpath("scenario.schema.json").read_text(encoding="utf-8"))
    schema["$defs"]["faults"]["items"] = fault_schema()
    schema["$defs"] |= scenario["$defs"]
    return schema


def _beside(path: Path, name: str, key: str) -> Path:
    found = (path.parent / name).resolve()
    if not found.is_file():
        raise ConfigurationError(path, key, f"no such file: {name}")
    return found


def _plans(path: Path, key: str, entries: Sequence[Mapping[str, Any]], database: Codec) -> tuple[FaultPlan, ...]:
    for place, entry in enumerate(entries):
        if "when" in entry:
            raise ConfigurationError(path, f"{key}.faults[{place}].when", "is not allowed; the campaign has the onsets")
    try:
        return read_faults(path, entries, database)
    except ConfigurationError as error:
        raise ConfigurationError(path, f"{key}.{error.key}", error.problem) from error


def _excused(path: Path, key: str, reasons: Mapping[str, str]) -> Mapping[str, str]:
    for name in reasons:
        if name not in properties():
            raise ConfigurationError(path, f"{key}.{name}", f"unknown; allowed are {', '.join(properties())}")
    return reasons


def _provoked(
    path: Path, file: Path, entry: Mapping[str, Any], scenario: Scenario, watch_us: int
) -> Iterator[CampaignFault]:
    """A fault for each provocation that can be injected into the scenario's car, for good."""
    database = profile(scenario.profile)
    provoker = Provoker(scenario.operation, database)
    more = {
        name: _excused(path, f"provocations.excused.{name}", reasons)
        for name, reasons in entry.get("excused", {}).items()
    }
    told = load_provocations(file, database)
    known = {f"{layer}.{name}" for layer in LAYERS for name in told[layer]}
    for name in more:
        if name not in known:
            raise ConfigurationError(path, f"provocations.excused.{name}", f"is none of {file.name}")
    for layer in LAYERS:
        for name, provocation in told[layer].items():
            plans = provoker.plans(provocation, Duration.PERMANENT)
            if provoker.suits(provocation) and plans:
                excused = dict.fromkeys(provocation.excused, "the provocation breaks it by itself")
                full = f"{layer}.{name}"
                yield CampaignFault(full, plans, watch_us, excused | dict(more.get(full, {})))


def _onsets(path: Path, content: Mapping[str, Any], scenario: Scenario) -> Mapping[int, int]:
    onsets: dict[int, int] = {}
    for place, grid in enumerate(content["onsets"]):
        first, last, step = microseconds(grid["from_s"]), microseconds(grid["to_s"]), grid["every_ms"] * 1000
        key = f"onsets[{place}]"
        if last < first:
            raise ConfigurationError(path, f"{key}.to_s", f"is {grid['to_s']}; must be at least from_s")
        if last > scenario.time_limit_us:
            limit = scenario.time_limit_us * 1e-6
            raise ConfigurationError(path, f"{key}.to_s", f"is {grid['to_s']}; the drive ends at {limit:g} s")
        if first % TICK_US or step % TICK_US:
            name = "from_s" if first % TICK_US else "every_ms"
            raise ConfigurationError(path, f"{key}.{name}", f"is {grid[name]}; must be whole ticks of 10 ms")
        for onset_us in range(first, last + 1, step):
            onsets[onset_us] = max(onsets.get(onset_us, 0), microseconds(grid.get("watch_s", 0.0)))
    return dict(sorted(onsets.items()))
