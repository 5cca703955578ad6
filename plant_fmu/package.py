"""Turn variables.def into the FMU's descriptions and pack the FMUs.

Used by the build (see CMakeLists.txt):

    package.py token --out plant_token.h
    package.py pack --fmi 3 --library raceloop_plant_fmi3.so --token-header plant_token.h --out X.fmu
    package.py parameters        # print the vehicle parameters as YAML, to compare or to start from

The FMUs are byte-reproducible: same sources and same library give the same bytes.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import re
import sys
import uuid
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

HERE = Path(__file__).resolve().parent
SOURCE_DIR = HERE / "src"
MODEL_NAME = "raceloop_plant"
DESCRIPTION = "Dallara AV-21 race car: chassis, tyres, engine, gearbox, brakes, steering"
STEP_SIZE = 0.01
ZIP_DATE = (1980, 1, 1, 0, 0, 0)
START_PARAMETERS = frozenset({"x0", "y0", "yaw0", "v0", "gear0", "engine_running0"})
"""Parameters that belong to a run, not to the vehicle."""

MODEL_SOURCES = (
    "model.c",
    "variables.c",
    "tyre.c",
    "chassis.c",
    "engine.c",
    "driveline.c",
    "brakes.c",
    "steering.c",
    "thermal.c",
    "fmi_support.c",
)
WRAPPER_SOURCES = {2: ("fmi2.c", "fmi2_unsupported.c"), 3: ("fmi3.c", "fmi3_unsupported.c")}

# Exponents of the SI base units of every unit used in variables.def.
UNITS: dict[str, dict[str, float]] = {
    "1": {},
    "s": {"s": 1},
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2},
    "m2": {"m": 2},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "kg": {"kg": 1},
    "kg.m2": {"kg": 1, "m": 2},
    "kg/m3": {"kg": 1, "m": -3},
    "N": {"kg": 1, "m": 1, "s": -2},
    "N.m": {"kg": 1, "m": 2, "s": -2},
    "N.m/rad": {"kg": 1, "m": 2, "s": -2, "rad": -1},
    "N.m/s": {"kg": 1, "m": 2, "s": -3},
    "N.m.s/rad": {"kg": 1, "m": 2, "s": -1, "rad": -1},
    "N.m/Pa": {"m": 3},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "Pa/s": {"kg": 1, "m": -1, "s": -3},
    "Hz": {"s": -1},
    "J": {"kg": 1, "m": 2, "s": -2},
    "J/K": {"kg": 1, "m": 2, "s": -2, "K": -1},
    "W/K": {"kg": 1, "m": 2, "s": -3, "K": -1},
    "K/W": {"kg": -1, "m": -2, "s": 3, "K": 1},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "degC": {"K": 1, "offset": 273.15},
}


class DefinitionError(Exception):
    """A line of variables.def is wrong."""


@dataclass(frozen=True)
class Variable:
    """One entry of variables.def; the value reference is its position."""

    reference: int
    type: str
    name: str
    causality: str
    variability: str
    unit: str
    start: str
    min: str
    max: str
    description: str
    source: str

    @property
    def has_start(self) -> bool:
        """Whether the description gives a start value."""
        return self.causality in ("input", "parameter")


_ENTRY = re.compile(
    r"VAR\((?P<type>REAL|INT|BOOL), (?P<name>\w+), (?P<causality>[A-Z]+), (?P<variability>[A-Z]+), "
    r'(?P<unit>"[^"]*"), (?P<start>[^,]+), (?P<min>[^,]+), (?P<max>[^,]+), '
    r'(?P<description>"(?:[^"\\]|\\.)*"), (?P<source>"[^"]*")\)'
)


def read_variables(path: Path = SOURCE_DIR / "variables.def") -> list[Variable]:
    """Parse variables.def; every line that begins with VAR must be a complete entry."""
    variables: list[Variable] = []
    names: set[str] = set()
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        if not line.startswith("VAR("):
            continue
        match = _ENTRY.fullmatch(line)
        if match is None:
            raise DefinitionError(f"{path}:{number}: not a valid VAR entry: {line}")
        fields = match.groupdict()
        unit = str(ast.literal_eval(fields["unit"]))
        if unit not in UNITS and not (unit == "" and fields["type"] != "REAL"):
            raise DefinitionError(f"{path}:{number}: unknown unit {unit!r}; known: {sorted(UNITS)}")
        if fields["name"] in names:
            raise DefinitionError(f"{path}:{number}: {fields['name']} is defined twice")
        names.add(fields["name"])
        variables.append(
            Variable(
                reference=len(variables),
                type=fields["type"],
                name=fields["name"],
                causality=fields["causality"].lower(),
                variability=fields["variability"].lower(),
                unit=unit,
                start=fields["start"],
                min=fields["min"],
                max=fields["max"],
                description=str(ast.literal_eval(fields["description"])),
                source=str(ast.literal_eval(fields["source"])),
            )
        )
    return variables


def vehicle_parameters(variables: Iterable[Variable]) -> list[Variable]:
    """Return the parameters that belong into a vehicle's YAML file."""
    return [v for v in variables if v.causality == "parameter" and v.name not in START_PARAMETERS]


def source_files(fmi: int) -> list[str]:
    """Names of the C files of one FMU, in compile order."""
    return [*MODEL_SOURCES, *WRAPPER_SOURCES[fmi]]


def token() -> str:
    """Identity of the FMU: changes with every source file."""
    digest = hashlib.sha256()
    for path in sorted(SOURCE_DIR.iterdir()):
        if path.suffix in (".c", ".h", ".def"):
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return "{" + str(uuid.UUID(bytes=digest.digest()[:16], version=4)) + "}"


def token_header() -> str:
    """Return the C header that holds the identity."""
    return (
        f'/* Generated by package.py: identity of the FMU, a hash of its sources. */\n#define PLANT_TOKEN "{token()}"\n'
    )


def _number(text: str, fmi_type: str) -> str:
    """Write a C literal as XML Schema wants it."""
    if fmi_type == "BOOL":
        return "true" if int(text) else "false"
    return text


def _limits(variable: Variable) -> str:
    if variable.type == "BOOL":
        return ""
    text = ""
    if variable.min != "NO_MIN":
        text += f' min="{variable.min}"'
    if variable.max != "NO_MAX":
        text += f' max="{variable.max}"'
    return text


def _units(variables: Iterable[Variable]) -> list[str]:
    used = {v.unit for v in variables if v.type == "REAL"}
    lines = ["  <UnitDefinitions>"]
    for unit, exponents in UNITS.items():
        if unit in used:
            attributes = "".join(f' {base}="{value:g}"' for base, value in exponents.items())
            lines.append(f'    <Unit name="{unit}"><BaseUnit{attributes}/></Unit>')
    lines.append("  </UnitDefinitions>")
    return lines


def _log_categories() -> list[str]:
    return [
        "  <LogCategories>",
        '    <Category name="logStatusDiscard" description="Refused values"/>',
        '    <Category name="logStatusError" description="Wrong calls"/>',
        "  </LogCategories>",
    ]


def _identifier(fmi: int) -> str:
    return f"{MODEL_NAME}_fmi{fmi}"


def description_fmi2(variables: list[Variable], guid: str) -> str:
    """modelDescription.xml for FMI 2.0."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        "<fmiModelDescription",
        '  fmiVersion="2.0"',
        f'  modelName="{MODEL_NAME}"',
        f'  guid="{guid}"',
        f"  description={quoteattr(DESCRIPTION)}",
        '  generationTool="raceloop package.py"',
        '  variableNamingConvention="flat"',
        '  numberOfEventIndicators="0">',
        "  <CoSimulation",
        f'    modelIdentifier="{_identifier(2)}"',
        '    canHandleVariableCommunicationStepSize="true"',
        '    canGetAndSetFMUstate="true"',
        '    canSerializeFMUstate="true"',
        '    canNotUseMemoryManagementFunctions="true">',
        "    <SourceFiles>",
        *(f'      <File name="{name}"/>' for name in source_files(2)),
        "    </SourceFiles>",
        "  </CoSimulation>",
        *_units(variables),
        *_log_categories(),
        f'  <DefaultExperiment startTime="0" stopTime="10" stepSize="{STEP_SIZE}"/>',
        "  <ModelVariables>",
    ]
    tags = {"REAL": "Real", "INT": "Integer", "BOOL": "Boolean"}
    for v in variables:
        initial = ' initial="calculated"' if v.causality == "output" else ""
        if v.causality == "parameter":
            initial = ' initial="exact"'
        start = f' start="{_number(v.start, v.type)}"' if v.has_start else ""
        unit = f' unit="{v.unit}"' if v.type == "REAL" else ""
        lines += [
            f'    <!-- {v.reference + 1} --> <ScalarVariable name="{v.name}"'
            f' valueReference="{v.reference}" causality="{v.causality}"'
            f' variability="{v.variability}"{initial} description={quoteattr(v.description)}>'
            f"<{tags[v.type]}{unit}{_limits(v)}{start}/></ScalarVariable>"
        ]
    outputs = [v.reference + 1 for v in variables if v.causality == "output"]
    lines += [
        "  </ModelVariables>",
        "  <ModelStructure>",
        "    <Outputs>",
        *(f'      <Unknown index="{index}"/>' for index in outputs),
        "    </Outputs>",
        "    <InitialUnknowns>",
        *(f'      <Unknown index="{index}"/>' for index in outputs),
        "    </InitialUnknowns>",
        "  </ModelStructure>",
        "</fmiModelDescription>",
        "",
    ]
    return "\n".join(lines)


def description_fmi3(variables: list[Variable], instantiation_token: str) -> str:
    """modelDescription.xml for FMI 3.0."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        "<fmiModelDescription",
        '  fmiVersion="3.0"',
        f'  modelName="{MODEL_NAME}"',
        f'  instantiationToken="{instantiation_token}"',
        f"  description={quoteattr(DESCRIPTION)}",
        '  generationTool="raceloop package.py"',
        '  variableNamingConvention="flat">',
        "  <CoSimulation",
        f'    modelIdentifier="{_identifier(3)}"',
        '    canHandleVariableCommunicationStepSize="true"',
        '    canGetAndSetFMUState="true"',
        '    canSerializeFMUState="true"/>',
        *_units(variables),
        *_log_categories(),
        f'  <DefaultExperiment startTime="0" stopTime="10" stepSize="{STEP_SIZE}"/>',
        "  <ModelVariables>",
    ]
    tags = {"REAL": "Float64", "INT": "Int32", "BOOL": "Boolean"}
    for v in variables:
        start = f' start="{_number(v.start, v.type)}"' if v.has_start else ""
        unit = f' unit="{v.unit}"' if v.type == "REAL" else ""
        lines.append(
            f'    <{tags[v.type]} name="{v.name}" valueReference="{v.reference}"'
            f' causality="{v.causality}" variability="{v.variability}"'
            f"{unit}{_limits(v)}{start} description={quoteattr(v.description)}/>"
        )
    outputs = [v.reference for v in variables if v.causality == "output"]
    lines += [
        "  </ModelVariables>",
        "  <ModelStructure>",
        *(f'    <Output valueReference="{reference}"/>' for reference in outputs),
        *(f'    <InitialUnknown valueReference="{reference}"/>' for reference in outputs),
        "  </ModelStructure>",
        "</fmiModelDescription>",
        "",
    ]
    return "\n".join(lines)


def build_description_fmi3() -> str:
    """sources/buildDescription.xml for FMI 3.0."""
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            '<fmiBuildDescription fmiVersion="3.0">',
            f'  <BuildConfiguration modelIdentifier="{_identifier(3)}"'
            ' description="C11; compile with -ffp-contract=off to get the same bits">',
            '    <SourceFileSet language="C11" compilerOptions="-ffp-contract=off">',
            *(f'      <SourceFile name="{name}"/>' for name in source_files(3)),
            "    </SourceFileSet>",
            '    <Library name="m" external="true"/>',
            "  </BuildConfiguration>",
            "</fmiBuildDescription>",
            "",
        ]
    )


def _platform_folder(fmi: int) -> str:
    import fmpy  # noqa: PLC0415  slow, and the token command does without

    return str(fmpy.platform if fmi == 2 else fmpy.platform_tuple)


def pack(fmi: int, library: Path, header: Path, out: Path) -> None:
    """Write the FMU; `header` is the token header that `library` was compiled with."""
    variables = read_variables()
    match = re.search(r'"(.+)"', header.read_text(encoding="utf-8"))
    if match is None:
        raise DefinitionError(f"{header}: holds no token")
    identity = match.group(1)
    describe = description_fmi2 if fmi == 2 else description_fmi3
    binary = f"binaries/{_platform_folder(fmi)}/{_identifier(fmi)}{library.suffix}"
    content: dict[str, bytes] = {
        "modelDescription.xml": describe(variables, identity).encode(),
        binary: library.read_bytes(),
        "sources/plant_token.h": header.read_bytes(),
    }
    names = source_files(fmi)
    names += [p.name for p in SOURCE_DIR.iterdir() if p.suffix in (".h", ".def")]
    for name in names:
        if name == f"fmi{5 - fmi}_report.h":
            continue  # of the other version
        content[f"sources/{name}"] = (SOURCE_DIR / name).read_bytes()
    if fmi == 3:
        content["sources/buildDescription.xml"] = build_description_fmi3().encode()
    partial = out.with_suffix(".tmp")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(content, key=lambda n: (n != "modelDescription.xml", n)):
            info = zipfile.ZipInfo(name, ZIP_DATE)
            info.compress_type = zipfile.ZIP_DEFLATED
            info.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(info, content[name])
    partial.replace(out)


def parameters_yaml() -> str:
    """Return the vehicle parameters as YAML: start value, and in a comment unit, text and source."""
    lines: list[str] = []
    for v in vehicle_parameters(read_variables()):
        unit = f"{v.unit}; " if v.unit not in ("", "1") else ""
        lines.append(f"{v.name}: {v.start}  # {unit}{v.description}. [{v.source}]")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return 0, or 2 when an input is wrong."""
    parser = argparse.ArgumentParser(description="Describe and pack the plant FMUs.")
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("token", help="write the header with the FMU's identity")
    command.add_argument("--out", type=Path, required=True)
    command = commands.add_parser("pack", help="write one FMU")
    command.add_argument("--fmi", type=int, choices=(2, 3), required=True)
    command.add_argument("--library", type=Path, required=True)
    command.add_argument("--token-header", type=Path, required=True)
    command.add_argument("--out", type=Path, required=True)
    commands.add_parser("parameters", help="print the vehicle parameters as YAML")
    options = parser.parse_args(arguments)
    try:
        if options.command == "token":
            read_variables()
            options.out.write_text(token_header(), encoding="utf-8")
        elif options.command == "pack":
            pack(options.fmi, options.library, options.token_header, options.out)
        else:
            sys.stdout.write(parameters_yaml())
    except (DefinitionError, OSError) as error:
        print(f"package.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
