"""Skips hide what is not tested: every one that may happen is listed here, and any other fails the run."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import pytest

from bridge.realtime.vcan import Interface, find_interface, kernel_has_can

ALLOWED_SKIPS = {
    "root may read everything": 1,
    "root may write everywhere": 1,
    "no permission for real-time priority": 1,
    "cyclictest is not installed": 5,
    "stress-ng is not installed": 8,
    "can-utils is not installed": 3,
    "opendbc is not installed": 4,
    # Tests marked vcan; `make test-vcan` runs them, and lets none of them be skipped.
    "this kernel has CAN": 1,
    "no CAN in this kernel": 112,
    "vcan0 to vcan4 are not up": 112,
}
"""How often each reason may come up in one run."""


class SkipGuard:
    """Counts skips by their reason."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}

    def _count(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if report.skipped:
            reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
            reason = reason.removeprefix("Skipped: ")
            self.counts[reason] = self.counts.get(reason, 0) + 1

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._count(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        self._count(report)

    def excess(self) -> list[str]:
        """Reasons that are not listed, or came up more often than listed."""
        return [reason for reason, count in self.counts.items() if count > ALLOWED_SKIPS.get(reason, 0)]

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self.excess() and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        for reason in self.excess():
            terminalreporter.write_line(f"FAILED: skip that hil_tests/conftest.py does not allow: {reason}", red=True)


class ReactionReport:
    """Gathers what the cells of the reaction matrix have measured, from all workers."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows: list[dict[str, Any]] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call":
            self.rows += [row for name, row in report.user_properties if name == "reaction" and isinstance(row, dict)]

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if self.rows:
            from tools.reactions.report import as_text, write

            write(self.rows, self.folder)
            terminalreporter.write_line(as_text(self.rows))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--reactions", type=Path, default=None, help="folder for the table of the reaction matrix")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Of the reaction matrix only its share, unless it is asked for by its marker or by a cell's name."""
    if "matrix" in config.option.markexpr.replace("not matrix", "") or any("test_cell[" in one for one in config.args):
        return
    markers = {item: item.get_closest_marker("matrix") for item in items}
    left_out = [item for item, marker in markers.items() if marker is not None and not marker.kwargs["share"]]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        gone = set(left_out)
        items[:] = [item for item in items if item not in gone]


def pytest_configure(config: pytest.Config) -> None:
    # A shell lets what it starts in the background ignore Ctrl-C, and so it would be inherited.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    config.pluginmanager.register(SkipGuard(), "skip-guard")
    folder = config.getoption("--reactions")
    if folder is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(ReactionReport(folder), "reaction-report")


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("vcan"):
        if not kernel_has_can():
            pytest.skip("no CAN in this kernel")
        if any(find_interface(f"vcan{number}") is not Interface.UP for number in range(5)):
            pytest.skip("vcan0 to vcan4 are not up")
