"""A C program without libm and without Python loads the FMU and gets the same bits."""

from __future__ import annotations

import re
import shutil
import subprocess
import zipfile
from pathlib import Path

import fmpy
import pytest

from plant_fmu import fmu_path, package
from plant_fmu.driver import Plant, read_description

HOST = package.HERE / "examples" / "c_host.c"
HEADERS = Path(fmpy.__file__).parent / "c-code"
STEPS = 500
VARIABLES = ("gear_demand", "ignition", "engine_running0", "gear0", "v0", "throttle_demand", "vx")


def unpack(folder: Path) -> tuple[Path, str]:
    """The library and the token of the FMI 3.0 FMU."""
    with zipfile.ZipFile(fmu_path(3)) as archive:
        archive.extractall(folder)
    library = next((folder / "binaries").rglob("raceloop_plant_fmi3.*"))
    return library, str(read_description(fmu_path(3)).instantiationToken)


def compile_host(folder: Path, compiler: str) -> Path:
    program = folder / "c_host"
    flags = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-isystem", str(HEADERS)]
    subprocess.run([compiler, *flags, str(HOST), "-ldl", "-o", str(program)], check=True)
    return program


def run_host(program: Path, library: Path, token: str) -> tuple[float, float]:
    references = {v.name: v.reference for v in package.read_variables()}
    command = [str(program), str(library), token, str(STEPS)]
    command += [str(references[name]) for name in VARIABLES]
    result = subprocess.run(command, check=True, capture_output=True, text=True)
    match = re.fullmatch(r"vx_m_s=(\S+) us_per_step=(\S+)\n", result.stdout)
    assert match is not None, result.stdout
    return float(match[1]), float(match[2])


@pytest.fixture(scope="module")
def compiler() -> str:
    found = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    assert found is not None, "the build needs a C compiler, so there is one"
    return found


def test_c_host_gets_the_same_speed(tmp_path: Path, compiler: str) -> None:
    library, token = unpack(tmp_path)
    speed, _ = run_host(compile_host(tmp_path, compiler), library, token)
    start = {"v0": 50.0, "gear0": 5, "gear_demand": 5, "engine_running0": True, "ignition": True}
    with Plant(start) as car:
        car.step(STEPS * 0.01, throttle_demand=1.0)
        assert speed == car["vx"]


def test_c_host_reports_a_wrong_token(tmp_path: Path, compiler: str) -> None:
    library, _ = unpack(tmp_path)
    program = compile_host(tmp_path, compiler)
    with pytest.raises(subprocess.CalledProcessError) as error:
        run_host(program, library, "{wrong}")
    assert "wrong instantiationToken" in error.value.stderr


def test_cost_of_a_step(tmp_path: Path, compiler: str) -> None:
    """Median of several runs: 50 us is the promise for a 10 ms step, about 7 us the usual cost."""
    library, token = unpack(tmp_path)
    program = compile_host(tmp_path, compiler)
    costs = sorted(run_host(program, library, token)[1] for _ in range(7))
    assert costs[3] < 50.0, f"median of {costs} us"


def test_sources_inside_the_fmu_compile_to_the_same_model(tmp_path: Path, compiler: str) -> None:
    """Whoever rebuilds the FMU from its own sources gets the same bits."""
    _, token = unpack(tmp_path)
    sources = tmp_path / "sources"
    rebuilt = tmp_path / "rebuilt.so"
    flags = [
        "-std=c11",
        "-O2",
        "-ffp-contract=off",
        "-fPIC",
        "-shared",
        "-fvisibility=hidden",
        "-isystem",
        str(HEADERS),
    ]
    files = [str(sources / name) for name in package.source_files(3)]
    subprocess.run([compiler, *flags, *files, "-lm", "-o", str(rebuilt)], check=True)
    speed, _ = run_host(compile_host(tmp_path, compiler), rebuilt, token)
    start = {"v0": 50.0, "gear0": 5, "gear_demand": 5, "engine_running0": True, "ignition": True}
    with Plant(start) as car:
        car.step(STEPS * 0.01, throttle_demand=1.0)
        assert speed == car["vx"]
