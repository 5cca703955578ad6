"""What the pages and the Makefile tell a newcomer exists: commands, targets, links, files; and no machine's paths."""

from __future__ import annotations

import argparse
import ast
import importlib.util
import re
import shlex
import subprocess
from pathlib import Path

import pytest
from reaction_times import REACTIONS

from bridge.bus import BIT_RATES
from tools.cli import make_parser

ROOT = Path(__file__).resolve().parents[2]


def tracked(pattern: str) -> list[Path]:
    listed = subprocess.run(["git", "ls-files", pattern], cwd=ROOT, capture_output=True, text=True, check=True)
    return [path for path in map(ROOT.joinpath, listed.stdout.splitlines()) if path.exists()]


PAGES = tracked("*.md")
COMMAND_PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
ARCHITECTURE = ROOT / "docs" / "architecture.md"


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def code(page: Path) -> list[str]:
    """Lines of shell blocks and inline code of a page."""
    text = page.read_text()
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    inline = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL))
    lines = [line for block in blocks for line in block.splitlines()] + inline
    return [line.split("#")[0].strip() for line in lines]


def targets() -> set[str]:
    return set(re.findall(r"^\.PHONY: (\S+)$", (ROOT / "Makefile").read_text(), re.MULTILINE))


def test_pages_are_found() -> None:
    assert {"README.md", "CONTRIBUTING.md", "docs/architecture.md"} <= {name(page) for page in PAGES}


@pytest.mark.parametrize("page", COMMAND_PAGES, ids=name)
def test_make_targets_exist(page: Path) -> None:
    named = [shlex.split(line)[1] for line in code(page) if re.match(r"make \S", line)]
    assert named
    assert set(named) <= targets()


def without_brackets(line: str) -> list[str]:
    """The usage line of a page with its optional parts given and numbers for its placeholders."""
    return ["1" if word == "N" else word for word in shlex.split(re.sub(r"[\[\]]", "", line))]


@pytest.mark.parametrize("page", [ROOT / "README.md", ARCHITECTURE], ids=name)
def test_raceloop_commands_parse(page: Path) -> None:
    lines = [line for line in code(page) if line.startswith("raceloop ")]
    assert lines
    for line in lines:
        make_parser().parse_args(without_brackets(line)[1:])


def test_readme_names_every_command() -> None:
    (commands,) = (action for action in make_parser()._actions if isinstance(action, argparse._SubParsersAction))
    named = {line.split()[1] for line in code(ROOT / "README.md") if line.startswith("raceloop ")}
    assert named == set(commands.choices)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_python_modules_and_their_options_exist(page: Path) -> None:
    for line in code(page):
        if match := re.search(r"python -m ([\w.]+)(.*)", line):
            module = importlib.util.find_spec(match[1])
            if module is not None and module.submodule_search_locations is not None:
                module = importlib.util.find_spec(f"{match[1]}.__main__")
            assert module is not None, line
            assert module.origin is not None
            tree = ast.walk(ast.parse(Path(module.origin).read_text()))
            texts = {node.value for node in tree if isinstance(node, ast.Constant)}
            for option in re.findall(r"--[a-z-]+", match[2].split(" -- ")[0]):
                assert option in texts, f"{line}: {match[1]} has no {option}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target.split("#")[0]).exists(), target


@pytest.mark.parametrize("page", [*COMMAND_PAGES, ARCHITECTURE], ids=name)
def test_files_that_a_page_names_exist(page: Path) -> None:
    folders = "autonomy|bridge|dbc|docs|firmware|hil_tests|plant_fmu|scenarios|tools"
    for text in code(page):
        if re.fullmatch(rf"({folders})/[\w./*-]*", text):
            assert list(ROOT.glob(text.rstrip("/"))), text


def test_architecture_states_the_buses() -> None:
    rows = re.findall(r"^\| (CAN\S+) \| (\d+) \|", ARCHITECTURE.read_text(), re.MULTILINE)
    assert rows == [(bus.label, str(rate)) for bus, rate in BIT_RATES.items()]


def test_help_lists_every_target() -> None:
    shown = subprocess.run(["make", "--no-print-directory"], cwd=ROOT, capture_output=True, text=True, check=True)
    lines = {line.split(maxsplit=1)[0]: line.split(maxsplit=1)[1] for line in shown.stdout.splitlines()}
    assert set(lines) == targets()
    assert all(len(text) > 10 for text in lines.values())


def test_no_machine_is_named() -> None:
    """No folder of somebody's machine, no registry other than the default ones."""
    machine = re.compile(
        r"(?<![\w.])/(home|work|Users|root|tmp|mnt|data)/|(index-url|trusted-host|registry=)|\.internal\b"
    )
    here = Path(__file__)
    for path in tracked("*"):
        if path != here and b"\0" not in (content := path.read_bytes()):
            for number, line in enumerate(content.decode().splitlines(), 1):
                assert not machine.search(line), f"{name(path)}:{number}: {line.strip()}"


def test_reaction_times_are_those_that_the_tests_hold_the_car_to() -> None:
    rows = re.findall(
        r"^\| (\S+) \| ([^|]+) \| ([\d.]+) \| [-\d. ]*\| [-\d. ]*\|$", (ROOT / "docs" / "realtime.md").read_text(), re.M
    )
    shown = {(gone, who.removesuffix(": emergency stop").lower(), float(latest)) for gone, who, latest in rows}
    assert shown == {(one.gone, one.by, one.deadline_us / 1000) for one in REACTIONS}
