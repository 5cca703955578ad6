"""CAN interfaces of this machine: what a run over SocketCAN finds, and what it may create."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import socket
import struct
import subprocess
from collections.abc import Iterable
from enum import Enum, auto

from dbc.errors import BusError

_SIOCGIFFLAGS = 0x8913
_SIOCGIFHWADDR = 0x8927
_IFREQ = struct.Struct("16sH22x")
"""``struct ifreq`` with the 16-bit number that both requests answer: the flags, or the kind of hardware."""
_IFF_UP = 1
_ARPHRD_CAN = 280
_NAME_MAX = 15
SYSTEM_FOLDERS = ("/usr/sbin", "/sbin")
"""Where `ip` may be though it is not in the PATH of an ordinary user."""


class Interface(Enum):
    """What a name stands for on this machine."""

    UP = auto()
    DOWN = auto()
    NOT_CAN = auto()
    ABSENT = auto()


def kernel_has_can() -> bool:
    """Whether a program can open a raw CAN socket; the kernel loads its modules for that by itself."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError):
        return False
    return True


def find_interface(name: str) -> Interface:
    """Look an interface up in this network namespace."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as any_socket:
        try:
            hardware, flags = (_ask(any_socket, request, name) for request in (_SIOCGIFHWADDR, _SIOCGIFFLAGS))
        except OSError as error:
            if error.errno != errno.ENODEV:
                raise
            return Interface.ABSENT
    if hardware != _ARPHRD_CAN:
        return Interface.NOT_CAN
    return Interface.UP if flags & _IFF_UP else Interface.DOWN


def _ask(any_socket: socket.socket, request: int, name: str) -> int:
    answer = fcntl.ioctl(any_socket, request, _IFREQ.pack(name.encode(), 0))
    number: int = _IFREQ.unpack(answer)[1]
    return number


def ensure_interfaces(names: Iterable[str]) -> None:
    """See to it that CAN interfaces exist and are up; create the missing vcan interfaces where that is allowed.

    An interface that exists is never changed. When one cannot be created, those created before it are removed again.

    Parameters
    ----------
    names : interfaces; a missing one is created if its name begins with "vcan".

    Raises
    ------
    BusError
        The kernel has no CAN or no vcan, an interface is down, absent or no CAN interface, or creating it is not
        allowed; the text names the command that helps.
    """
    if not kernel_has_can():
        raise BusError("no CAN in this kernel; a run with --bus hub needs none")
    absent = []
    for name in names:
        found = find_interface(name) if 0 < len(name.encode()) <= _NAME_MAX else Interface.ABSENT
        if found is Interface.DOWN:
            raise BusError(f"CAN interface {name} is down; run: sudo ip link set dev {name} up")
        if found is Interface.NOT_CAN:
            raise BusError(f"{name} is not a CAN interface; give one, or a name such as vcan0 to have it created")
        if found is Interface.ABSENT:
            if not name.startswith("vcan"):
                raise BusError(f"CAN interface {name} does not exist; only names that begin with vcan are created")
            absent.append(name)
    if absent:
        _create(absent)


def _create(names: list[str]) -> None:
    ip = shutil.which("ip", path=os.pathsep.join((os.environ.get("PATH", os.defpath), *SYSTEM_FOLDERS)))
    if ip is None:
        raise BusError(f"no command ip to create {names[0]}; install iproute2, or use --bus hub")
    created: list[str] = []
    try:
        for name in names:
            _link(ip, names, "add", "dev", name, "type", "vcan")
            created.append(name)
            _link(ip, names, "set", "dev", name, "up")
    except BusError:
        for name in created:
            subprocess.run([ip, "link", "del", "dev", name], check=False, capture_output=True)
        raise


def _link(ip: str, names: list[str], *words: str) -> None:
    done = subprocess.run(
        [ip, "link", *words], check=False, capture_output=True, text=True, env={**os.environ, "LC_ALL": "C"}
    )
    if done.returncode == 0:
        return
    reason = " ".join(done.stderr.split())
    if "not permitted" in reason:
        raise BusError(f"no permission to create {names[0]}; run: {_commands(names)}")
    if "not supported" in reason or "Unknown device type" in reason:
        raise BusError(f"this kernel has no vcan loaded; run: sudo modprobe vcan && {_commands(names)}")
    raise BusError(f"ip link {' '.join(words)}: {reason}")


def _commands(names: list[str]) -> str:
    return " && ".join(f"sudo ip link add dev {name} type vcan && sudo ip link set dev {name} up" for name in names)
