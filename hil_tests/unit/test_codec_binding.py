"""dbc/cffi_binding.py: C headers to a Python module."""

from __future__ import annotations

from pathlib import Path

import cffi
import pytest

from dbc.cffi_binding import main, preprocess
from dbc.errors import ConfigurationError

HEADER = """
#ifndef GUARD_H
#define GUARD_H
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#define COUNT 3
#define SHIFTED (COUNT << 2)
#define HALF 0.5f
#define SCALED (HALF * COUNT)
#define TEXT "three"
#define CALL(x) (x)
#define SIZE sizeof(int)
#define NEGATIVE (-1)
#define SELF SELF
enum { LENGTH = COUNT, DOUBLE_LENGTH = LENGTH * 2, };
typedef enum colour { RED = -1, GREEN } colour;
typedef struct thing {
    uint8_t bytes[DOUBLE_LENGTH + 1];
    void (*call)(void *context, const float *values, uint32_t count);
    enum { OFF, ON } state;
    double precise;
    float single;
    bool flag;
} thing;
extern const thing things[];
/* A comment with a "quote". */
colour next(const thing *self, colour now);
#endif
"""


def parsed(folder: Path) -> tuple[cffi.FFI, str]:
    (folder / "thing.h").write_text(HEADER, encoding="ascii")
    declarations = preprocess(["thing.h"], [folder])
    ffi = cffi.FFI()
    ffi.cdef(declarations)
    return ffi, declarations


def test_types_and_functions_survive(tmp_path: Path) -> None:
    ffi, declarations = parsed(tmp_path)
    fields = dict(ffi.typeof("thing").fields)
    assert ffi.sizeof(fields["bytes"].type) == 7
    assert fields["call"].type.cname == "void(*)(void *, float *, uint32_t)"
    assert fields["precise"].type.cname == "double"
    assert ffi.typeof("colour").relements == {"RED": -1, "GREEN": 0}
    assert "next(const thing *self" in declarations
    assert "#include" not in declarations


def test_numeric_macros_become_constants(tmp_path: Path) -> None:
    _, declarations = parsed(tmp_path)
    for name in ("COUNT", "SHIFTED", "NEGATIVE"):
        assert f"#define {name} ...\n" in declarations
    for name in ("HALF", "SCALED"):
        assert f"static const double {name};\n" in declarations
    for name in ("TEXT", "CALL", "SIZE", "SELF", "GUARD_H", "__STDC__"):
        assert f" {name} " not in declarations.replace(";", " ").replace("(", " ")


def test_definitions_and_dependencies(tmp_path: Path) -> None:
    (tmp_path / "part.h").write_text("extern int part;\n", encoding="ascii")
    (tmp_path / "whole.h").write_text('#include "part.h"\nextern int whole[SIZE];\n', encoding="ascii")
    out = tmp_path / "deep" / "whole.c"
    depfile = tmp_path / "whole.d"
    arguments = ["whole.h", "--module", "package._whole", "--include", str(tmp_path), "--define", "SIZE=4"]
    assert main([*arguments, "--out", str(out), "--depfile", str(depfile)]) == 0
    assert "PyInit__whole" in out.read_text(encoding="utf-8")
    dependencies = depfile.read_text(encoding="utf-8").replace("\\\n", " ").split()
    assert dependencies == [f"{out}:", str(tmp_path / "whole.h"), str(tmp_path / "part.h")]


def test_errors_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "broken.h").write_text('#include "missing.h"\n', encoding="ascii")
    (tmp_path / "odd.h").write_text("int f(;\n", encoding="ascii")
    for header, problem in (("broken.h", "missing.h"), ("odd.h", "odd.h: "), ("absent.h", "absent.h")):
        out = tmp_path / "out.c"
        assert main([header, "--module", "m", "--include", str(tmp_path), "--out", str(out)]) == 2
        captured = capsys.readouterr()
        assert problem in captured.err
        assert captured.err.count("\n") == 1
        assert not out.exists()
    with pytest.raises(ConfigurationError, match="cannot run the C compiler"):
        preprocess(["broken.h"], [tmp_path], compiler=str(tmp_path / "no-such-compiler"))
