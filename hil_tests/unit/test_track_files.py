"""Tracks from YAML, from the TUM race track CSV and from two boundaries; and everything that can be wrong with them."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from autonomy.track_files import load_track, track_from_boundaries, track_from_csv
from dbc.errors import ConfigurationError

TRACKS = Path(__file__).parents[2] / "scenarios" / "tracks"


@pytest.fixture(scope="module")
def lvms():
    return load_track(TRACKS / "lvms.yaml")


def tum_rows(track, step=5, bank=True):
    rows = []
    for i in range(0, track.centre.count, step):
        row = [track.centre.x[i], track.centre.y[i], track.width_right[i], track.width_left[i]]
        rows.append([*row, track.bank[i]] if bank else row)
    return rows


def write_csv(path, rows, header="# x_m,y_m,w_tr_right_m,w_tr_left_m"):
    path.write_text("\n".join([header, *(",".join(repr(float(v)) for v in row) for row in rows)]) + "\n")
    return path


def mean_gap(track, other):
    return np.array([abs(track.project(x, y)[1]) for x, y in zip(other.x.tolist(), other.y.tolist(), strict=True)])


def test_tum_csv_gives_the_track_back(lvms, tmp_path):
    track = track_from_csv(write_csv(tmp_path / "lvms.csv", tum_rows(lvms)))
    assert track.name == "lvms"
    assert track.length == pytest.approx(lvms.length, abs=0.1)
    assert track.centre.turn == pytest.approx(2.0 * math.pi)
    assert mean_gap(lvms, track.centre).max() < 0.01
    np.testing.assert_allclose(track.width_left, 7.45)
    for station in (50.0, 400.0, 700.0, 1000.0, 2000.0):
        x, y, _ = lvms.pose_at(station, 2.0)
        assert track.road_at(x, y)[0] == pytest.approx(lvms.road_at(x, y)[0], abs=1e-3)


def test_tum_csv_without_bank_is_flat_and_a_repeated_last_point_is_dropped(lvms, tmp_path):
    rows = tum_rows(lvms, bank=False)
    once = track_from_csv(write_csv(tmp_path / "a.csv", rows))
    twice = track_from_csv(write_csv(tmp_path / "b.csv", [*rows, rows[0]]))
    assert not once.bank.any()
    assert twice.length == pytest.approx(once.length, abs=1e-9)


def test_tum_widths_are_right_then_left(lvms, tmp_path):
    rows = [[x, y, 9.0, 4.0] for x, y, *_ in tum_rows(lvms)]
    track = track_from_csv(write_csv(tmp_path / "lvms.csv", rows))
    np.testing.assert_allclose(track.width_left, 4.0)
    np.testing.assert_allclose(track.width_right, 9.0)


@pytest.mark.parametrize("reverse_outer", [False, True])
def test_boundaries_give_the_centre_line(lvms, tmp_path, reverse_outer):
    left, right = lvms.boundaries()
    outer = right[::-7] if reverse_outer else right[::7]
    inner_file, outer_file = tmp_path / "inner.csv", tmp_path / "outer.csv"
    np.savetxt(inner_file, left[::6], delimiter=",")
    np.savetxt(outer_file, outer, delimiter=",")
    track = track_from_boundaries(inner_file, outer_file)
    assert mean_gap(lvms, track.centre).max() < 0.05
    np.testing.assert_allclose(track.width_left, 7.45, atol=0.05)
    np.testing.assert_allclose(track.width_right, 7.45, atol=0.05)
    assert track.centre.turn > 0.0


def test_boundaries_in_clockwise_order_have_the_inner_one_on_the_right(lvms, tmp_path):
    left, right = lvms.boundaries()
    np.savetxt(tmp_path / "inner.csv", left[::-6], delimiter=",")
    np.savetxt(tmp_path / "outer.csv", (right + 0.0)[::7], delimiter=",")
    track = track_from_boundaries(tmp_path / "inner.csv", tmp_path / "outer.csv")
    assert track.centre.turn == pytest.approx(-2.0 * math.pi)
    assert track.width_right.min() > 7.3


def test_yaml_may_point_at_a_csv_or_at_boundaries(lvms, tmp_path):
    write_csv(tmp_path / "line.csv", tum_rows(lvms))
    left, right = lvms.boundaries()
    np.savetxt(tmp_path / "in.csv", left[::6], delimiter=",")
    np.savetxt(tmp_path / "out.csv", right[::6], delimiter=",")
    origin = "origin: {latitude_deg: 36.0, longitude_deg: -115.0, height_m: 605.0}\n"
    (tmp_path / "a.yaml").write_text("name: A\n" + origin + "centre_line: line.csv\n")
    (tmp_path / "b.yaml").write_text("name: B\nboundaries: {inner: in.csv, outer: out.csv}\n")
    a, b = load_track(tmp_path / "a.yaml"), load_track(tmp_path / "b.yaml")
    assert (a.name, b.name) == ("A", "B")
    assert a.origin is not None
    assert (a.origin.latitude_deg, a.origin.height) == (36.0, 605.0)
    assert b.origin is None
    assert a.length == pytest.approx(b.length, abs=0.5)


GOOD = """
name: oval
origin: {latitude_deg: 36.0, longitude_deg: -115.0, height_m: 600.0}
start: {x_m: 0.0, y_m: 0.0, heading_deg: 0.0}
half_lap:
  - {name: straight, length_m: 100.0, curvature_start_per_m: 0.0, curvature_end_per_m: 0.0}
  - {name: turn, length_m: 300.0, curvature_start_per_m: 0.01, curvature_end_per_m: 0.01}
width_left_m: [[0.0, 5.0]]
width_right_m: [[0.0, 6.0]]
bank_deg: [[0.0, 2.0], [200.0, 10.0]]
grade_deg: [[0.0, 0.5]]
"""


def test_grade_is_uphill_on_one_half_and_downhill_on_the_other(tmp_path):
    (tmp_path / "t.yaml").write_text(GOOD)
    track = load_track(tmp_path / "t.yaml")
    assert math.degrees(track.road_at_station(100.0)[1]) == pytest.approx(0.5)
    assert math.degrees(track.road_at_station(track.length - 100.0)[1]) == pytest.approx(-0.5)
    assert math.degrees(track.road_at_station(100.0)[0]) == pytest.approx(6.0, abs=0.05)


def change(*path, value=None, drop=False):
    """Change or drop one value of the good file."""

    def apply(tree):
        node = tree
        for key in path[:-1]:
            node = node[key]
        if drop:
            del node[path[-1]]
        else:
            node[path[-1]] = value

    return apply


@pytest.mark.parametrize(
    ("mutate", "key", "allowed"),
    [
        (change("name", drop=True), "name", "missing"),
        (change("name", value=3), "name", "text"),
        (change("colour", value="red"), "colour", "allowed: bank_deg"),
        (change("origin", value=[1, 2]), "origin", "mapping"),
        (change("origin", "height_m", drop=True), "origin.height_m", "missing"),
        (change("origin", "latitude_deg", value=91), "origin.latitude_deg", "from -90 to 90"),
        (change("origin", "latitude_deg", value=float("nan")), "origin.latitude_deg", "from -90 to 90"),
        (change("origin", "longitude_deg", value="west"), "origin.longitude_deg", "number"),
        (change("origin", "height_m", value=True), "origin.height_m", "number"),
        (change("origin", "depth", value=1), "origin.depth", "not allowed"),
        (change("start", drop=True), "start", "missing"),
        (change("start", "x_m", value=float("inf")), "start.x_m", "from -60000 to 60000"),
        (change("half_lap", drop=True), "", "exactly one of"),
        (change("half_lap", value=[]), "half_lap", "at least one"),
        (change("half_lap", value=7), "half_lap", "list"),
        (change("half_lap", 0, value="straight"), "half_lap[0]", "mapping"),
        (change("half_lap", 1, "length_m", value=-5), "half_lap[1].length_m", "from 0.1"),
        (change("half_lap", 1, "curvature_end_per_m", drop=True), "half_lap[1].curvature_end_per_m", "missing"),
        (change("half_lap", 1, "radius", value=3), "half_lap[1].radius", "not allowed"),
        (change("half_lap", 1, "curvature_start_per_m", value=-0.01), "half_lap", "do not turn"),
        (change("centre_line", value="x.csv"), "", "exactly one of"),
        (change("width_left_m", drop=True), "width_left_m", "missing"),
        (change("width_left_m", value=5.0), "width_left_m", "list"),
        (change("width_left_m", 0, value=[0.0]), "width_left_m[0]", "[station m, value]"),
        (change("width_left_m", 0, 1, value=0.0), "width_left_m[0]", "from 1 to 100"),
        (change("bank_deg", 1, 0, value=0.0), "bank_deg[1]", "ascend"),
        (change("bank_deg", 1, 1, value=90), "bank_deg[1]", "from -60 to 60"),
    ],
)
def test_a_wrong_yaml_names_file_and_key_in_one_line(tmp_path, mutate, key, allowed):
    tree = yaml.safe_load(GOOD)
    mutate(tree)
    file = tmp_path / "bad.yaml"
    file.write_text(yaml.safe_dump(tree))
    with pytest.raises(ConfigurationError) as error:
        load_track(file)
    assert error.value.file == str(file)
    assert error.value.key == key
    assert allowed in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "key", "problem"),
    [
        ("name: [\n", "line 2", "node content"),
        ("- 1\n- 2\n", "", "mapping"),
        ("", "", "mapping"),
        ("name: x\n\ty: 2\n", "line 2", "any token"),
        (b"\xff\xfe\x00", "", "UTF-8"),
    ],
)
def test_what_is_not_a_yaml_mapping_is_refused(tmp_path, text, key, problem):
    file = tmp_path / "bad.yaml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigurationError, match=problem) as error:
        load_track(file)
    assert error.value.key == key
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["absent.yaml", "absent.csv"])
def test_a_missing_file_is_named(tmp_path, name):
    with pytest.raises(ConfigurationError, match="cannot be read") as error:
        load_track(tmp_path / name)
    assert name in str(error.value)


def test_yaml_with_a_broken_csv_names_the_csv(tmp_path):
    (tmp_path / "t.yaml").write_text("name: A\ncentre_line: gone.csv\n")
    with pytest.raises(ConfigurationError, match=r"gone\.csv"):
        load_track(tmp_path / "t.yaml")


def circle(count=100, radius=100.0):
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return [[radius * np.cos(a), radius * np.sin(a), 5.0, 5.0] for a in angle]


def edit(line, column, value):
    def apply(rows):
        rows[line][column] = value

    return apply


@pytest.mark.parametrize(
    ("mutate", "key", "problem"),
    [
        (edit(9, 0, "abc"), "line 11", "not numbers"),
        (edit(9, 1, "nan"), "line 11", "not finite"),
        (edit(9, 1, "inf"), "line 11", "not finite"),
        (edit(9, 2, 0.0), "line 11", "w_tr_right_m is 0"),
        (edit(9, 3, -4.0), "line 11", "w_tr_left_m is -4"),
        (edit(9, 3, 101.0), "line 11", "w_tr_left_m is 101"),
        (edit(9, 0, 90_000.0), "line 11", "outside the track frame"),
        (lambda rows: rows[9].append(1.0), "line 11", "has 5 columns"),
        (lambda rows: rows[9].pop(), "line 11", "has 3 columns"),
        (lambda rows: rows.insert(9, list(rows[8])), "line 11", "repeats"),
        (lambda rows: rows.__delitem__(slice(60, None)), "", "not closed"),
        (lambda rows: rows.__delitem__(slice(5, None)), "", "has 5 points"),
        (lambda rows: [row.append(1.5) for row in rows], "line 2", "banking_rad"),
        (edit(9, 0, -60.0), "line 11", "folds the line back"),
    ],
)
def test_a_wrong_csv_names_file_and_line(tmp_path, mutate, key, problem):
    rows = circle()
    mutate(rows)
    file = tmp_path / "bad.csv"
    file.write_text("\n".join(["# x_m,y_m,w_tr_right_m,w_tr_left_m", *(",".join(map(str, r)) for r in rows)]))
    with pytest.raises(ConfigurationError) as error:
        load_track(file)
    assert error.value.file == str(file)
    assert error.value.key == key
    assert problem in str(error.value)
    assert "\n" not in str(error.value)


def test_boundaries_that_do_not_belong_together_are_refused(tmp_path):
    ring = np.array(circle())[:, :2]
    np.savetxt(tmp_path / "inner.csv", ring, delimiter=",")
    np.savetxt(tmp_path / "outer.csv", 3.5 * ring, delimiter=",")
    with pytest.raises(ConfigurationError, match="does not run around"):
        track_from_boundaries(tmp_path / "inner.csv", tmp_path / "outer.csv")


def test_a_line_that_does_not_enclose_anything_is_refused(tmp_path):
    t = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    eight = np.column_stack((100.0 * np.sin(t), 100.0 * np.sin(t) * np.cos(t), 0 * t + 3.0, 0 * t + 3.0))
    np.savetxt(tmp_path / "eight.csv", eight, delimiter=",")
    with pytest.raises(ConfigurationError, match="smooth closed lap"):
        load_track(tmp_path / "eight.csv")
