"""The ECUs' executables: their command line, their cycle, and what they do when told to stop or left alone."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from time import monotonic, monotonic_ns

import numpy as np
import pytest
from ecu_processes import BUSES, EcuProcess, mistake_of
from link_ends import LIMIT_S, HubSocket

from bridge._native import ffi, lib
from bridge.realtime.cycle_log import read_cycle_log
from bridge.realtime.programs import program
from bridge.realtime.wired import Cell, WiredIo
from dbc.buses import Bus, Station
from dbc.codec import database, profile
from dbc.frames import Frame
from dbc.network import own_network

pytestmark = pytest.mark.realtime

FULL_BRAKE_PA = 4.5e6
STATIONS = {"obc": Station.OBC, "raptor": Station.RAPTOR, "space-drive": Station.SPACE_DRIVE}


def named(frames: list[Frame], message: str) -> list[dict[str, float]]:
    codec = database.message(message)
    return [
        dict(zip(codec.signals, codec.decode(frame.data), strict=True))
        for frame in frames
        if (frame.bus, frame.id) == (codec.bus, codec.frame_id)
    ]


def frame(message: str, counter: int = 0, **values: float) -> bytes:
    codec = database.message(message)
    return codec.finish(codec.frame(*(values.get(name, 0.0) for name in codec.signals)), counter)


# --- mistakes ---


@pytest.mark.parametrize("name", BUSES)
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "no bus: give --bus NAME=ADDRESS; --help says more"),
        (["--bus", "CAN7=hub:/x"], "--bus CAN7=hub:/x: allowed is NAME=ADDRESS, NAME one of "),
        (["--period", "0"], "--period 0: allowed is a whole number, 1000 to 1000000"),
        (["--sped=1"], "unknown argument --sped=1; --help lists what is allowed"),
    ],
)
def test_mistakes_in_the_command_line(name: str, arguments: list[str], line: str):
    assert mistake_of(name, *arguments).startswith(line)


def test_profiles_belong_to_the_ecus_on_can1():
    assert mistake_of("obc", "--profile=V27") == "--profile V27: allowed is one of V14 V26"
    assert mistake_of("space-drive", "--profile=V26") == "--profile V26: this ECU is not on CAN1"


def test_wires_belong_to_the_actuator_ecus(tmp_path: Path):
    assert mistake_of("obc", "--wired", str(tmp_path)) == f"--wired {tmp_path}: this ECU has no wires to the plant"


@pytest.mark.parametrize("name", BUSES)
def test_help_names_the_buses(name: str):
    done = subprocess.run(
        [program(f"raceloop-{name}"), "--help"], capture_output=True, text=True, timeout=LIMIT_S, check=True
    )
    assert done.stderr == ""
    assert f"usage: raceloop-{name} --bus NAME=ADDRESS" in done.stdout
    assert "--with-parent" in done.stdout


def test_what_is_missing_is_named(tmp_path: Path):
    address = f"hub:{tmp_path}/none"
    assert mistake_of("raptor", f"--bus=CAN3={address}") == (
        f"CAN3 at {address}: no hub there: raceloop hub starts one"
    )
    assert mistake_of("raptor", "--bus=CAN3=can0").startswith("CAN3 at can0: not an address of a bus: ")
    assert mistake_of("raptor", "--bus=CAN3=hub:/x", "--cpu=1023").startswith(
        "no processor 1023 for this process: allowed are "
    )


@pytest.mark.parametrize("option", ["--wired", "--cycle-log"])
def test_files_that_cannot_be_used(option: str, tmp_path: Path):
    hub = HubSocket(tmp_path / "hub")
    command = [program("raceloop-space-drive"), f"--bus=CAN3={hub.address}", option, str(tmp_path / "no" / "file")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        peer = hub.accept()
        peer.welcome()
        _, log = process.communicate(timeout=LIMIT_S)
    peer.close()
    assert process.returncode == 2
    assert log == f"raceloop-space-drive: {option} {tmp_path}/no/file: No such file or directory\n"
    hub.close()


def test_a_file_that_holds_no_wires(tmp_path: Path):
    hub = HubSocket(tmp_path / "hub")
    wires = tmp_path / "wires"
    wires.write_text("nothing of the kind")
    command = [program("raceloop-space-drive"), f"--bus=CAN3={hub.address}", "--wired", str(wires)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        peer = hub.accept()
        peer.welcome()
        _, log = process.communicate(timeout=LIMIT_S)
    peer.close()
    assert (process.returncode, log) == (
        2, f"raceloop-space-drive: --wired {wires}: not a file of wires of this version\n",
    )  # fmt: skip
    hub.close()


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder for everybody; pytest's own are closed to other users."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o777)
        yield folder


def unprivileged(folder: Path, limit: str, name: str, *arguments: str) -> subprocess.Popen[str]:
    """Start an ECU as a user who may not have what `ulimit` takes away."""
    executable = shutil.copy(program(f"raceloop-{name}"), folder)
    return subprocess.Popen(
        ["/bin/sh", "-c", f'ulimit {limit} 0 && exec "$0" "$@"', executable, *arguments],
        stderr=subprocess.PIPE,
        text=True,
        user="nobody" if os.getuid() == 0 else None,
        env={"GCOV_PREFIX": str(folder)},  # where instrumented executables may write
    )


def test_no_permission_for_a_priority(open_folder: Path):
    with unprivileged(open_folder, "-r", "obc", "--bus=CAN1=hub:/x", "--priority=80") as process:
        _, log = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 2
    assert log == (
        "raceloop-obc: no permission for SCHED_FIFO priority 80: run as root, or allow it with 'ulimit -r 80' "
        "(rtprio in /etc/security/limits.conf)\n"
    )


def test_no_permission_to_lock_memory_is_a_note(open_folder: Path):
    hub = HubSocket(open_folder / "hub")
    hub.path.chmod(0o777)
    with unprivileged(open_folder, "-l", "space-drive", f"--bus=CAN3={hub.address}") as process:
        peer = hub.accept()
        peer.welcome()
        peer.packet()
        process.terminate()
        _, log = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0
    note, *others = log.splitlines()
    assert note.startswith(
        "raceloop-space-drive: memory is not locked, page faults may delay a cycle: run as root, or "
    )
    assert "memory" not in "".join(others)
    peer.close()
    hub.close()


# --- running ---


@pytest.fixture
def wires(tmp_path: Path) -> Iterator[WiredIo]:
    with WiredIo(tmp_path / "wires", create=True) as wires:
        yield wires


@pytest.mark.parametrize("name", BUSES)
def test_an_ecu_asks_for_what_the_files_say_and_speaks_on_its_buses(name: str, tmp_path: Path):
    network = own_network()
    station = STATIONS[name]
    with EcuProcess(name, tmp_path) as ecu:
        for bus, peer in ecu.peers.items():
            assert set(peer.filters) == {
                (facts.message.frame_id, facts.message.is_extended_frame)
                for facts in network
                if facts.bus == bus and (station in facts.receivers or facts.sender == station)
            }
        spoken = {facts.bus for facts in network if facts.sender == station}
        for bus in spoken:
            assert ecu.peers[bus].packet()


@pytest.mark.parametrize(("name", "message"), [("obc", "brake_pressure_cmd"), ("raptor", "misc_report")])
def test_an_ecu_speaks_the_profile_that_it_is_told(name: str, message: str, tmp_path: Path):
    """Both messages are longer or fuller in V26; a started onboard computer commands full brake to both axles."""
    codec = profile("V26").message(message)
    with EcuProcess(name, tmp_path, "--profile=V26") as ecu:
        end = monotonic() + LIMIT_S
        found: list[Frame] = []
        while not found:
            assert monotonic() < end
            found = [one for one in ecu.peers[Bus.CAN1].packet() if one.id == codec.frame_id]
    assert found[0].dlc == codec.length
    values = dict(zip(codec.signals, codec.decode(found[0].data), strict=True))
    if name == "obc":
        assert (values["F_brake_pressure_cmd"], values["R_brake_pressure_cmd"]) == (4500, 3833)


def test_cycles_are_on_the_grid_and_recorded(tmp_path: Path):
    epoch_ns = monotonic_ns() - 1_000_000_000
    log = tmp_path / "log"
    arguments = ("--phase=4000", f"--epoch={epoch_ns}", f"--cycle-log={log}", "--cycles=5000")
    with EcuProcess("obc", tmp_path, *arguments) as ecu:
        for _ in range(30):
            ecu.hear(Bus.CAN1, "brake_pressure_cmd")
        sent_us = monotonic_ns() // 1000
        ecu.say(Bus.CAN_S, frame("imu_rates"))
        ecu.say(Bus.CAN1, frame("misc_report"), frame("pt_report_1"))
        for _ in range(10):
            ecu.hear(Bus.CAN1, "brake_pressure_cmd")
        assert ecu.stop() == 0
        counts = ecu.counts("cycles")
        late = ecu.counts("CAN1")["late"] + ecu.counts("CANS")["late"]  # on a machine that stands still for long
    cycles = read_cycle_log(log)
    records = cycles.records
    assert (cycles.name, cycles.process, cycles.priority, cycles.cpu) == ("obc", ecu.process.pid, None, None)
    assert (cycles.epoch_ns, cycles.phase_ns, cycles.period_ns) == (epoch_ns, 4_000_000, 10_000_000)
    assert cycles.task_names == (
        "receive", "control", "monitor", "ssm", "dbw", "ct_report", "status", "statistics",
    )  # fmt: skip
    assert len(records) >= 45
    assert len(records) == counts["cycles"]
    assert int(records["skipped"].sum()) == counts["skipped"]
    np.testing.assert_array_equal(records["deadline_ns"], epoch_ns + 4_000_000 + records["slot"] * 10_000_000)
    assert (np.diff(records["slot"].astype(np.int64)) == 1 + records["skipped"][1:]).all()
    order = ("deadline_ns", "wake_ns", "received_ns", "ticked_ns", "sent_ns")
    for earlier, later in pairwise(order):
        assert (records[earlier] <= records[later]).all(), (earlier, later)

    # Tasks: all in the first minor frame, each fifth the report, each tenth the statistics.
    number = np.arange(len(records))
    assert (records["tasks_run"] & 0b01011111 == 0b01011111).all()
    np.testing.assert_array_equal(records["tasks_run"] >> lib.OBC_TASK_CT_REPORT & 1, number % 5 == 0)
    np.testing.assert_array_equal(records["tasks_run"] >> lib.OBC_TASK_STATISTICS & 1, number % 10 == 0)
    in_tasks_us = records["task_us"].sum(axis=1)
    tick_us = (records["ticked_ns"] - records["received_ns"]) / 1000.0
    assert (in_tasks_us <= tick_us + len(cycles.task_names)).all()  # each is rounded
    assert in_tasks_us.max() > 0
    assert (records["cpu_ns"] > 0).all()

    # Frames: three came in, some go out in every cycle.
    assert int(records["frames_in"].sum()) == 3 - late
    assert (records["frames_out"] >= 6).all()
    assert (records["refused"] == 0).all()
    for bus, arrived in ((Bus.CAN_S, True), (Bus.CAN1, True), (Bus.CAN_A, False), (Bus.CAN3, False)):
        newest = records["newest_ns"][:, bus]
        newest = newest[newest > 0]
        assert len(newest) == arrived, bus
        assert all(abs(int(time) // 1000 - sent_us) < LIMIT_S * 1e6 for time in newest)
        assert all(int(time) >= sent_us * 1000 - 1000 for time in newest)


def test_the_firmware_s_time_runs_scaled(tmp_path: Path):
    """At less than a tenth of the rate its frames are in time; unscaled, every one would be 7 ms late."""
    with EcuProcess("obc", tmp_path, "--period=107000") as ecu:
        for _ in range(2):
            values = ecu.hear(Bus.CAN_A, "executive_statistics")
        assert ecu.stop() == 0
    assert 10 <= values["executive_frames"] <= 30
    assert values["executive_late_frames"] < values["executive_frames"] / 2


# --- stopping ---


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_an_onboard_computer_that_is_stopped_leaves_full_brake_and_says_why(number: int, tmp_path: Path):
    with EcuProcess("obc", tmp_path) as ecu:
        assert ecu.hear(Bus.CAN_A, "ssm_status")["ssm_worst_fault"] == lib.FAULT_NONE
        assert ecu.stop(number) == 0
        status = named(ecu.rest(Bus.CAN_A), "ssm_status")
        commands = named(ecu.rest(Bus.CAN1), "brake_pressure_cmd")
        assert [one["ssm_worst_fault"] for one in status][-lib.ECU_STOP_CYCLES :] == [
            lib.FAULT_COMPUTER_STOPPING
        ] * lib.ECU_STOP_CYCLES
        assert {one["brake_pressure_cmd"] for one in commands[-lib.ECU_STOP_CYCLES :]} == {FULL_BRAKE_PA / 1000}
        assert len(ecu.lines("stops on ")) == 1
        assert ecu.counts("cycles")["cycles"] > lib.ECU_STOP_CYCLES
        assert ecu.counts("CAN1")["sent"] > 0


def test_a_raptor_that_is_stopped_leaves_the_emergency_shutdown(tmp_path: Path, wires: WiredIo):
    with EcuProcess("raptor", tmp_path, f"--wired={tmp_path}/wires") as ecu:
        assert ecu.hear(Bus.CAN1, "misc_report")["sys_state"] in (1, 2)
        assert ecu.stop() == 0
        states = [one["sys_state"] for one in named(ecu.rest(Bus.CAN1), "misc_report")]
        requests = [one["contrl_pos_brk"] for one in named(ecu.rest(Bus.CAN3), "req_brake_pos")]
        assert states[-1] == 16
        assert set(requests[-lib.ECU_STOP_CYCLES :]) == {4096.0}  # 4500 of 6000 kPa
    drive = ffi.new("raptor_wired_out *", {"throttle_demand": 0.5, "ignition": True})
    assert wires.read(Cell.RAPTOR_OUT, drive) > 0
    assert (drive.throttle_demand, drive.ignition) == (0.0, False)


def test_a_space_drive_that_is_stopped_lets_go_of_nothing(tmp_path: Path, wires: WiredIo):
    """It follows its requests over the bus and its sensors over the wires, until it is stopped."""
    sensors = ffi.new(
        "space_drive_wired_in *",
        {"steer_motor_angle": [0.0] * 3, "brake_pressure": [0.0] * 3, "main_battery": 13.0, "backup_battery": 12.8},
    )
    wires.write(Cell.SPACE_DRIVE_IN, sensors)
    drive = ffi.new("space_drive_wired_out *", {"brake_pressure_demand": -1.0})
    # Slow, so that no stall of this machine is a time-out to the firmware.
    with EcuProcess("space-drive", tmp_path, f"--wired={tmp_path}/wires", "--period=100000") as ecu:
        assert ecu.hear(Bus.CAN3, "stat_brk_1")["emr_brk"] == 0
        released = False
        counter = 0
        end = monotonic() + LIMIT_S
        while not released:
            assert monotonic() < end
            counter += 1
            ecu.say(Bus.CAN3, frame("req_steer_pos", counter, cntrl_pos=0x4000),
                    frame("req_brake_pos", counter, contrl_pos_brk=0x3000))  # fmt: skip
            ecu.hear(Bus.CAN3, "calb_brake_pos_1")
            wires.read(Cell.SPACE_DRIVE_OUT, drive)
            released = 0.0 <= drive.brake_pressure_demand < 2.0e6
        assert ecu.stop() == 0
        assert named(ecu.rest(Bus.CAN3), "stat_brk_1")[-1]["emr_brk"] == 1
    wires.read(Cell.SPACE_DRIVE_OUT, drive)
    assert drive.brake_pressure_demand == FULL_BRAKE_PA


def test_an_ecu_that_is_stopped_before_its_first_cycle_sends_nothing(tmp_path: Path):
    with EcuProcess("obc", tmp_path, f"--epoch={monotonic_ns() + 50_000_000_000}") as ecu:
        assert ecu.stop() == 0
        assert [ecu.rest(bus) for bus in BUSES["obc"]] == [[], [], []]


def test_an_ecu_ends_with_its_parent(tmp_path: Path):
    hub = HubSocket(tmp_path / "hub")
    command = [str(program("raceloop-space-drive")), f"--bus=CAN3={hub.address}", "--with-parent"]
    parent = subprocess.Popen(
        [sys.executable, "-c", "import subprocess, sys; subprocess.run(sys.argv[1:])", *command],
        stderr=subprocess.DEVNULL,
    )
    peer = hub.accept()
    peer.welcome()
    peer.packet()
    parent.kill()
    parent.wait()
    frames = []
    end = monotonic() + LIMIT_S
    while packet := peer.packet():
        frames += packet
        if monotonic() > end:
            os.kill(peer.process, signal.SIGKILL)
            pytest.fail("it goes on")
    assert named(frames, "stat_brk_1")[-1]["emr_brk"] == 1
    peer.close()
    hub.close()


# --- trouble on the bus ---


def test_a_second_sender_is_named_once_and_counted(tmp_path: Path):
    with EcuProcess("obc", tmp_path, f"--cycle-log={tmp_path}/log") as ecu:
        for counter in range(20):
            ecu.say(Bus.CAN1, frame("brake_pressure_cmd", counter), frame("accelerator_cmd", counter))
        ecu.wait_for_line("CAN1: another station sends accelerator_cmd (0x579): is a second obc on the bus?")
        for counter in range(20):
            ecu.say(Bus.CAN1, frame("steering_cmd", counter))
        ecu.say(Bus.CAN_A, frame("ssm_status"))
        ecu.wait_for_line("CANA: another station sends ssm_status (0x40): is a second obc on the bus?")
        assert ecu.stop() == 0
        assert len(ecu.lines("another station")) == 2
        assert ecu.counts("CAN1")["from a second sender"] == 60
        assert ecu.counts("CANA")["from a second sender"] == 1
        assert ecu.counts("CANS")["from a second sender"] == 0
    shown = read_cycle_log(tmp_path / "log").records["frames_in"]
    assert 2 <= shown.sum() < 60
    assert shown.max() <= 2, "of each bus one a cycle is shown to the firmware"


def test_a_hub_that_vanishes_and_returns(tmp_path: Path):
    with EcuProcess("raptor", tmp_path) as ecu:
        ecu.hub.close()
        for peer in ecu.peers.values():
            peer.close()
        for bus in ("CAN1", "CAN3"):
            ecu.wait_for_line(f"{bus}: {ecu.hub.address} went down: ")
        ecu.hub = HubSocket(tmp_path / "hub")
        ecu.join()
        for bus in ("CAN1", "CAN3"):
            ecu.wait_for_line(f"{bus}: {ecu.hub.address} is up again after ")
        ecu.hear(Bus.CAN1, "misc_report")
        ecu.hear(Bus.CAN3, "req_brake_pos")
        assert ecu.stop() == 0
        for bus in ("CAN1", "CAN3"):
            counts = ecu.counts(bus)
            assert counts["outages"] == 1
            assert counts["undelivered"] > 0
        assert len(ecu.log) == 1 + 4 + 1 + 3, "one line per change"


def test_a_hub_that_reads_too_slowly_costs_frames_and_no_time(tmp_path: Path):
    with EcuProcess("space-drive", tmp_path, "--period=1000") as ecu:
        ecu.wait_for_line("CAN3: ")
        assert ecu.stop() == 0
        assert len(ecu.lines("takes no more frames, the send queue is full; what is refused is dropped")) == 1
        assert ecu.counts("CAN3")["refused"] > 0
        assert ecu.counts("CAN3")["outages"] == 0


def test_frames_that_waited_too_long_are_not_shown_to_the_firmware(tmp_path: Path):
    """A process that was stopped for a while does not take the past for the present."""
    with EcuProcess("obc", tmp_path, f"--cycle-log={tmp_path}/log") as ecu:
        ecu.hear(Bus.CAN1, "brake_pressure_cmd")
        ecu.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, ecu.process.pid, os.WSTOPPED | os.WNOWAIT)
        ecu.say(Bus.CAN1, *(frame("misc_report", counter) for counter in range(7)))
        end_ns = monotonic_ns() + 150_000_000
        while monotonic_ns() < end_ns:
            pass
        ecu.say(Bus.CAN1, frame("pt_report_1"))
        ecu.process.send_signal(signal.SIGCONT)
        ecu.wait_for_line("CAN1: frames waited for more than 100 ms and are dropped")
        assert ecu.stop() == 0
        late = ecu.counts("CAN1")["late"]
        assert late in (7, 8)
        assert ecu.counts("cycles")["skipped"] >= 10
    assert int(read_cycle_log(tmp_path / "log").records["frames_in"].sum()) == 8 - late


def test_a_flood_is_bounded_and_counted(tmp_path: Path):
    with EcuProcess("obc", tmp_path, f"--cycle-log={tmp_path}/log", "--period=100000") as ecu:
        ecu.hear(Bus.CAN1, "brake_pressure_cmd")
        ecu.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, ecu.process.pid, os.WSTOPPED | os.WNOWAIT)
        for _ in range(10):
            ecu.say(Bus.CAN1, *(frame("misc_report", counter) for counter in range(60)))
        ecu.say(Bus.CAN_S, frame("imu_rates"))
        ecu.process.send_signal(signal.SIGCONT)
        ecu.wait_for_line("CAN1: more than 256 frames came in one cycle, the others are dropped")
        assert ecu.stop() == 0
        counts = ecu.counts("CAN1")
        assert counts["received"] == 600
        assert counts["too many at once"] + counts["late"] == 600 - 256
    records = read_cycle_log(tmp_path / "log").records
    assert int(records["frames_in"].max()) == 256 + 1, "the other buses are heard all the same"


def test_nobody_reads_the_log(tmp_path: Path):
    """A full pipe on standard error delays no cycle and ends nothing."""
    hub = HubSocket(tmp_path / "hub")
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    with suppress(BlockingIOError):
        while True:
            os.write(write_end, bytes(4096))
    os.set_blocking(write_end, True)
    command = [program("raceloop-space-drive"), f"--bus=CAN3={hub.address}"]
    process = subprocess.Popen(command, stderr=write_end)
    try:
        peer = hub.accept()
        peer.welcome()
        for _ in range(20):
            assert peer.packet()
        process.terminate()
        assert process.wait(LIMIT_S) == 0
    finally:
        process.kill()
        process.wait()
    for end in (read_end, write_end):
        os.close(end)
    peer.close()
    hub.close()
