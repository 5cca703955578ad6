"""Load from stress-ng."""

from __future__ import annotations

from pathlib import Path

from tools.jitter.background import Background, find_program

#: Debian package.
PACKAGE = "stress-ng"

#: What stress-ng is asked for. 0: as many as there are cores.
LOADS: dict[str, tuple[str, ...]] = {
    "cpu": ("--cpu", "0"),
    "memory": ("--vm", "0", "--vm-bytes", "256M", "--cache", "1"),
    "kernel": ("--switch", "0", "--timer", "1", "--fault", "1"),
    "io": ("--hdd", "1", "--hdd-bytes", "64M", "--iomix", "1", "--iomix-bytes", "64M"),
}
LOADS["all"] = tuple(word for load in list(LOADS.values()) for word in load)


def start_load(name: str, seconds: float, folder: Path) -> Background | None:
    """Start a load that ends by itself; None when there is no stress-ng.

    Parameters
    ----------
    name : one of `LOADS`.
    seconds : how long at most.
    folder : for its temporary files.
    """
    program = find_program("stress-ng")
    if program is None:
        return None
    timeout = ["--timeout", f"{seconds:.0f}s", "--temp-path", str(folder), "--quiet"]
    return Background("stress-ng", [program, *LOADS[name], *timeout])
