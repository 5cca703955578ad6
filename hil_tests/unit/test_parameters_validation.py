"""Parameter validation in the firmware, beside the parameter matrix: all or nothing, counts, bounds of the store."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from bridge._native import ffi, lib
from firmware.tables import CrossCheck, Parameter, own_parameters, parameter_key

SCHEMA = own_parameters()
PARAMETERS = SCHEMA.parameters
TYPES = {"float": lib.PARAMETER_FLOAT, "int": lib.PARAMETER_INT, "bool": lib.PARAMETER_BOOL}


def bits(value: float, kind: int = lib.PARAMETER_FLOAT) -> int:
    """Raw 32 bits of a value."""
    packed = struct.pack("<f", value) if kind == lib.PARAMETER_FLOAT else struct.pack("<i", int(value))
    return int.from_bytes(packed, "little")


def single(value: float) -> float:
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def good_value(parameter: Parameter) -> float:
    """A value in the middle of the allowed range."""
    if parameter.type == "bool":
        return True
    middle = 0.5 * (parameter.min + parameter.max)
    return int(middle) if parameter.type == "int" else single(middle)


# Values that obey the rules between parameters as well.
CONSISTENT: dict[str, float] = {parameter.name: good_value(parameter) for parameter in PARAMETERS} | {
    "max_speed": 60.0,
    "degraded_max_speed": 30.0,
    "max_acceleration": 8.0,
    "degraded_max_acceleration": 3.0,
}


class Parameters:
    """The firmware's parameter store."""

    def __init__(self) -> None:
        self.c = ffi.new("parameters *")
        lib.parameters_init(self.c)
        self.sent = 0

    def write(self, name: str, value: float, kind: int | None = None, raw: int | None = None) -> None:
        declared = next((p for p in PARAMETERS if p.name == name), None)
        if kind is None:
            kind = TYPES[declared.type] if declared else lib.PARAMETER_FLOAT
        lib.parameters_write(self.c, parameter_key(name), kind, bits(value, kind) if raw is None else raw)
        self.sent += 1

    def write_all(self, **changes: float | None) -> None:
        for name, value in (CONSISTENT | changes).items():
            if value is not None:
                self.write(name, value)

    def commit(self, count: int | None = None, schema: int | None = None) -> int:
        count = self.sent if count is None else count
        lib.parameters_commit(self.c, count, SCHEMA.hash if schema is None else schema)
        return int(self.c.verdict)

    def results(self) -> list[tuple[int, int, int]]:
        result, found = ffi.new("parameter_result *"), []
        while lib.parameters_next_result(self.c, result):
            found.append((result.key, result.status, result.value))
            assert len(found) <= lib.PARAMETERS_RESULTS_MAX
        return found

    def offences(self) -> list[tuple[int, int]]:
        return [(key, status) for key, status, _ in self.results() if status != lib.PARAMETER_ACCEPTED]

    def in_force(self) -> list[tuple[float, int]]:
        return [(lib.parameters_real(self.c, i), lib.parameters_integer(self.c, i)) for i in range(len(PARAMETERS))]


def check(parameter: Parameter, value: float, kind: int | None = None) -> int:
    row = lib.parameter_table[[p.name for p in PARAMETERS].index(parameter.name)]
    kind = TYPES[parameter.type] if kind is None else kind
    return int(lib.parameters_check(ffi.addressof(row), kind, bits(value, kind), ffi.new("parameter_value *")))


@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda p: p.name)
def test_types_that_no_file_gives(parameter: Parameter) -> None:
    for kind in (lib.PARAMETER_NULL, 5, 255):
        assert check(parameter, 1, kind) == lib.PARAMETER_WRONG_TYPE


def row(**changes: Any) -> Any:
    values = {"key": 1, "type": lib.PARAMETER_FLOAT, "sign": 0, "minimum": -5.0, "maximum": 5.0} | changes
    return ffi.new("parameter_row *", values)


def test_signs_that_the_schema_does_not_use_yet() -> None:
    value = ffi.new("parameter_value *")
    negative = row(sign=-1, maximum=0.0)
    assert lib.parameters_check(negative, lib.PARAMETER_FLOAT, bits(-1.0), value) == lib.PARAMETER_ACCEPTED
    assert lib.parameters_check(negative, lib.PARAMETER_FLOAT, bits(1.0), value) == lib.PARAMETER_WRONG_SIGN
    for number in (-5.0, 0.0, 5.0):
        assert lib.parameters_check(row(), lib.PARAMETER_FLOAT, bits(number), value) == lib.PARAMETER_ACCEPTED
        assert value.real == number
    assert lib.parameters_check(row(), lib.PARAMETER_FLOAT, bits(-6.0), value) == lib.PARAMETER_BELOW_MINIMUM


@pytest.mark.parametrize("number", [-(1 << 31), (1 << 31) - 1, (1 << 24) + 1])
def test_integers_that_no_single_holds_are_out_of_range(number: int) -> None:
    value = ffi.new("parameter_value *")
    for kind in (lib.PARAMETER_FLOAT, lib.PARAMETER_INT):
        limits = row(type=kind, minimum=-16777215.0, maximum=16777215.0)
        status = lib.parameters_check(limits, lib.PARAMETER_INT, bits(number, lib.PARAMETER_INT), value)
        assert status in (lib.PARAMETER_BELOW_MINIMUM, lib.PARAMETER_ABOVE_MAXIMUM)


@pytest.mark.parametrize(
    ("wanted", "kind", "number", "integer"),
    [
        (lib.PARAMETER_FLOAT, lib.PARAMETER_FLOAT, 2.5, 0),
        (lib.PARAMETER_FLOAT, lib.PARAMETER_INT, 3, 0),
        (lib.PARAMETER_INT, lib.PARAMETER_INT, -3, -3),
        (lib.PARAMETER_BOOL, lib.PARAMETER_BOOL, 1, 1),
    ],
)
def test_only_whole_numbers_have_a_whole_value(wanted: int, kind: int, number: float, integer: int) -> None:
    value = ffi.new("parameter_value *", {"real": 9.0, "integer": 9})
    assert lib.parameters_check(row(type=wanted), kind, bits(number, kind), value) == lib.PARAMETER_ACCEPTED
    assert (value.real, value.integer) == (number, integer)


PRODUCTS = [rule for rule in SCHEMA.cross_checks if rule.kind == "product"]


@pytest.mark.parametrize("rule", PRODUCTS, ids=lambda rule: f"{rule.left} {rule.right}")
def test_a_product_at_its_bound_obeys_the_rule(rule: CrossCheck) -> None:
    by_name = {p.name: p for p in PARAMETERS}
    left, right = by_name[rule.left], by_name[rule.right]
    pairs = ((number, rule.bound / number) for number in range(int(left.min) + 1, int(left.max)))
    first, second = next(pair for pair in pairs if right.min <= pair[1] <= right.max and single(pair[1]) == pair[1])
    index = SCHEMA.cross_checks.index(rule)
    for less, broken in ((0, False), (1, True)):
        parameters = Parameters()
        parameters.write_all(**{left.name: first - less, right.name: second})
        parameters.commit()
        offended = [value for _, status, value in parameters.results() if status == lib.PARAMETER_CROSS_CHECK]
        assert (index in offended) is broken


def test_whole_number_for_a_float_is_exact() -> None:
    parameters = Parameters()
    parameters.write("full_brake_pressure", 5_999_999, lib.PARAMETER_INT)
    parameters.write_all(full_brake_pressure=None)
    assert parameters.commit() == lib.PARAMETER_VERDICT_ACCEPTED
    assert lib.parameters_real(parameters.c, lib.PARAMETER_FULL_BRAKE_PRESSURE) == 5_999_999.0


def test_standard_values_until_accepted() -> None:
    parameters = Parameters()
    standard = [(single(p.default), 0 if p.type == "float" else int(p.default)) for p in PARAMETERS]
    assert parameters.in_force() == standard
    parameters.write_all()
    assert parameters.in_force() == standard, "nothing is taken before the commit"
    assert parameters.commit() == lib.PARAMETER_VERDICT_ACCEPTED
    names = [p.name for p in PARAMETERS]
    assert [real for real, _ in parameters.in_force()] == [single(CONSISTENT[name]) for name in names]


def test_good_configuration_reports_every_parameter() -> None:
    parameters = Parameters()
    parameters.write_all()
    parameters.commit()
    assert [key for key, status, _ in parameters.results() if status == 0] == [parameter_key(n) for n in CONSISTENT]
    c = parameters.c
    assert (c.accepted, c.rejected, c.missing, c.late, c.results_lost) == (len(PARAMETERS), 0, 0, 0, 0)


def test_every_offence_is_reported_and_nothing_is_taken() -> None:
    parameters = Parameters()
    standard = parameters.in_force()
    changes: dict[str, float | None] = {
        "max_speed": None,  # missing
        "max_acceleration": -1.0,
        "max_deceleration": math.nan,
        "steering_limit": 10.0,
        "steering_slew": 0.0,
    }
    parameters.write_all(**changes)
    parameters.write("imu_timeout", 50)  # a second time
    parameters.write("max_sped", 1.0)
    assert parameters.commit() == lib.PARAMETER_VERDICT_REJECTED
    key = parameter_key
    assert sorted(parameters.offences()) == sorted(
        [
            (key("max_speed"), lib.PARAMETER_MISSING),
            (key("max_acceleration"), lib.PARAMETER_WRONG_SIGN),
            (key("max_deceleration"), lib.PARAMETER_NOT_FINITE),
            (key("steering_limit"), lib.PARAMETER_ABOVE_MAXIMUM),
            (key("steering_slew"), lib.PARAMETER_BELOW_MINIMUM),
            (key("imu_timeout"), lib.PARAMETER_DUPLICATE),
            (key("max_sped"), lib.PARAMETER_UNKNOWN_KEY),
        ]
    )
    c = parameters.c
    assert (c.accepted, c.rejected, c.missing) == (len(PARAMETERS) - 5, 6, 1)
    assert parameters.in_force() == standard


@pytest.mark.parametrize("index", range(len(SCHEMA.cross_checks)))
def test_rule_says_nothing_about_values_that_are_wrong_or_missing(index: int) -> None:
    rule = SCHEMA.cross_checks[index]
    by_name = {p.name: p for p in PARAMETERS}
    left, right = by_name[rule.left], by_name[rule.right]
    equal = max(left.min, right.min)  # breaks the rule; each is allowed on its own
    changes: dict[str, float | None] = (
        {left.name: equal, right.name: equal} if rule.kind == "less" else {left.name: left.min, right.name: right.min}
    )

    def broken(wrong: dict[str, float | None]) -> bool:
        parameters = Parameters()
        parameters.write_all(**changes | wrong)
        parameters.commit()
        return index in [value for _, status, value in parameters.results() if status == lib.PARAMETER_CROSS_CHECK]

    assert broken({})
    for name in (left.name, right.name):
        assert not broken({name: None})
        assert not broken({name: -1.0})


@pytest.mark.parametrize("difference", [-1, 1])
def test_count_mismatch(difference: int) -> None:
    parameters = Parameters()
    parameters.write_all()
    assert parameters.commit(count=parameters.sent + difference) == lib.PARAMETER_VERDICT_REJECTED
    assert (0, lib.PARAMETER_COUNT_MISMATCH, parameters.sent) in parameters.results()


def test_schema_mismatch() -> None:
    parameters = Parameters()
    parameters.write_all()
    assert parameters.commit(schema=SCHEMA.hash ^ 1) == lib.PARAMETER_VERDICT_REJECTED
    assert (0, lib.PARAMETER_SCHEMA_MISMATCH, SCHEMA.hash) in parameters.results()


@pytest.mark.parametrize("good", [True, False])
def test_late_writes_change_nothing(good: bool) -> None:
    parameters = Parameters()
    parameters.write_all(**({} if good else {"max_speed": -1.0}))
    verdict = parameters.commit()
    parameters.results()
    before = parameters.in_force()
    parameters.write("max_speed", 10.0)
    assert parameters.commit() == verdict
    assert parameters.in_force() == before
    assert parameters.results() == [
        (parameter_key("max_speed"), lib.PARAMETER_LATE, bits(10.0)),
        (0, lib.PARAMETER_LATE, parameters.sent),
    ]
    assert parameters.c.late == 2


def test_empty_configuration_misses_everything() -> None:
    parameters = Parameters()
    assert parameters.commit() == lib.PARAMETER_VERDICT_REJECTED
    assert parameters.c.missing == len(PARAMETERS)
    missing = [(parameter_key(parameter.name), lib.PARAMETER_MISSING, 0) for parameter in PARAMETERS]
    assert parameters.results() == missing


def test_flood_is_counted_and_stays_bounded() -> None:
    parameters = Parameters()
    for _ in range(70_000):
        parameters.write("no_such_key", 1.0)
    c = parameters.c
    assert len(parameters.results()) == lib.PARAMETERS_RESULTS_MAX
    assert c.rejected == 65_535
    assert c.writes == 65_535, "counters saturate instead of starting over"
    assert c.results_lost == 65_535
    assert parameters.commit(count=70_000 & 0xFFFF) == lib.PARAMETER_VERDICT_REJECTED


def test_results_keep_their_order_when_the_queue_goes_round() -> None:
    parameters, result = Parameters(), ffi.new("parameter_result *")
    size = lib.PARAMETERS_RESULTS_MAX
    for number in range(size):
        parameters.write("no_such_key", number)
    taken = []
    for number in range(size, 3 * size):
        assert lib.parameters_next_result(parameters.c, result)
        taken.append(result.value)
        parameters.write("no_such_key", number)
    taken += [value for _, _, value in parameters.results()]
    assert taken == [bits(number) for number in range(3 * size)]
    assert parameters.c.results_lost == 0


def test_a_start_forgets_what_was_before() -> None:
    parameters = Parameters()
    fresh = bytes(ffi.buffer(parameters.c))
    ffi.buffer(parameters.c)[:] = b"\xff" * len(fresh)
    lib.parameters_init(parameters.c)
    assert bytes(ffi.buffer(parameters.c)) == fresh
    for index in range(lib.PARAMETER_COUNT):
        parameters.c.active[index] = (0.0, 0)
    assert not any(bytes(ffi.buffer(parameters.c))), "nothing but the values in force"
