"""Skips hide what is not tested: every one that may happen is listed here, and any other fails the run."""

from __future__ import annotations

import signal

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
    "vcan0 to vcan3 are not up": 112,
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


def pytest_configure(config: pytest.Config) -> None:
    # A shell lets what it starts in the background ignore Ctrl-C, and so it would be inherited.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    config.pluginmanager.register(SkipGuard(), "skip-guard")


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("vcan"):
        if not kernel_has_can():
            pytest.skip("no CAN in this kernel")
        if any(find_interface(f"vcan{number}") is not Interface.UP for number in range(4)):
            pytest.skip("vcan0 to vcan3 are not up")
