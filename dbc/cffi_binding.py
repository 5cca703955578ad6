"""Turn C headers into the C source of a Python extension module (cffi, API mode).

The headers are the only description of the interface: the C preprocessor resolves their includes and macros, and
what is left is handed to cffi. Standard headers are replaced by empty ones, since cffi knows their types. Macros
with a numeric value become constants of the module, besides all functions, types, enumerators and variables.

::

    python -m dbc.cffi_binding --module dbc._codec --out _codec.c --compiler cc --include firmware common/codec.h
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cffi

from dbc.errors import ConfigurationError, RaceloopError

#: Standard headers that a header of ours may include.
_STANDARD_HEADERS = ("assert", "float", "inttypes", "limits", "math", "stdbool", "stddef", "stdint", "stdio", "string")
_MACRO = re.compile(r"^#define (\w+) (.+)$", re.MULTILINE)
_INTEGER = r"(?:0[xX][0-9a-fA-F]+|\d+)[uUlL]*"
_FLOAT = r"(?:\d+\.\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)[fFlL]?"
_OPERATORS = r"[-+*/%()<>&|^~\s]"
_INTEGER_EXPRESSION = re.compile(rf"(?:{_INTEGER}|{_OPERATORS})+")
_NUMBER_EXPRESSION = re.compile(rf"(?:{_FLOAT}|{_INTEGER}|{_OPERATORS})+")
_WORD = re.compile(r"(?<![\w.])[A-Za-z_]\w*")


def _includes(headers: Sequence[str]) -> str:
    return "".join(f'#include "{header}"\n' for header in headers)


def preprocess(
    headers: Sequence[str],
    include_directories: Sequence[Path],
    definitions: Sequence[str] = (),
    compiler: str = "cc",
    depfile: tuple[Path, str] | None = None,
) -> str:
    """Extract declarations and numeric macros of the headers, as cffi's ``cdef`` takes them.

    Parameters
    ----------
    headers : as in ``#include "..."``, each found in one of the include directories.
    include_directories : searched in this order.
    definitions : ``NAME`` or ``NAME=VALUE`` for the preprocessor.
    compiler : command of a C compiler that knows gcc's options.
    depfile : path and target name of a make dependency file to write.

    Raises
    ------
    ConfigurationError
        With the compiler's first line of complaint.
    """
    with tempfile.TemporaryDirectory() as folder:
        for name in _STANDARD_HEADERS:
            (Path(folder) / f"{name}.h").touch()
        source = Path(folder) / "headers.c"
        source.write_text(_includes(headers), encoding="utf-8")
        command = [compiler, "-std=c11", "-E", "-nostdinc", "-isystem", folder]
        command += [f"-I{directory}" for directory in include_directories]
        command += [f"-D{definition}" for definition in definitions]
        dependencies = ["-MMD", "-MF", str(depfile[0]), "-MT", depfile[1]] if depfile is not None else []
        declarations = _run([*command, "-P", *dependencies, str(source)], headers)
        macros = dict(_MACRO.findall(_run([*command, "-dM", str(source)], headers)))
        source.write_text("", encoding="utf-8")
        predefined = dict(_MACRO.findall(_run([*command, "-dM", str(source)], headers)))
        if depfile is not None:
            _drop_temporary(depfile[0], folder)
    own = {name: body for name, body in sorted(macros.items()) if predefined.get(name) != body}
    return declarations + "".join(_constants(own))


def _run(command: Sequence[str], headers: Sequence[str]) -> str:
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout
    except OSError as error:
        raise ConfigurationError(command[0], "", f"cannot run the C compiler: {error.strerror}") from error
    except subprocess.CalledProcessError as error:
        complaints = [line for line in error.stderr.splitlines() if "error" in line] or error.stderr.splitlines()
        raise ConfigurationError(
            ", ".join(headers), "", complaints[0] if complaints else "cannot preprocess"
        ) from error


def _drop_temporary(depfile: Path, folder: str) -> None:
    """Take the temporary source out of the dependencies: it is gone at the next build."""
    text = depfile.read_text(encoding="utf-8")
    depfile.write_text(re.sub(rf"\s{re.escape(folder)}\S*", "", text), encoding="utf-8")


def _constants(macros: dict[str, str]) -> list[str]:
    """Declare the macros whose value is a number, possibly through other macros."""
    lines = []
    for name in macros:
        body = _expand(macros, name, frozenset())
        if _INTEGER_EXPRESSION.fullmatch(body):
            lines.append(f"#define {name} ...\n")
        elif _NUMBER_EXPRESSION.fullmatch(body):
            lines.append(f"static const double {name};\n")
    return lines


def _expand(macros: dict[str, str], name: str, inside: frozenset[str]) -> str:
    """Body of a macro with other macros replaced; names that are none stay and spoil the match."""

    def replace(match: re.Match[str]) -> str:
        word = match.group()
        return f"({_expand(macros, word, inside | {name})})" if word in macros and word not in inside else word

    return _WORD.sub(replace, macros[name])


def emit(module: str, headers: Sequence[str], declarations: str, out: Path) -> None:
    """Write the C source of the extension module, to be compiled with the same include directories.

    Parameters
    ----------
    module : full name, such as ``dbc._codec``.
    headers : the module's source includes them.
    declarations : from :func:`preprocess`.
    out : C file to write.

    Raises
    ------
    ConfigurationError
        When cffi does not understand a declaration.
    """
    ffi = cffi.FFI()
    try:
        ffi.cdef(declarations)
    except (cffi.CDefError, cffi.FFIError) as error:
        raise ConfigurationError(", ".join(headers), "", " ".join(str(error).split())) from error
    ffi.set_source(module, _includes(headers))
    out.parent.mkdir(parents=True, exist_ok=True)
    ffi.emit_c_code(str(out))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; exit status 2 with one line when the headers are wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("headers", nargs="+", metavar="HEADER", help='as in #include "HEADER"')
    parser.add_argument("--module", required=True, help="full name of the Python module")
    parser.add_argument("--out", type=Path, required=True, help="C file to write")
    parser.add_argument("--compiler", default="cc", help="C compiler that preprocesses")
    parser.add_argument("--include", type=Path, action="append", default=[], help="include directory; repeatable")
    parser.add_argument("--define", action="append", default=[], help="NAME or NAME=VALUE; repeatable")
    parser.add_argument("--depfile", type=Path, help="make dependency file to write for --out")
    options = parser.parse_args(arguments)
    depfile = (options.depfile, str(options.out)) if options.depfile else None
    try:
        declarations = preprocess(options.headers, options.include, options.define, options.compiler, depfile)
        emit(options.module, options.headers, declarations, options.out)
    except RaceloopError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
