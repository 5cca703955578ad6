"""`raceloop run --realtime` with what it cannot use: one line, exit status 2, nothing written, nothing left running."""

from __future__ import annotations

import os
import sysconfig
from collections.abc import Callable
from pathlib import Path

import pytest
from cli_harness import Command, assert_one_line, command, copy_scenarios, edit

from bridge.realtime import vcan

needs_no_can = pytest.mark.skipif(vcan.kernel_has_can(), reason="this kernel has CAN")


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Callable[..., None]:
    """The run is refused with one line, and the folder of the recording does not appear."""
    raceloop: Command = command(capsys)

    def check(arguments: list[object], *words: object) -> None:
        assert_one_line(raceloop("run", "--out", tmp_path / "out", *arguments), *words)
        assert not (tmp_path / "out").exists()
        with pytest.raises(ChildProcessError):
            os.waitpid(-1, os.WNOHANG)
        assert list(Path("/dev/shm").glob(f"raceloop-run-{os.getpid()}-*")) == []

    return check


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--realtime", "--rt-ratio", "1"], ["--rt-ratio does not go with --realtime"]),
        (["--bus", "hub"], ["--bus needs --realtime"]),
        (["--without", "obc"], ["--without needs --realtime"]),
        (["--priority", "0"], ["--priority needs --realtime"]),
        (["--realtime", "--without", "driver"], ["--without driver: no such part; allowed are", "obc", "space-drive"]),
        (["--realtime", "--without", "hub"], ["--without hub: no such part"]),
        (["--realtime", "--interfaces", "can0,can1,can2,can3"], ["--interfaces needs --bus socketcan"]),
        (["--realtime", "--bus", "socketcan", "--port", "1"], ["--port is the hub's"]),
        (["--realtime", "--bus", "socketcan", "--interfaces", "a,b,c"], ["--interfaces a,b,c: must be 4 different"]),
        (["--realtime", "--bus", "socketcan", "--interfaces", "a,b,c,c"], ["must be 4 different names, of CAN1, CAN3"]),
        (["--realtime", "--bus", "socketcan", "--interfaces", "a,b,,c"], ["must be 4 different names"]),
        (["--realtime", "--cpu", "4096"], ["--cpu 4096: no such core for this process; allowed are"]),
        (["--realtime", "--cpu", "-1"], ["--cpu -1: no such core"]),
        (["--realtime", "--priority", "0"], ["--priority 0: must be 1 to 99"]),
        (["--realtime", "--priority", "100"], ["--priority 100: must be 1 to 99"]),
        (["--realtime", "--slower", "101"], ["--slower 101: must be 1 to 100"]),
        (["--slower", "2"], ["--slower needs --realtime"]),
        (["--realtime", "nowhere.yaml"], ["nowhere.yaml: no such scenario file"]),
    ],
    ids=lambda value: " ".join(value) if value[0].startswith("--") else "",
)
def test_wrong_options(refused: Callable[..., None], arguments: list[object], words: list[str]) -> None:
    refused(arguments, *words)


def test_a_radar_needs_an_interface_more(refused: Callable[..., None], tmp_path: Path) -> None:
    scenario = copy_scenarios(tmp_path / "scenarios")
    edit(scenario, "seed: 20221103", "seed: 20221103\nradar: true")
    socketcan = [scenario, "--realtime", "--bus", "socketcan", "--interfaces"]
    refused([*socketcan, "a,b,c,d"], "--interfaces a,b,c,d: must be 5 different names, of CAN1, CAN3, CANA, CANS, CANR")
    refused([*socketcan, "a,b,c,d,a"], "must be 5 different names")


@needs_no_can
def test_no_can_in_the_kernel(refused: Callable[..., None]) -> None:
    refused(["--realtime", "--bus", "socketcan"], "no CAN in this kernel", "--bus hub")


def test_executables_that_are_not_installed(
    refused: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sysconfig, "get_path", lambda _name: str(tmp_path))
    refused(["--realtime"], tmp_path / "raceloop-hub", "no such executable", "make build")


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("short_drive.yaml", "seed: 20221103", "sed: 20221103", ["sed: unknown key"]),
        ("short_drive.yaml", "s_m: 20.0", "s_m: 20000.0", ["start.s_m", "must be below"]),
        ("vehicles/av21.yaml", "drag_area: 0.725", "drag_area: -0.725", ["av21.yaml", "drag_area"]),
        ("operations/solo.yaml", "max_speed: 63.1", "max_speed: [63.1", ["solo.yaml", "line"]),
    ],
)
def test_wrong_files(
    refused: Callable[..., None], tmp_path: Path, file: str, old: str, new: str, words: list[str]
) -> None:
    scenario = copy_scenarios(tmp_path / "scenarios").with_name("short_drive.yaml")
    edit(scenario.parent / file, old, new)
    refused(["--realtime", scenario], *words)


def test_folder_that_is_a_file(refused: Callable[..., None], tmp_path: Path) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("mine\n")
    refused(["short_drive", "--realtime", "--out", blocked], blocked, "cannot be the folder of the recording")
    assert blocked.read_text() == "mine\n"


def test_port_that_is_taken(refused: Callable[..., None]) -> None:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        refused(["--realtime", "--port", taken.getsockname()[1]], "port is in use")
