"""Mutants of C: which there are, that each does what it says, and that nothing changes while none is alive."""

from __future__ import annotations

import ctypes
import subprocess

import pytest

from tools.mutation.schemata import Mutant, Schemata

SOURCE = b"""
enum { LIMIT = 3, TABLE_SIZE = LIMIT + 1 };
static const int table[TABLE_SIZE] = {1 + 1, 2, 3, 4};

static int twice(int x) { return x * 2; }

int decide(int a, int b);
int decide(int a, int b)
{
    static const int kept = 5 + 1;
    int sum = 0;
    for (int i = 0; i < LIMIT; i++) {
        if (i == 1) {
            continue;
        }
        sum += table[i];
    }
    switch (a) {
    case LIMIT + 4:
        sum = twice(b);
        break;
    default:
        sum = a < b && !(a == 0) ? sum - kept : sum | 1;
    }
    return sum;
}
"""


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Mutant], ctypes.CDLL]:
    folder = tmp_path_factory.mktemp("mutants")
    schemata = Schemata()
    text = schemata.instrument("decide.c", SOURCE)
    numbers = f"\nvolatile uint32_t mutation_alive;\nvolatile uint8_t mutation_reached[{len(schemata.mutants) + 1}];\n"
    (folder / "decide.c").write_text(text + numbers)
    library = folder / "decide.so"
    # A mutant may never end: one that counts down overflows, which must wrap and not be undefined.
    flags = ["-std=gnu11", "-fwrapv", "-shared", "-fPIC", "-w", "-o", str(library)]
    subprocess.run(["cc", *flags, str(folder / "decide.c")], check=True)
    return schemata.mutants, ctypes.CDLL(str(library))


def plain(a: int, b: int) -> int:
    """As the C does it."""
    if a == 7:
        return 2 * b
    return 5 - 6 if a < b and a != 0 else 5 | 1


CALLS = [(a, b) for a in (-1, 0, 1, 2, 7) for b in (-3, 0, 1, 2, 7)]


def results(library: ctypes.CDLL, number: int) -> list[int]:
    ctypes.c_uint32.in_dll(library, "mutation_alive").value = number
    return [library.decide(a, b) for a, b in CALLS]


def test_nothing_changes_while_none_is_alive(built: tuple[list[Mutant], ctypes.CDLL]):
    assert results(built[1], 0) == [plain(a, b) for a, b in CALLS]


def test_what_the_compiler_must_know_has_no_mutants(built: tuple[list[Mutant], ctypes.CDLL]):
    lines = SOURCE.decode().splitlines()
    changed = {lines[mutant.line - 1].strip() for mutant in built[0]}
    assert not changed & {lines[1], lines[2], "static const int kept = 5 + 1;", "case LIMIT + 4:"}


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ("x * 2", "x / 2", lambda a, b: int(b / 2) if a == 7 else plain(a, b)),
        ("return x * 2;", "return 0", lambda a, b: 0 if a == 7 else plain(a, b)),
        ("a < b", "a <= b", lambda a, b: -1 if a == b != 0 and a != 7 else plain(a, b)),
        ("a < b && !(a == 0)", "a < b || !(a == 0)", lambda a, b: plain(a, b) if a == 7 else -1 if a < b or a else 5),
        ("!(a == 0)", "(a == 0)", lambda a, b: plain(a, b) if a == 7 else -1 if a < b and a == 0 else 5),
        ("? a < b && !(a == 0)", "true", lambda a, b: plain(a, b) if a == 7 else -1),
        ("sum - kept", "sum + kept", lambda a, b: 11 if a != 7 and a < b and a != 0 else plain(a, b)),
        ("sum | 1", "sum & 1", lambda a, b: plain(a, b) if a == 7 or (a < b and a != 0) else 1),
        ("sum += table[i]", "sum -= table[i]", lambda a, b: 2 * b if a == 7 else -11 if a < b and a else -5 | 1),
        ("sum += table[i];", "", lambda a, b: 2 * b if a == 7 else -6 if a < b and a else 1),
        ("continue;", "", lambda a, b: 2 * b if a == 7 else 1 if a < b and a else 7),
        ("? (i == 1)", "true", lambda a, b: 2 * b if a == 7 else -6 if a < b and a else 1),
        ("sum = twice(b);", "", lambda a, b: 5 if a == 7 else plain(a, b)),
        ("break;", "", lambda a, b: plain(a, b) if a != 7 else 2 * b - 6 if a < b else 2 * b | 1),
        ("return sum;", "return 0", lambda _a, _b: 0),
    ],
)
def test_each_mutant_does_what_it_says(built: tuple[list[Mutant], ctypes.CDLL], before: str, after: str, expected):
    mutants, library = built
    (number,) = (mutant.number for mutant in mutants if (mutant.before, mutant.after) == (before, after))
    assert results(library, number) == [expected(a, b) for a, b in CALLS]
    assert bytes((ctypes.c_uint8 * (len(mutants) + 1)).in_dll(library, "mutation_reached"))[number] == 1


def test_names_stay_when_lines_move():
    one, other = Schemata(), Schemata()
    one.instrument("decide.c", SOURCE)
    other.instrument("decide.c", b"\n\n" + SOURCE)
    assert [mutant.key for mutant in one.mutants] == [mutant.key for mutant in other.mutants]
    assert all(a.line + 2 == b.line for a, b in zip(one.mutants, other.mutants, strict=True))


def test_each_has_a_name_of_its_own():
    schemata = Schemata()
    schemata.instrument("decide.c", b"int decide(int a) { a++; a++; return a; }\nint other(int a) { a++; return a; }")
    keys = [mutant.key for mutant in schemata.mutants]
    assert [key for key in keys if key.endswith((": a++ -> a--", ": a++ -> a-- (2)"))] == [
        "decide.c:decide: a++ -> a--",
        "decide.c:decide: a++ -> a-- (2)",
        "decide.c:other: a++ -> a--",
    ]
    assert len(set(keys)) == len(keys)


def test_what_is_nothing_already_is_not_returned_as_nothing():
    schemata = Schemata()
    schemata.instrument("pair.c", b"pair f(int a) { if (a) { return (pair){0}; } return (pair){a}; }")
    assert [one.before for one in schemata.mutants if one.after == "return 0"] == ["return (pair){a};"]


def test_what_is_no_c_is_refused():
    with pytest.raises(ValueError, match=r"broken\.c"):
        Schemata().instrument("broken.c", b"int f( {")
