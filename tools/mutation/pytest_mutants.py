"""pytest plug-in: once through the tests with no mutant alive, then each mutant against the tests that reach it."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Generator, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from tools.mutation import verdicts
from tools.mutation.judge import Judge, ReachingTest, Switch, order
from tools.mutation.verdicts import Row, Verdict

_FAVOURITES = 5
_PROGRESS_S = 30.0


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that the command passes."""
    parser.addoption("--mutants", type=Path, help="folder with the list of mutants, for all that is kept")
    parser.addoption("--mutants-workers", type=int, default=1, help="processes")


def pytest_configure(config: pytest.Config) -> None:
    """Start to watch what is reached."""
    config.pluginmanager.register(Mutation(config.getoption("--mutants"), config.getoption("--mutants-workers")))


class Mutation:
    """The run over all mutants.

    Parameters
    ----------
    folder : holds `mutants.json` (see `tools.mutation.__main__`), what each test reaches, and the verdicts.
    workers : processes that judge.
    """

    def __init__(self, folder: Path, workers: int) -> None:
        listed = json.loads((folder / "mutants.json").read_text())
        self._project: str = listed["project"]
        self._mutants: list[dict[str, Any]] = listed["mutants"]
        self._chosen: set[str] = set(listed["files"])
        self._reach, self._verdicts, self._workers = folder / "reach.json", folder / "verdicts.jsonl", workers
        self._switch = Switch(max(one["number"] for one in self._mutants))
        self._open: list[set[int]] = []
        self._shared: dict[tuple[str, str], set[int]] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run the tests, and then the mutants."""
        tests, modules = self._baseline(session)
        slowest: dict[str, float] = {}
        for test in tests:
            slowest[test.module] = max(slowest.get(test.module, 0.0), test.seconds)
        judge = Judge(self._switch.wake, {module: 3.0 * seconds for module, seconds in slowest.items()})
        by_file: dict[str, list[dict[str, Any]]] = {}
        for mutant in self._mutants:
            if mutant["path"] in self._chosen:
                by_file.setdefault(mutant["path"], []).append(mutant)
        for path in sorted(by_file, key=lambda one: len(by_file[one])):
            self._judge_file(judge, path, by_file[path], tests, modules)
        return True

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Generator[None, object, object]:
        """Note what is reached where a fixture is set up that several tests share."""
        if fixturedef.scope == "function":
            return (yield)
        self._note()
        self._open.append(self._shared.setdefault((fixturedef.baseid, fixturedef.argname), set()))
        try:
            return (yield)
        finally:
            self._note()
            self._open.pop()

    def _note(self) -> None:
        found = self._switch.take_reached()
        for reached in self._open:
            reached.update(found)

    def _baseline(self, session: pytest.Session) -> tuple[list[ReachingTest], dict[str, str]]:
        """Tests with what they reach, and the digest of each of their modules."""
        by_module: dict[str, list[pytest.Item]] = {}
        for item in session.items:
            by_module.setdefault(item.nodeid.partition("::")[0], []).append(item)
        digests = {name: sha256((session.config.rootpath / name).read_bytes()).hexdigest()[:16] for name in by_module}
        kept = json.loads(self._reach.read_text()) if self._reach.exists() else {}
        if kept.get("project") != self._project:
            kept = {"project": self._project, "modules": {}}
        tests = []
        for name, items in by_module.items():
            known = kept["modules"].get(name, {})
            if known.get("digest") != digests[name] or not {item.nodeid for item in items} <= known["tests"].keys():
                print(f"without any mutant: {name}, {len(items)} tests", flush=True)
                known = {"digest": digests[name], "tests": self._run(items)}
                kept["modules"][name] = known
                partial = self._reach.with_suffix(".part")
                partial.write_text(json.dumps(kept))
                partial.replace(self._reach)
            tests += [
                ReachingTest(item, known["tests"][item.nodeid][0], set(known["tests"][item.nodeid][1]))
                for item in items
            ]
        return tests, digests

    def _run(self, items: Sequence[pytest.Item]) -> dict[str, tuple[float, list[int]]]:
        """Seconds that each test of a module took, and the mutants that it reached."""
        found: dict[str, tuple[float, set[int]]] = {}
        self._switch.take_reached()
        for place, item in enumerate(items):
            following = items[place + 1] if place + 1 < len(items) else None
            self._open = [set()]
            started = time.process_time()
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            self._note()
            found[item.nodeid] = time.process_time() - started, self._open[0]
            if item.session.testsfailed:
                raise item.session.Failed(f"fails without any mutant: {item.nodeid}")
        for item in items:
            for (base, fixture), reached in self._shared.items():
                if item.nodeid.startswith(base) and fixture in getattr(item, "fixturenames", ()):
                    found[item.nodeid][1].update(reached)
        return {name: (seconds, sorted(reached)) for name, (seconds, reached) in found.items()}

    def _judge_file(
        self,
        judge: Judge,
        path: str,
        mutants: Sequence[dict[str, Any]],
        tests: Sequence[ReachingTest],
        modules: dict[str, str],
    ) -> None:
        """Judge those whose verdict does not stand, in several processes."""
        known = verdicts.load(self._verdicts)
        due = [one for one in mutants if one["key"] not in known or known[one["key"]].unheard(self._project, modules)]
        started = time.monotonic()
        print(f"{path}: {len(mutants)} mutants, {len(due)} to be judged", flush=True)
        children = []
        for part in range(self._workers if due else 0):
            child = os.fork()
            if child == 0:
                try:
                    self._judge_part(judge, due[part :: self._workers], known, tests, modules)
                    os._exit(0)
                finally:
                    os._exit(1)
            children.append(child)
        failed = [child for child in children if os.waitpid(child, 0)[1]]
        if failed:
            raise pytest.UsageError(f"{path}: a process of the judge failed")
        rows = verdicts.load(self._verdicts)
        counts = Counter(rows[one["key"]].verdict.lower().replace("_", " ") for one in mutants)
        said = ", ".join(f"{count} {name}" for name, count in counts.most_common())
        print(f"{path}: {said}; {time.monotonic() - started:.0f} s", flush=True)

    def _judge_part(
        self,
        judge: Judge,
        due: Sequence[dict[str, Any]],
        known: dict[str, Row],
        tests: Sequence[ReachingTest],
        modules: dict[str, str],
    ) -> None:
        killers: list[str] = []
        said = time.monotonic()
        for place, mutant in enumerate(due):
            row = self._judge_one(judge, mutant, known.get(mutant["key"]), killers, tests, modules)
            verdicts.append(self._verdicts, row)
            if row.verdict == Verdict.KILLED.name:
                killers = [row.by, *(one for one in killers if one != row.by)][:_FAVOURITES]
            if time.monotonic() - said > _PROGRESS_S:
                said = time.monotonic()
                print(f"    {place + 1} of {len(due)}", flush=True)

    def _judge_one(
        self,
        judge: Judge,
        mutant: dict[str, Any],
        before: Row | None,
        killers: Sequence[str],
        tests: Sequence[ReachingTest],
        modules: dict[str, str],
    ) -> Row:
        reaching = [test for test in tests if mutant["number"] in test.reached]
        old = Verdict.NOT_REACHED
        heard: dict[str, str] = {}
        if before is not None and before.verdict != Verdict.KILLED.name and before.project == self._project:
            heard, old = dict(before.modules), Verdict[before.verdict]
        asked = [test for test in reaching if heard.get(test.module) != modules[test.module]]
        favourites = [*([before.by] if before is not None else []), *killers]
        verdict, by = judge.verdict(mutant["number"], order(asked, favourites)) if asked else (old, "")
        if verdict is Verdict.KILLED:
            heard = {by.partition("::")[0]: modules[by.partition("::")[0]]}
        else:
            heard |= modules
            if old in (Verdict.CRASHED, Verdict.TIMED_OUT):
                assert before is not None
                verdict, by = old, before.by
        return Row(mutant["key"], self._project, verdict.name, by, len(reaching), heard)
