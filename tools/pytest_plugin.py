"""pytest plug-in: the fixture `bench`, a car on its track that a test drives. See docs/injection.md.

What is heavy is imported when the first test wants a bench: the plug-in is loaded in every run of pytest.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from bridge.observed_bench import ObservedBench

_BENCH = pytest.StashKey["ObservedBench"]()

_MARKERS = (
    "raceloop(scenario='short_drive', profile=None, seed=None): what the fixture `bench` is made from",
    "expects_faults(*names): the SSM reports these faults and no others; without names, whatever it likes",
    "expects_bus_errors: error frames and lost frames are part of the test",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """One option: the seed."""
    group = parser.getgroup("raceloop")
    group.addoption("--raceloop-seed", type=int, default=None, help="seed of all benches (default: the scenario's)")


def pytest_configure(config: pytest.Config) -> None:
    """Make the markers known."""
    for marker in _MARKERS:
        config.addinivalue_line("markers", marker)


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ObservedBench]:
    """A bench at power-on, from the scenario that the marker `raceloop` names."""
    from dataclasses import replace  # noqa: PLC0415
    from functools import partial  # noqa: PLC0415

    from bridge.observed_bench import ObservedBench  # noqa: PLC0415
    from tools.run import chosen_scenario, load_road, make_autonomy  # noqa: PLC0415

    options: dict[str, Any] = {"scenario": "short_drive", "profile": None, "seed": None}
    marker = request.node.get_closest_marker("raceloop")
    given = {} if marker is None else dict(zip(options, marker.args, strict=False)) | marker.kwargs
    unknown = sorted(set(given) - set(options))
    if unknown:
        raise pytest.UsageError(f"marker raceloop: {unknown[0]} is unknown; allowed are {', '.join(options)}")
    options |= given
    scenario = chosen_scenario(str(options["scenario"]), options["profile"])
    seed = request.config.getoption("--raceloop-seed")
    seed = options["seed"] if seed is None else seed
    if seed is not None:
        scenario = replace(scenario, seed=seed)
    observed = ObservedBench.from_scenario(scenario, partial(load_road, scenario), make_autonomy)
    name = re.sub(r"\W+", "_", request.node.name)
    observed.keep_log(tmp_path_factory.mktemp(name[:40], numbered=True))
    request.node.stash[_BENCH] = observed
    with observed:
        yield observed


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    """A test that has passed fails when its bench is not in order."""
    result = yield
    observed = pyfuncitem.stash.get(_BENCH, None)
    if observed is not None:
        marker = pyfuncitem.get_closest_marker("expects_faults")
        faults = () if marker is None else marker.args or None
        complaints = observed.complaints(faults, pyfuncitem.get_closest_marker("expects_bus_errors") is not None)
        if complaints:
            pytest.fail("the bench is not in order: " + "; ".join(complaints), pytrace=False)
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A test that has failed keeps its log, and says how to run it again."""
    report = yield
    observed = item.stash.get(_BENCH, None)
    if observed is not None and call.when == "call" and report.failed:
        recording = observed.finish()
        lines = [f"scenario {observed.scenario.name}, seed {observed.scenario.seed}, at {observed.now_us * 1e-6:.2f} s"]
        lines += [f"injected: {injection}" for injection in observed.injections]
        if recording is not None:
            lines.append(f"log: {recording.candump}")
        again = shlex.join(["pytest", item.nodeid, f"--raceloop-seed={observed.scenario.seed}"])
        report.sections.append(("raceloop", "\n".join([*lines, f"again: {again}"])))
    return report
