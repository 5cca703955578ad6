"""A Debian kernel for the guest: the newest that apt knows, reduced to its image and the modules needed."""

from __future__ import annotations

import lzma
import os
import re
import subprocess
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from dbc.errors import RaceloopError

MODULES = ("virtio_pci", "9pnet_virtio", "9p", "overlay", "vcan", "can_raw", "can_bcm")
"""What the guest loads, with what these depend on."""

ENGLISH = {**os.environ, "LC_ALL": "C.UTF-8"}


@dataclass(frozen=True)
class KernelPackage:
    """A Debian package that holds a kernel."""

    name: str
    version: str

    def __str__(self) -> str:
        return f"{self.name} {self.version}"


@dataclass(frozen=True)
class Kernel:
    """A kernel that QEMU can boot.

    Attributes
    ----------
    package : where it comes from.
    image : the bootable file.
    modules : modules in the order of loading, not compressed.
    """

    package: KernelPackage
    image: Path
    modules: tuple[Path, ...]


def newest(metapackage: str) -> KernelPackage:
    """Ask apt's lists which kernel a package such as linux-image-amd64 stands for.

    Raises
    ------
    RaceloopError
        apt is not there or does not know the package.
    """
    depends = re.search(r"^ *Depends: (linux-image-\S+)$", _apt("apt-cache", "depends", metapackage), re.MULTILINE)
    if depends is None:
        raise RaceloopError(f"apt does not know {metapackage}; run: sudo apt-get update (this needs Debian's kernels)")
    shown = _apt("apt-cache", "show", "--no-all-versions", depends[1])
    version = re.search(r"^Version: (\S+)$", shown, re.MULTILINE)
    if version is None:
        raise RaceloopError(f"apt does not know {depends[1]}; run: sudo apt-get update")
    return KernelPackage(depends[1], version[1])


def fetch(package: KernelPackage, cache: Path) -> Kernel:
    """Take a kernel from the cache, or download it into the cache.

    Raises
    ------
    RaceloopError
        It cannot be downloaded.
    """
    folder = cache / f"{package.name}_{package.version}_{zlib.crc32(' '.join(MODULES).encode()):08x}"
    if not (folder / "modules").exists():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache, prefix="unpacking-") as scratch:
            _unpack(package, Path(scratch))
            (Path(scratch) / "kernel").rename(folder)
    return Kernel(package, folder / "vmlinuz", tuple(sorted((folder / "modules").iterdir())))


def _unpack(package: KernelPackage, scratch: Path) -> None:
    """Make the folder `kernel` in the scratch folder: the image and the modules, numbered in the order of loading."""
    _apt("apt-get", "download", "--quiet", f"{package.name}={package.version}", folder=scratch)
    (archive,) = scratch.glob("*.deb")
    tree = scratch / "tree"
    subprocess.run(["dpkg", "-x", archive, tree], check=True)
    if not (tree / "lib").exists():
        (tree / "lib").symlink_to("usr/lib")
    release = package.name.removeprefix("linux-image-")
    subprocess.run(["/sbin/depmod", "-b", tree, release], check=True)
    needed: dict[str, None] = {}
    for module in MODULES:
        command = ["/sbin/modprobe", "--dirname", str(tree), "--set-version", release, "--show-depends", module]
        shown = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        needed |= dict.fromkeys(re.findall(r"^insmod (.*\S)", shown, re.MULTILINE))
    (scratch / "kernel" / "modules").mkdir(parents=True)
    for number, file in enumerate(map(Path, needed)):
        content = lzma.decompress(file.read_bytes()) if file.suffix == ".xz" else file.read_bytes()
        (scratch / "kernel" / "modules" / f"{number:02d}-{file.name.removesuffix('.xz')}").write_bytes(content)
    (tree / "boot" / f"vmlinuz-{release}").rename(scratch / "kernel" / "vmlinuz")


def _apt(*command: str, folder: Path | None = None) -> str:
    """Run a command of apt; its last complaint becomes the error."""
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=folder, env=ENGLISH)
    except FileNotFoundError:
        raise RaceloopError(f"no command {command[0]}: the test machine takes its kernel from Debian") from None
    if done.returncode != 0:
        complaints = [line for line in done.stderr.splitlines() if line.startswith("E:")] or ["E: failed"]
        raise RaceloopError(f"{' '.join(command)}: {complaints[-1]}; sudo apt-get update may help")
    return done.stdout
