"""One run of the guest: QEMU started, its output followed, its end judged."""

from __future__ import annotations

import os
import shlex
import shutil
import stat
import struct
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from dbc.errors import RaceloopError
from tools.vcan_machine.kernel import Kernel

INIT = Path(__file__).with_name("init.sh")
PROGRAMS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "busybox": "busybox-static",
    "depmod": "kmod",
    "dpkg": "dpkg",
    "setpriv": "util-linux",
}
"""What a run needs of the host, and the Debian package of each."""
FOLDERS = ("bin", "dev", "guest", "host", "layer", "modules", "proc", "sys")
"""What init.sh mounts onto or reads from."""
# A panic ends QEMU at once; the emulated cycle counter is the host's, so it needs no checking against slower clocks.
KERNEL_PARAMETERS = "console=ttyS0 quiet panic=-1 oops=panic mitigations=off tsc=reliable"
DEBUG_EXIT_STATUS_MAX = 126
CONSOLE_TAIL = 50
POLL_S = 0.1
_PT_INTERP = 3
SYSTEM_PATH = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"))


class MachineError(RaceloopError):
    """The guest did not get to its end: it panicked, hung or could not be started."""


def missing_programs(programs: Mapping[str, str]) -> list[str]:
    """Debian packages of the programs that are not there."""
    return sorted({package for program, package in programs.items() if shutil.which(program, path=SYSTEM_PATH) is None})


def run_in_guest(
    kernel: Kernel,
    command: Sequence[str],
    results: Path,
    timeout_s: float,
    follow: Callable[[bytes], object],
    environment: Mapping[str, str] | None = None,
) -> int:
    """Boot the guest, run a command in it as root, power it off.

    Parameters
    ----------
    kernel : what to boot.
    command : program and arguments; paths and working folder are the host's.
    results : folder that the guest sees, writable, as /results; emptied first. The command's output is left in the
        file output, the kernel's messages in console.
    timeout_s : seconds after which QEMU is killed.
    follow : gets the output as it comes.
    environment : variables of the command, besides PATH, HOME and TMPDIR.

    Returns
    -------
    Exit status of the command.

    Raises
    ------
    MachineError
        The guest did not end by itself within its time, or its end left no trustworthy exit status.
    """
    shutil.rmtree(results, ignore_errors=True)
    results.mkdir(parents=True)
    variables = {
        "PATH": SYSTEM_PATH,
        "HOME": "/dev/shm",
        "TMPDIR": "/dev/shm",
        "LANG": "C.UTF-8",
        **(environment or {}),
    }
    lines = [
        *(f"export {name}={shlex.quote(value)}" for name, value in variables.items()),
        f"cd {shlex.quote(os.getcwd())} || exit",
        f"exec {shlex.join(command)}",
    ]
    (results / "command").write_text("\n".join(lines) + "\n")
    (results / "output").touch()
    (results / "console").touch()
    (results / "initrd").write_bytes(make_initrd(kernel))
    deadline = time.monotonic() + timeout_s
    with (results / "output").open("rb") as output, (results / "qemu").open("wb") as complaints:
        # The kernel's parent-death signal ends QEMU even if this program is killed.
        qemu = subprocess.Popen(
            ["setpriv", "--pdeathsig", "KILL", *_qemu(kernel, results)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=complaints,
        )
        try:
            while qemu.poll() is None and time.monotonic() < deadline:
                follow(output.read())
                time.sleep(POLL_S)
            follow(output.read())
            if qemu.returncode is None:
                raise MachineError(f"not finished after {timeout_s:.0f} s, killed{_tail(results)}")
        finally:
            qemu.kill()
            qemu.wait()
    try:
        return judge((results / "status").read_text(), qemu.returncode)
    except FileNotFoundError:
        raise MachineError(f"ended with no exit status of the command{_tail(results)}") from None


def judge(status_file: str, qemu_status: int) -> int:
    """Exit status of the command: the file says it, and QEMU must have ended by the same word.

    QEMU's own status alone proves nothing: it is 0 after a panic.

    Raises
    ------
    MachineError
        The two differ, or the file holds no status.
    """
    if not status_file.strip().isdecimal():
        raise MachineError(f"the file with the exit status holds {status_file!r}")
    status = int(status_file)
    if qemu_status != 2 * min(status, DEBUG_EXIT_STATUS_MAX) + 1:
        raise MachineError(f"the command ended with {status}, but QEMU with {qemu_status}")
    return status


def _qemu(kernel: Kernel, results: Path) -> list[str]:
    share = "security_model=none,multidevs=remap"
    return [
        *("qemu-system-x86_64", "-no-user-config", "-nodefaults", "-display", "none", "-no-reboot"),
        # Without monitor the guest idles by halting: QEMU emulates mwait on several processors by spinning.
        *("-accel", "tcg,thread=multi", "-cpu", "max,monitor=off", "-smp", "2", "-m", "2G"),
        *("-kernel", str(kernel.image), "-initrd", str(results / "initrd")),
        *("-append", KERNEL_PARAMETERS),
        *("-serial", f"file:{results / 'console'}"),
        *("-virtfs", f"local,path=/,mount_tag=host,readonly=on,{share}"),
        *("-virtfs", f"local,path={str(results).replace(',', ',,')},mount_tag=results,{share}"),
        *("-device", "isa-debug-exit,iobase=0x501,iosize=1"),
    ]


def make_initrd(kernel: Kernel) -> bytes:
    """Archive of what the guest starts from: busybox, the first process, the modules.

    Raises
    ------
    RaceloopError
        busybox needs libraries; it has to stand alone.
    """
    busybox = Path(shutil.which("busybox", path=SYSTEM_PATH) or "busybox").read_bytes()
    if not is_static(busybox):
        raise RaceloopError("busybox is not the static one; run: sudo apt-get install busybox-static")
    folders = [(name, stat.S_IFDIR | 0o755, b"") for name in FOLDERS]
    files = [
        ("init", stat.S_IFREG | 0o755, INIT.read_bytes()),
        ("bin/busybox", stat.S_IFREG | 0o755, busybox),
        *((f"modules/{module.name}", stat.S_IFREG | 0o644, module.read_bytes()) for module in kernel.modules),
    ]
    return newc([*folders, *files])


def is_static(executable: bytes) -> bool:
    """Whether a 64-bit ELF file names no interpreter to load libraries for it."""
    (offset,) = struct.unpack_from("<Q", executable, 32)
    size, count = struct.unpack_from("<HH", executable, 54)
    return all(struct.unpack_from("<I", executable, offset + i * size)[0] != _PT_INTERP for i in range(count))


def newc(entries: Sequence[tuple[str, int, bytes]]) -> bytes:
    """Make a cpio archive in the one format that the kernel unpacks; entries are name, mode and content."""
    archive = bytearray()
    for inode, (name, mode, content) in enumerate([*entries, ("TRAILER!!!", 0, b"")], 1):
        numbers = (inode, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name) + 1, 0)
        for part in (b"070701" + b"".join(b"%08x" % number for number in numbers) + name.encode() + b"\0", content):
            archive += part
            archive += bytes(-len(archive) % 4)
    return bytes(archive)


def _tail(results: Path) -> str:
    """The last lines of the kernel's messages and QEMU's own, to be put under an error."""
    lines = [
        *(results / "console").read_text(errors="replace").splitlines()[-CONSOLE_TAIL:],
        *(results / "qemu").read_text(errors="replace").splitlines()[-CONSOLE_TAIL:],
    ]
    return "".join(f"\n  | {line}" for line in lines)
