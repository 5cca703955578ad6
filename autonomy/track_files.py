"""Tracks from files: our YAML, the TUM race track CSV, two files of boundary points.

Every error is a ConfigurationError that names the file and the key or line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from autonomy.frenet import Curve, FloatArray, Projector
from autonomy.segments import Piece, mirrored_lap
from autonomy.track import SIDES, Origin, Track
from dbc.errors import ConfigurationError

NODE_SPACING = 1.0  # m, of the centre line
_MAX_LENGTH = 50_000.0  # m
_MAX_WIDTH = 100.0  # m, from the centre line
_MAX_ANGLE = 60.0  # deg, of bank and grade
_MAX_CURVATURE = 0.5  # 1/m
_SAME_POINT = 1.0e-3  # m
_TUM_HEADER = "x_m,y_m,w_tr_right_m,w_tr_left_m[,banking_rad]"


def load_track(path: str | Path) -> Track:
    """Track from a YAML description or, by the suffix .csv, from a TUM race track file.

    Raises
    ------
    ConfigurationError : the file is missing or wrong.
    """
    path = Path(path)
    return track_from_csv(path) if path.suffix.lower() == ".csv" else _track_from_yaml(path)


def track_from_csv(
    path: str | Path, name: str | None = None, origin: Origin | None = None, walled: Sequence[str] = ()
) -> Track:
    """Track from a closed centre line in the TUM race track database's format.

    Rows of x, y, width to the right, width to the left (m) and, optionally, bank (rad); `#` begins a comment.
    """
    path = Path(path)
    rows = _read_rows(path, (4, 5), _TUM_HEADER)
    _check_line(path, rows)
    for column, what in ((2, "w_tr_right_m"), (3, "w_tr_left_m")):
        for line, values in rows:
            if not 0.0 < values[column] <= _MAX_WIDTH:
                raise ConfigurationError(path, f"line {line}", f"{what} is {values[column]:g}; 0 < width <= 100 m")
    table = _opened(np.array([values for _, values in rows]))
    if table.shape[1] == 5:
        for line, values in rows:
            if abs(values[4]) > math.radians(_MAX_ANGLE):
                raise ConfigurationError(path, f"line {line}", f"banking_rad is {values[4]:g}; allowed -1.047 to 1.047")
    centre = _curve_through(path, table[:, 0], table[:, 1])
    knots = _stations(centre, table[:, :2])
    bank = _periodic(centre, knots, table[:, 4]) if table.shape[1] == 5 else np.zeros(centre.count)
    return Track(
        name or path.stem,
        origin,
        centre,
        width_left=_periodic(centre, knots, table[:, 3]),
        width_right=_periodic(centre, knots, table[:, 2]),
        bank=bank,
        grade=np.zeros(centre.count),
        walled=walled,
    )


def track_from_boundaries(
    inner: str | Path,
    outer: str | Path,
    name: str | None = None,
    origin: Origin | None = None,
    walled: Sequence[str] = (),
) -> Track:
    """Track between two closed boundaries, given as rows of x, y (m) each; driven in the inner file's order."""
    inner, outer = Path(inner), Path(outer)
    inner_rows, outer_rows = _read_rows(inner, (2,), "x,y"), _read_rows(outer, (2,), "x,y")
    _check_line(inner, inner_rows)
    _check_line(outer, outer_rows)
    inside = _curve_through(inner, *_opened(np.array([v for _, v in inner_rows])).T)
    outside = _curve_through(outer, *_opened(np.array([v for _, v in outer_rows])).T)
    centre = inside
    # The middle between the nearest points of both boundaries; each round starts from a better middle line.
    for _ in range(4):
        near_inside, near_outside = _nearest_points(centre, inside), _nearest_points(centre, outside)
        middle = 0.5 * (near_inside + near_outside)
        centre = Curve.through(middle[::4, 0], middle[::4, 1], max(16, round(centre.length / NODE_SPACING)))
    to_inside = _nearest_points(centre, inside) - np.column_stack((centre.x, centre.y))
    to_outside = _nearest_points(centre, outside) - np.column_stack((centre.x, centre.y))
    normal = np.column_stack((-np.sin(centre.heading), np.cos(centre.heading)))
    inside_left = np.einsum("ij,ij->i", to_inside, normal)
    outside_left = np.einsum("ij,ij->i", to_outside, normal)
    left, right = (inside_left, -outside_left) if centre.turn > 0.0 else (outside_left, -inside_left)
    if min(float(left.min()), float(right.min())) <= 0.0 or max(float(left.max()), float(right.max())) > _MAX_WIDTH:
        raise ConfigurationError(outer, "", f"does not run around {inner} at a distance of 0 to {2 * _MAX_WIDTH:g} m")
    flat = np.zeros(centre.count)
    return Track(
        name or inner.stem,
        origin,
        centre,
        width_left=left,
        width_right=right,
        bank=flat,
        grade=flat.copy(),
        walled=walled,
    )


def _nearest_points(line: Curve, boundary: Curve) -> FloatArray:
    """Foot points on the boundary of all nodes of a line, shape (n, 2)."""
    projector = Projector(boundary)
    stations = np.array([projector.project(x, y)[0] for x, y in zip(line.x.tolist(), line.y.tolist(), strict=True)])
    x, y, _, _ = boundary.at(stations)
    return np.column_stack((x, y))


def _track_from_yaml(path: Path) -> Track:
    node = _Node(path, "", _read_yaml(path))
    node.only(
        {
            "name",
            "origin",
            "start",
            "half_lap",
            "centre_line",
            "boundaries",
            "width_left_m",
            "width_right_m",
            "bank_deg",
            "grade_deg",
            "walls",
        }
    )
    name = node.text("name")
    origin = None
    if "origin" in node:
        at = node.child("origin")
        at.only({"latitude_deg", "longitude_deg", "height_m"})
        origin = Origin(
            at.number("latitude_deg", -90.0, 90.0),
            at.number("longitude_deg", -180.0, 180.0),
            at.number("height_m", -500.0, 9000.0),
        )
    shapes = [key for key in ("half_lap", "centre_line", "boundaries") if key in node]
    if len(shapes) != 1:
        raise ConfigurationError(path, "", "needs exactly one of half_lap, centre_line, boundaries")
    walled = node.chosen("walls", SIDES) if "walls" in node else []
    if shapes[0] == "half_lap":
        return _track_from_segments(node, name, origin, walled)
    node.only({"name", "origin", "walls", shapes[0]})
    if shapes[0] == "centre_line":
        return track_from_csv(path.parent / node.text("centre_line"), name, origin, walled)
    files = node.child("boundaries")
    files.only({"inner", "outer"})
    return track_from_boundaries(
        path.parent / files.text("inner"), path.parent / files.text("outer"), name, origin, walled
    )


def _track_from_segments(node: _Node, name: str, origin: Origin | None, walled: Sequence[str]) -> Track:
    start = node.child("start")
    start.only({"x_m", "y_m", "heading_deg"})
    pieces = []
    for piece in node.children("half_lap"):
        piece.only({"name", "length_m", "curvature_start_per_m", "curvature_end_per_m"})
        pieces.append(
            Piece(
                piece.number("length_m", 0.1, _MAX_LENGTH),
                piece.number("curvature_start_per_m", -_MAX_CURVATURE, _MAX_CURVATURE),
                piece.number("curvature_end_per_m", -_MAX_CURVATURE, _MAX_CURVATURE),
            )
        )
    pose = (
        start.number("x_m", -60_000.0, 60_000.0),
        start.number("y_m", -60_000.0, 60_000.0),
        math.radians(start.number("heading_deg", -360.0, 360.0)),
    )
    try:
        centre = mirrored_lap(pieces, pose, NODE_SPACING)
    except ValueError as error:
        raise ConfigurationError(node.file, "half_lap", str(error)) from None
    # The profiles are given over half a lap; the other half is the mirror image.
    half_stations = np.minimum(centre.stations, centre.length - centre.stations)

    def profile(key: str, low: float, high: float, default: float | None = None) -> FloatArray:
        if key not in node and default is not None:
            return np.full(centre.count, default)
        points = node.profile(key, low, high)
        return np.asarray(np.interp(half_stations, points[:, 0], points[:, 1]))

    return Track(
        name,
        origin,
        centre,
        width_left=profile("width_left_m", 1.0, _MAX_WIDTH),
        width_right=profile("width_right_m", 1.0, _MAX_WIDTH),
        bank=np.radians(profile("bank_deg", -_MAX_ANGLE, _MAX_ANGLE, 0.0)),
        # Uphill on the way out is downhill on the way back.
        grade=np.radians(profile("grade_deg", -_MAX_ANGLE, _MAX_ANGLE, 0.0))
        * np.where(centre.stations <= 0.5 * centre.length, 1.0, -1.0),
        walled=walled,
    )


class _Node:
    """A mapping of a YAML file that knows where it stands."""

    def __init__(self, file: Path, key: str, value: Any) -> None:
        if not isinstance(value, dict):
            raise ConfigurationError(file, key, "must be a mapping of keys to values")
        self.file, self.key, self._value = file, key, value

    def __contains__(self, key: str) -> bool:
        return key in self._value

    def _path(self, key: object) -> str:
        return f"{self.key}.{key}" if self.key else str(key)

    def _get(self, key: str) -> Any:
        if key not in self._value:
            raise ConfigurationError(self.file, self._path(key), "is missing")
        return self._value[key]

    def only(self, allowed: set[str]) -> None:
        for key in self._value:
            if key not in allowed:
                raise ConfigurationError(
                    self.file, self._path(key), f"is not allowed here; allowed: {', '.join(sorted(allowed))}"
                )

    def text(self, key: str) -> str:
        value = self._get(key)
        if not isinstance(value, str) or not value:
            raise ConfigurationError(self.file, self._path(key), f"is {value!r}; must be text")
        return value

    def number(self, key: str, low: float, high: float) -> float:
        return _number(self.file, self._path(key), self._get(key), low, high)

    def child(self, key: str) -> _Node:
        return _Node(self.file, self._path(key), self._get(key))

    def children(self, key: str) -> list[_Node]:
        value = self._get(key)
        if not isinstance(value, list) or not value:
            raise ConfigurationError(self.file, self._path(key), "must be a list with at least one entry")
        return [_Node(self.file, f"{self._path(key)}[{i}]", entry) for i, entry in enumerate(value)]

    def chosen(self, key: str, allowed: Sequence[str]) -> list[str]:
        """Words of a list, each of them allowed and given once."""
        value = self._get(key)
        words = ", ".join(allowed)
        if not isinstance(value, list) or any(word not in allowed for word in value) or len(set(value)) < len(value):
            raise ConfigurationError(self.file, self._path(key), f"is {value!r}; must be a list of any of {words}")
        return value

    def profile(self, key: str, low: float, high: float) -> FloatArray:
        """Points [station m, value] with ascending stations, shape (n, 2)."""
        value, path = self._get(key), self._path(key)
        if not isinstance(value, list) or not value:
            raise ConfigurationError(self.file, path, "must be a list of [station m, value]")
        points: list[tuple[float, float]] = []
        for i, entry in enumerate(value):
            at = f"{path}[{i}]"
            if not isinstance(entry, list) or len(entry) != 2:
                raise ConfigurationError(self.file, at, "must be [station m, value]")
            station = _number(self.file, at, entry[0], 0.0, _MAX_LENGTH)
            if points and station <= points[-1][0]:
                raise ConfigurationError(self.file, at, f"station {station:g} does not ascend")
            points.append((station, _number(self.file, at, entry[1], low, high)))
        return np.array(points)


def _number(file: Path, key: str, value: Any, low: float, high: float) -> float:
    # Written so that NaN fails too.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ConfigurationError(file, key, f"is {value!r}; must be a number from {low:g} to {high:g}")
    return float(value)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(path, "", f"cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigurationError(path, "", "is not UTF-8 text") from None


def _read_yaml(path: Path) -> Any:
    try:
        return yaml.safe_load(_read_text(path))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or "is not YAML"
        raise ConfigurationError(path, f"line {mark.line + 1}" if mark else "", str(problem)) from None


def _read_rows(path: Path, columns: tuple[int, ...], header: str) -> list[tuple[int, list[float]]]:
    """Rows of finite numbers with their line numbers; all rows equally long."""
    rows: list[tuple[int, list[float]]] = []
    for line, text in enumerate(_read_text(path).splitlines(), start=1):
        content = text.split("#", 1)[0].strip()
        if not content:
            continue
        try:
            values = [float(field) for field in content.split(",")]
        except ValueError:
            raise ConfigurationError(path, f"line {line}", f"is not numbers; expected {header}") from None
        if not all(math.isfinite(value) for value in values):
            raise ConfigurationError(path, f"line {line}", "holds a number that is not finite")
        if len(values) not in columns or (rows and len(values) != len(rows[0][1])):
            raise ConfigurationError(path, f"line {line}", f"has {len(values)} columns; expected {header}")
        rows.append((line, values))
    if len(rows) < 8:
        raise ConfigurationError(path, "", f"has {len(rows)} points; at least 8 are needed: {header}")
    return rows


def _check_line(path: Path, rows: list[tuple[int, list[float]]]) -> None:
    """Points must be a closed line: no repeated neighbour, no point that folds it, no gap out of all proportion."""
    xy = np.array([values[:2] for _, values in rows])
    if np.max(np.abs(xy)) > 60_000.0:
        line = rows[int(np.argmax(np.max(np.abs(xy), axis=1)))][0]
        raise ConfigurationError(path, f"line {line}", "lies outside the track frame; allowed -60000 to 60000 m")
    chord = np.roll(xy, -1, axis=0) - xy
    step = np.hypot(chord[:, 0], chord[:, 1])
    if step[:-1].min() < _SAME_POINT:
        raise ConfigurationError(path, f"line {rows[int(np.argmin(step[:-1])) + 1][0]}", "repeats the point before it")
    if step[-1] > 5.0 * step[:-1].max() and step[-1] > 20.0:
        raise ConfigurationError(path, "", f"is not closed: {step[-1]:.1f} m from the last point to the first")
    ahead = np.einsum("ij,ij->i", chord[1:-1], chord[:-2])
    if ahead.min() <= 0.0:
        worst = int(np.argmin(ahead / (step[1:-1] * step[:-2]))) + 1
        raise ConfigurationError(path, f"line {rows[worst][0]}", "folds the line back; a turn must stay below 90 deg")


def _opened(table: FloatArray) -> FloatArray:
    """Table without a last row that repeats the first."""
    return table[:-1] if float(np.hypot(*(table[0, :2] - table[-1, :2]))) < _SAME_POINT else table


def _curve_through(path: Path, x: FloatArray, y: FloatArray) -> Curve:
    rough = float(np.sum(np.hypot(np.roll(x, -1) - x, np.roll(y, -1) - y)))
    curve = Curve.through(x, y, max(16, round(rough / NODE_SPACING)))
    if curve.turn == 0.0 or float(np.max(np.abs(curve.curvature))) > _MAX_CURVATURE:
        raise ConfigurationError(path, "", "is not one smooth closed lap with a radius of 2 m or more")
    return curve


def _stations(curve: Curve, points: FloatArray) -> FloatArray:
    projector = Projector(curve)
    stations = np.array([projector.project(float(x), float(y))[0] for x, y in points])
    # The first point is the curve's start; rounding may put it just before the end.
    stations[0] = 0.0
    return stations


def _periodic(curve: Curve, stations: FloatArray, values: FloatArray) -> FloatArray:
    return np.interp(curve.stations, stations, values, period=curve.length)
