"""Verdicts on mutants: when one that is kept still stands, and who is asked first."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from tools.mutation.judge import ReachingTest, order
from tools.mutation.verdicts import Row, Verdict, append, load

ALL = {"a.py": "1", "b.py": "2"}


def row(verdict: Verdict, **modules: str) -> Row:
    by = "a.py::test" if verdict is Verdict.KILLED else ""
    return Row("x.c:f: a -> b", "project", verdict.name, by, 3, {f"{name}.py": text for name, text in modules.items()})


@pytest.mark.parametrize("verdict", list(Verdict))
def test_a_verdict_falls_with_the_project(verdict: Verdict):
    assert row(verdict, a="1", b="2").unheard("project", ALL) == set()
    assert row(verdict, a="1", b="2").unheard("other", ALL) == {"a.py", "b.py"}


@pytest.mark.parametrize("verdict", [one for one in Verdict if one is not Verdict.KILLED])
def test_a_survivor_hears_the_modules_that_are_new_or_changed(verdict: Verdict):
    assert row(verdict, a="1").unheard("project", ALL) == {"b.py"}
    assert row(verdict, a="1", b="1").unheard("project", ALL) == {"b.py"}
    assert row(verdict, a="1", b="2", gone="3").unheard("project", ALL) == set()


def test_a_killed_one_is_judged_anew_only_when_its_killer_changed():
    assert row(Verdict.KILLED, a="1").unheard("project", ALL | {"b.py": "changed"}) == set()
    assert row(Verdict.KILLED, a="1").unheard("project", ALL | {"a.py": "changed"}) == {"a.py", "b.py"}
    assert row(Verdict.KILLED, gone="1").unheard("project", ALL) == {"a.py", "b.py"}


def test_the_newest_row_counts_and_a_torn_one_does_not(tmp_path: Path):
    path = tmp_path / "verdicts.jsonl"
    assert load(path) == {}
    append(path, row(Verdict.SURVIVED, a="1"))
    append(path, row(Verdict.KILLED, a="1"))
    with path.open("a") as lines:
        lines.write('{"mutant": "x.c:f: a -> b", "proj')
    assert load(path) == {"x.c:f: a -> b": row(Verdict.KILLED, a="1")}


def test_each_function_is_asked_once_before_its_siblings_and_modules_stay_together(request: pytest.FixtureRequest):
    class Named(pytest.Item):
        def runtest(self) -> None: ...

    def made(name: str, seconds: float) -> ReachingTest:
        return ReachingTest(Named.from_parent(request.session, name=name, nodeid=name), seconds, set())

    tests = [made(f"slow.py::one[{n}]", 1.0) for n in range(20)]
    tests += [made(f"fast.py::{name}[{n}]", 0.1) for n in range(20) for name in ("two", "three")]
    names = [test.name for test in order(tests, [])]
    functions = [name.partition("[")[0] for name in names]
    assert functions[:3] == ["fast.py::three", "fast.py::two", "slow.py::one"]
    assert sorted(names) == sorted(test.name for test in tests)
    modules = [name.partition("::")[0] for name in names]
    assert sum(one != other for one, other in pairwise(modules)) == 5, "three rounds"
    assert order(tests, ["slow.py::one[7]", "slow.py::one[3]"])[0].name == "slow.py::one[7]"
