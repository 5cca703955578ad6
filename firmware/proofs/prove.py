"""Prove properties of the firmware with CBMC, Debian's bounded model checker, and that each proof can fail.

Each row of PROOFS is a function of this folder. CBMC takes it for every value of what it draws, checks what it
states, and checks every array bound, pointer, shift and signed sum on the way; loops are unwound completely (else that
is a failure). Then one line of the code under proof is broken in a copy, and the proof must fail.

    make prove          python firmware/proofs/prove.py [PROOF...]
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from firmware.tables import load_faults, load_parameters

FIRMWARE = Path(__file__).resolve().parents[1]
ROOT = FIRMWARE.parent
BUILD = ROOT / "build" / "proofs"
SUITE = "trixie"
"""Release of Debian whose cbmc is used: bookworm has none."""

PACKAGES = ("cbmc", "minisat", "libc6", "libgcc-s1", "libstdc++6", "zlib1g")
LIMIT_S = 600

MODELS = ("-D__builtin_isfinite=__CPROVER_isfinitef",)
"""What glibc's headers expand to and CBMC has by another name."""


@dataclass(frozen=True)
class Proof:
    """One function that states properties.

    Attributes
    ----------
    name : of the function, without `proof_`.
    text : what it proves.
    sources : of this folder, of the firmware, of the generated tables.
    unwind : iterations of the longest loop, plus one.
    broken : file, what is replaced in it once, and by what: then the proof must fail.
    """

    name: str
    text: str
    sources: tuple[str, ...]
    unwind: int
    broken: tuple[str, str, str]


_CODEC = ("proofs/codec_proofs.c", "common/codec.c", "generated/codec_table.c")
_OUTBOX = ("proofs/outbox_proofs.c", "common/can_frame.c")
_VOTER = ("proofs/voter_proofs.c", "common/voter.c")
_FAULTS = ("proofs/fault_monitor_proofs.c", "obc/fault_monitor.c", "obc/ssm.c", "generated/fault_table.c")
_FAULT_LOOP = len(load_faults()) + 2
_PARAMETERS = ("proofs/parameters_proofs.c", "obc/parameters.c", "generated/parameter_table.c")
_PARAMETER_LOOP = len(load_parameters().parameters) + 1

PROOFS = (
    Proof(
        "find", "codec_find: every row by its address, nothing else", _CODEC, 9,
        ("common/codec.c", "low = middle + 1U", "low = middle + 2U"),
    ),
    Proof(
        "receive", "codec_receive: a refused frame refreshes nothing", _CODEC, 9,
        ("common/codec.c", "return stuck ? CODEC_COUNTER_STUCK : CODEC_OK", "return CODEC_OK"),
    ),
    Proof(
        "finish", "codec_finish: the counter goes round, no other bit written", _CODEC, 9,
        ("common/codec.c", "(load_data(data) & ~mask)", "(load_data(data) & mask)"),
    ),
    Proof(
        "clamp", "codec_clamp: in range for every float", _CODEC, 2,
        ("common/codec.c", "if (isnan(value))", "if (isinf(value))"),
    ),
    Proof(
        "timed_out", "codec_timed_out: stale behind the time-out, not before", _CODEC, 2,
        ("common/codec.c", "reference_us > (uint64_t)", "reference_us >= (uint64_t)"),
    ),
    Proof(
        "clock_set_back", "codec_timed_out: stale after the clock was set back", _CODEC, 2,
        ("common/codec.c", "return now_us - reference_us >", "return now_us > reference_us && now_us - reference_us >"),
    ),
    Proof(
        "outbox", "can_outbox_add: never more than fit, losses counted", _OUTBOX, 4,
        ("common/can_frame.c", "out->count >= out->capacity", "out->count > out->capacity"),
    ),
    Proof(
        "debounce", "debounce: holds exactly as long as asked", ("proofs/debounce_proofs.c", "common/debounce.c"), 2,
        ("common/debounce.c", ">= hold_us", "> hold_us"),
    ),
    Proof(
        "vote", "voter: two make a vote, only voters deviate", _VOTER, 4,
        ("common/voter.c", "usable[i] && fabsf", "fabsf"),
    ),
    Proof(
        "median", "voter: one channel has no say against two", _VOTER, 4,
        ("common/voter.c", "fmaxf(a, b), c)", "fmaxf(a, c), b)"),
    ),
    Proof(
        "fault_step", "faults: debounce, latch, clear, event ring", _FAULTS, _FAULT_LOOP,
        ("obc/fault_monitor.c", "row->latch == FAULT_LATCH_UNTIL_RESTART ||", ""),
    ),
    Proof(
        "worst", "faults: the most severe reaction wins", _FAULTS, _FAULT_LOOP,
        ("obc/fault_monitor.c", "reaction > fault_table[worst]", "reaction < fault_table[worst]"),
    ),
    Proof(
        "share", "faults: the least share of the limits counts", _FAULTS, _FAULT_LOOP,
        ("obc/fault_monitor.c", "share->speed < least.speed", "share->speed > least.speed"),
    ),
    Proof(
        "ssm", "SSM: FULL_BRAKE absorbing, no way around the launch", _FAULTS, _FAULT_LOOP,
        ("obc/ssm.c", "    default:\n        return SSM_FULL_BRAKE;", "    default:\n        return SSM_BOOT;"),
    ),
    Proof(
        "check", "parameters: what is accepted is inside its row", _PARAMETERS, 2,
        ("obc/parameters.c", "if (!isfinite(value->real))", "if (isinf(value->real))"),
    ),
    Proof(
        "commit", "parameters: all or nothing, once", _PARAMETERS, _PARAMETER_LOOP,
        ("obc/parameters.c", "self->rejected == 0U && self->missing == 0U", "self->missing == 0U"),
    ),
)  # fmt: skip


def fetch_cbmc() -> list[str]:
    """Command that runs CBMC: the installed one, or SUITE's, unpacked beside the libraries that it needs."""
    if installed := shutil.which("cbmc"):
        return [installed]
    tree = BUILD / "cbmc"
    if not tree.exists():
        BUILD.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=BUILD, prefix="unpacking-") as scratch:
            _unpack(Path(scratch))
            (Path(scratch) / "tree").rename(tree)
    libraries = tree / "usr" / "lib" / "x86_64-linux-gnu"
    loader = libraries / "ld-linux-x86-64.so.2"
    return [str(loader), "--library-path", f"{libraries}:{tree / 'usr' / 'lib'}", str(tree / "usr" / "bin" / "cbmc")]


def _unpack(scratch: Path) -> None:
    mirror = re.search(
        r"^(?:Types: deb\n(?:#.*\n)*URIs: |deb (?:\[.*\] )?)(\S+debian/?)(?:\s|$)", _apt_sources(), re.MULTILINE
    )
    if mirror is None:
        sys.exit("no Debian mirror in apt's sources, and no cbmc: install it")
    (scratch / "lists" / "partial").mkdir(parents=True)
    (scratch / "cache" / "archives" / "partial").mkdir(parents=True)
    key = "/usr/share/keyrings/debian-archive-keyring.gpg"
    (scratch / "sources.list").write_text(f"deb [signed-by={key}] {mirror[1]} {SUITE} main\n")
    options = [
        "-q", "-o", f"Dir::Etc::sourcelist={scratch}/sources.list", "-o", "Dir::Etc::sourceparts=-",
        "-o", f"Dir::State::lists={scratch}/lists", "-o", f"Dir::Cache={scratch}/cache",
    ]  # fmt: skip
    for action in (["update"], ["download", *PACKAGES]):
        done = subprocess.run(["apt-get", *options, *action], check=False, capture_output=True, text=True, cwd=scratch)
        if done.returncode != 0:
            sys.exit(f"apt-get {action[0]}: {done.stderr}")
    for package in scratch.glob("*.deb"):
        subprocess.run(["dpkg-deb", "-x", package, scratch / "tree"], check=True)


def _apt_sources() -> str:
    places = [Path("/etc/apt/sources.list"), *sorted(Path("/etc/apt/sources.list.d").glob("*"))]
    return "\n".join(place.read_text() for place in places if place.is_file())


def run_cbmc(cbmc: list[str], proof: Proof, firmware: Path, generated: Path) -> tuple[bool, str]:
    """Whether the proof holds for the code in `firmware`, and CBMC's text."""
    sources = [(generated if name.startswith("generated") else firmware) / name for name in proof.sources]
    command: list[str | Path] = [
        *cbmc, "--c11", *MODELS, "--pointer-overflow-check", "--slice-formula", "-I", firmware, "-I", generated,
        "--function", f"proof_{proof.name}", "--unwind", str(proof.unwind), *sources,
    ]  # fmt: skip
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        return False, f"not done within {LIMIT_S} s"
    if done.returncode not in (0, 10):
        sys.exit(done.stdout + done.stderr)
    return done.returncode == 0, done.stdout


def broken_copy(proof: Proof, folder: Path) -> Path:
    """A copy of the firmware with the proof's one line broken."""
    copy = folder / proof.name
    shutil.copytree(FIRMWARE, copy, ignore=shutil.ignore_patterns("*.py", "*.yaml", "ports", "__pycache__"))
    name, good, bad = proof.broken
    text = (copy / name).read_text()
    if text.count(good) != 1:
        sys.exit(f"{name}: {good!r} is there {text.count(good)} times; PROOFS needs a line that is there once")
    (copy / name).write_text(text.replace(good, bad))
    return copy


def prove(cbmc: list[str], proof: Proof, generated: Path, scratch: Path) -> bool:
    """Prove, and break; print a row of the table."""
    begun = time.monotonic()
    holds, text = run_cbmc(cbmc, proof, FIRMWARE, generated)
    seconds = time.monotonic() - begun
    properties = re.search(r"\*\* (\d+) of (\d+) failed", text)
    can_fail = not run_cbmc(cbmc, proof, broken_copy(proof, scratch), generated)[0]
    total = time.monotonic() - begun - seconds
    print(
        f"{proof.name:<15} {proof.text:<56} {'holds' if holds else 'FAILS':<6} "
        f"{properties[2] if properties else '?':>5} "
        f"{seconds:>6.1f} s   {'fails' if can_fail else 'HOLDS':<5} {total:>6.1f} s",
        flush=True,
    )
    if not holds:
        print("\n".join(line for line in text.splitlines() if line.endswith("FAILURE")) or text[-500:])
    return holds and can_fail


def main() -> int:
    """Prove what the command line names; 1 when a proof fails, or cannot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="proofs at once (default: processors)")
    parser.add_argument("names", nargs="*", metavar="PROOF", help="(default: all)")
    options = parser.parse_args()
    if unknown := set(options.names) - {proof.name for proof in PROOFS}:
        parser.error(f"no proof {', '.join(sorted(unknown))}; there are {', '.join(proof.name for proof in PROOFS)}")
    cbmc = fetch_cbmc()
    for package in ("firmware", "dbc"):
        subprocess.run([sys.executable, "-m", f"{package}.generate", "--out", BUILD], check=True, cwd=ROOT)
    print(f"{'proof':<15} {'property':<56} verdict checks  time   broken copy")
    chosen = [proof for proof in PROOFS if not options.names or proof.name in options.names]
    with tempfile.TemporaryDirectory(dir=BUILD, prefix="broken-") as scratch, ThreadPoolExecutor(options.jobs) as pool:
        verdicts = list(pool.map(lambda proof: prove(cbmc, proof, BUILD, Path(scratch)), chosen))
    print(f"{sum(verdicts)} of {len(verdicts)} hold, and fail on a broken copy")
    return 0 if all(verdicts) else 1


if __name__ == "__main__":
    sys.exit(main())
