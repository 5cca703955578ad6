"""The vcan test machine itself: nothing but tests that ran and passed may look like success."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
from pathlib import Path

import pytest

from bridge.realtime.vcan import ensure_interfaces, kernel_has_can
from dbc.errors import BusError, RaceloopError
from tools.vcan_machine import kernel, machine
from tools.vcan_machine.__main__ import ALL_TESTS, BUILD, GUESTS, ROOT, main
from tools.vcan_machine.junit import Outcome, read_junit

boots = pytest.mark.machine


@pytest.mark.skipif(kernel_has_can(), reason="this kernel has CAN")
def test_interfaces_without_can_in_the_kernel() -> None:
    with pytest.raises(BusError, match=r"^no CAN in this kernel; a run with --bus hub needs none$"):
        ensure_interfaces(["vcan0"])


@pytest.mark.parametrize(("status", "qemu_status"), [(0, 1), (1, 3), (5, 11), (126, 253), (127, 253), (255, 253)])
def test_end_of_the_command(status: int, qemu_status: int) -> None:
    assert machine.judge(f"{status}\n", qemu_status) == status


@pytest.mark.parametrize(
    ("file", "qemu_status"), [("0\n", 0), ("0\n", 3), ("1\n", 1), ("", 1), ("no\n", 1), ("-1\n", 1), ("0\n", -9)]
)
def test_end_that_is_not_to_be_trusted(file: str, qemu_status: int) -> None:
    with pytest.raises(machine.MachineError):
        machine.judge(file, qemu_status)


@pytest.mark.parametrize(
    ("counts", "passed"),
    [((9, 0, 0, 0), True), ((0, 0, 0, 0), False), ((9, 1, 0, 0), False), ((9, 0, 1, 0), False), ((9, 0, 0, 1), False)],
)
def test_passed_means_that_all_ran(tmp_path: Path, counts: tuple[int, int, int, int], passed: bool) -> None:
    numbers = 'tests="{}" failures="{}" errors="{}" skipped="{}"'.format(*counts)
    (tmp_path / "junit.xml").write_text(f'<?xml version="1.0"?><testsuites><testsuite {numbers}/></testsuites>')
    outcome = read_junit(tmp_path / "junit.xml")
    assert outcome == Outcome(*counts)
    assert outcome.passed is passed


@pytest.mark.parametrize("content", [None, "", "<testsuites><testsuite"])
def test_results_that_are_not_complete(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "junit.xml").write_text(content)
    assert read_junit(tmp_path / "junit.xml") is None


def test_results_are_those_that_pytest_writes(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(
        "import pytest\ndef test_a(): pass\ndef test_b(): assert False\ndef test_c(): pytest.skip('no')\n"
    )
    command = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "--junit-xml=junit.xml", "test_it.py"]
    subprocess.run(command, cwd=tmp_path, check=False, capture_output=True)
    assert read_junit(tmp_path / "junit.xml") == Outcome(tests=3, failures=1, errors=0, skipped=1)


def test_every_marked_file_runs_in_the_machine() -> None:
    marked = {
        path
        for path in (ROOT / "hil_tests").rglob("test_*.py")
        if "pytest.mark.vcan" in path.read_text() and path != Path(__file__)
    }
    assert marked
    in_guests = set()
    for guest in GUESTS.values():
        paths = [ROOT / path for path in (*guest.tests, *guest.left_out)]
        assert all(path.exists() for path in paths)
        left_out = {ROOT / path for path in guest.left_out}
        in_guests |= {path for path in marked - left_out if any(path.is_relative_to(ROOT / one) for one in guest.tests)}
    here = {path for path in marked if any(path.is_relative_to(ROOT / one) for one in ALL_TESTS)}
    assert in_guests == here == marked


def test_missing_programs_give_one_line(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "SYSTEM_PATH", "")
    assert main([]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line == "vcan_machine: programs are missing; run: sudo apt-get install can-utils iproute2 util-linux"


def test_busybox_with_libraries_is_refused() -> None:
    assert not machine.is_static(Path(sys.executable).read_bytes())


def test_kernel_that_apt_does_not_know() -> None:
    with pytest.raises(RaceloopError, match=r"^apt-cache depends linux-image-none: E:|^no command apt-cache"):
        kernel.newest("linux-image-none")


@pytest.fixture(scope="module")
def stock() -> kernel.Kernel:
    return kernel.fetch(kernel.newest(GUESTS["stock"].metapackage), BUILD)


@boots
def test_guest_hands_back_status_output_and_files(stock: kernel.Kernel, tmp_path: Path) -> None:
    results = tmp_path / "results, with a comma"
    output = bytearray()
    script = 'echo "it runs"; pwd; touch /results/made /not-on-the-host; ls /sys/module >&2; exit 3'
    assert machine.run_in_guest(stock, ["sh", "-c", script], results, 60, output.extend) == 3
    assert output.decode().splitlines()[:2] == ["it runs", str(Path.cwd())]
    assert {"vcan", "can_raw", "can_bcm"} <= set(output.decode().split())
    assert (results / "output").read_bytes() == output
    assert (results / "made").exists()
    assert not Path("/not-on-the-host").exists()


@boots
def test_panic_is_no_success(stock: kernel.Kernel, tmp_path: Path) -> None:
    with pytest.raises(machine.MachineError, match=r"(?s)^ended with no exit status.*\| .*Kernel panic"):
        machine.run_in_guest(stock, ["sh", "-c", "echo c >/proc/sysrq-trigger"], tmp_path / "results", 180, len)


@boots
def test_modules_that_do_not_load_are_no_success(stock: kernel.Kernel, tmp_path: Path) -> None:
    (tmp_path / "9p.ko").write_bytes(b"no module")
    broken = kernel.Kernel(stock.package, stock.image, (tmp_path / "9p.ko",))
    with pytest.raises(
        machine.MachineError, match=r"(?s)^ended with no exit status.*9p\.ko does not load.*host's files cannot"
    ):
        machine.run_in_guest(broken, ["true"], tmp_path / "results", 180, len)


@boots
def test_guest_that_hangs_is_killed(stock: kernel.Kernel, tmp_path: Path) -> None:
    results = tmp_path / "results"
    with pytest.raises(machine.MachineError, match=r"^not finished after 1 s, killed"):
        machine.run_in_guest(stock, ["sleep", "1000"], results, 1, len)
    assert not running(results)


@boots
def test_guest_dies_with_the_program_that_runs_it(stock: kernel.Kernel, tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from tools.vcan_machine import kernel, machine;"
        "modules = tuple(map(Path, sys.argv[3:]));"
        "machine.run_in_guest(kernel.Kernel(None, Path(sys.argv[1]), modules), ['sh', '-c', 'echo up; sleep 1000'],"
        "Path(sys.argv[2]), 60, lambda output: output and print(output.decode(), flush=True))"
    )
    command = [sys.executable, "-c", program, stock.image, tmp_path / "results", *stock.modules]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as runner:
        assert runner.stdout is not None
        assert runner.stdout.readline() == "up\n"
        (qemu,) = running(tmp_path / "results")
        end = os.pidfd_open(qemu)
        runner.kill()
    assert select.select([end], [], [], 30.0)[0], "QEMU outlived the program that ran it"
    os.close(end)


def running(results: Path) -> list[int]:
    """Processes that have a folder of results in their command line."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = (process / "cmdline").read_bytes().decode(errors="replace")
            if words.startswith("qemu") and str(results) in words:
                found.append(int(process.name))
    return found


@boots
def test_kernel_without_vcan(stock: kernel.Kernel, tmp_path: Path) -> None:
    modules = tuple(module for module in stock.modules if not module.name.endswith("-vcan.ko"))
    assert len(modules) == len(stock.modules) - 1
    program = "from bridge.realtime.vcan import ensure_interfaces; ensure_interfaces(['vcan0'])"
    output = bytearray()
    command = [sys.executable, "-c", program]
    without_vcan = kernel.Kernel(stock.package, stock.image, modules)
    assert machine.run_in_guest(without_vcan, command, tmp_path / "results", 180, output.extend) == 1
    assert output.decode().splitlines()[-1] == (
        "dbc.errors.BusError: this kernel has no vcan loaded; run: sudo modprobe vcan"
        " && sudo ip link add dev vcan0 type vcan && sudo ip link set dev vcan0 up"
    )


@boots
def test_kernel_with_vcan_is_used_itself(stock: kernel.Kernel, tmp_path: Path) -> None:
    """In the guest, because there is a kernel with vcan; nothing of the tests' network shows outside of it."""
    here = f"{sys.executable} -m tools.vcan_machine"
    script = (
        f"{here} -- ip -brief link || exit 90; {here} -- sh -c 'exit 5'; status=$?; ! ip link show vcan0 || exit 91;"
        "exit $status"
    )
    output = bytearray()
    assert machine.run_in_guest(stock, ["sh", "-c", script], tmp_path / "results", 180, output.extend) == 1
    lines = output.decode().splitlines()
    assert lines[0] == "this kernel has vcan: the tests run on it, in a network namespace of their own"
    assert {line.split()[0] for line in lines if ",UP" in line} == {"lo", *(f"vcan{number}" for number in range(5))}
    assert [line for line in lines if line.startswith("own: exit status 0 after ")]
    assert [line for line in lines if line.startswith("own: exit status 5 after ")]
