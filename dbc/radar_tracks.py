"""Tracks of an ESR radar as an array in SI units, and the 64 frames that carry them.

The bits are those of ``radar_esr.dbc``, read from there; all tracks are packed at once, where the generated codec has a
message of its own for each.
"""

from __future__ import annotations

import math
from enum import IntEnum
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dbc.buses import DIRECTORY, Bus, Station
from dbc.frames import FRAME_DTYPE
from dbc.network import load_database, raw_limits

#: Tracks, one frame each.
TRACKS = 64
#: CAN id of the first track.
FIRST_ID = 0x500

#: A track. `id` 1 to 64, `status` and `mode` as below; range from the radar, m; angle from straight ahead, positive to
#: the left, rad (the wire counts clockwise, in degrees); range rate and acceleration, positive away from the radar, m/s
#: and m/s2; lateral rate, positive to the left, m/s; width, m; whether it comes towards us over ground; a bit that
#: toggles with each scan.
TRACK_DTYPE = np.dtype(
    [("id", np.uint8), ("status", np.uint8), ("mode", np.uint8)]
    + [(name, np.float64) for name in ("range", "angle", "range_rate", "range_acceleration", "lateral_rate", "width")]
    + [("oncoming", np.bool_), ("rolling_count", np.uint8)]
)

Tracks = NDArray[np.void]


class TrackStatus(IntEnum):
    """Status of a track, as public drivers name it (Apollo, delphi_esr); one without a target is not in the array."""

    NO_TARGET = 0
    NEW = 1
    NEW_UPDATED = 2
    UPDATED = 3
    COASTED = 4
    MERGED = 5
    INVALID_COASTED = 6
    NEW_COASTED = 7


class RangeMode(IntEnum):
    """Which of its two scans the radar saw a track in."""

    NONE = 0
    MEDIUM_RANGE = 1
    LONG_RANGE = 2
    BOTH = 3


class _Field(NamedTuple):
    """A signal of a track frame.

    Attributes
    ----------
    column : of TRACK_DTYPE.
    shift : of the least significant bit, the data taken as one big-endian number.
    low, high : raw values that its bits hold.
    unit : of a raw step, in the unit of the column.
    """

    column: str
    shift: int
    low: int
    high: int
    unit: float


#: Columns by signal, and by how much what the wire counts differs from what the column does.
_COLUMNS = {
    "CAN_TX_TRACK_STATUS": ("status", 1.0),
    "CAN_TX_TRACK_MED_RANGE_MODE": ("mode", 1.0),
    "CAN_TX_TRACK_RANGE": ("range", 1.0),
    "CAN_TX_TRACK_ANGLE": ("angle", -math.pi / 180.0),
    "CAN_TX_TRACK_RANGE_RATE": ("range_rate", 1.0),
    "CAN_TX_TRACK_RANGE_ACCEL": ("range_acceleration", 1.0),
    # Which way is positive on the wire is not public; taken as that of the angle.
    "CAN_TX_TRACK_LAT_RATE": ("lateral_rate", -1.0),
    "CAN_TX_TRACK_WIDTH": ("width", 1.0),
    "CAN_TX_TRACK_ONCOMING": ("oncoming", 1.0),
    "CAN_TX_TRACK_ROLLING_COUNT": ("rolling_count", 1.0),
}


@cache
def _layout() -> tuple[_Field, ...]:
    """Fields of the first track's frame; the others have the same."""
    message: Any = load_database(DIRECTORY / "radar_esr.dbc").get_message_by_frame_id(FIRST_ID)
    fields = []
    for signal in message.signals:
        if signal.name in _COLUMNS:
            column, sense = _COLUMNS[signal.name]
            # A big-endian signal starts at its most significant bit, counted from 7 to 0 within each byte.
            first = 8 * (signal.start // 8) + 7 - signal.start % 8
            fields.append(_Field(column, 64 - first - signal.length, *raw_limits(signal), float(signal.scale) * sense))
    return tuple(fields)


def _field(column: str) -> _Field:
    return next(field for field in _layout() if field.column == column)


def resolution(column: str) -> float:
    """Step of a column on the wire, in the column's unit."""
    return abs(_field(column).unit)


def wire_limits(column: str) -> tuple[float, float]:
    """Smallest and largest value of a column that the wire carries; what is beyond is sent as these."""
    field = _field(column)
    low, high = sorted((field.low * field.unit, field.high * field.unit))
    return low, high


def on_wire(tracks: Tracks) -> Tracks:
    """Tracks as they are once frames have carried them: rounded to the resolution and cut at the limits.

    Parameters
    ----------
    tracks : TRACK_DTYPE, any number, whatever their ids.

    Raises
    ------
    ValueError
        When a value is not finite.
    """
    carried = tracks.copy()
    for field in _layout():
        carried[field.column] = _steps(field, tracks[field.column]) * field.unit + 0.0  # no -0.0
    return carried


def pack(tracks: Tracks, rolling_count: int = 0) -> NDArray[np.uint8]:
    """Data of all track frames; those without a track are zero but for the rolling count.

    Parameters
    ----------
    tracks : TRACK_DTYPE, shape (n,), with ids of their own.
    rolling_count : of the frames without a track, 0 or 1.

    Returns
    -------
    ndarray of uint8, shape (64, 8)
        Row k belongs to id 0x500 + k and track k + 1.

    Raises
    ------
    ValueError
        When an id is not 1 to 64 or occurs twice, or a value is not finite.
    """
    ids = tracks["id"].astype(np.int64)
    if len(np.unique(ids)) != len(ids) or (len(ids) and not 1 <= ids.min() <= ids.max() <= TRACKS):
        raise ValueError(f"track ids must be different and 1 to {TRACKS}, not {ids.tolist()}")
    count = _field("rolling_count")
    words = np.full(TRACKS, (rolling_count & count.high) << count.shift, dtype=np.uint64)
    words[ids - 1] = sum(
        (_bits(field, tracks[field.column]) << np.uint64(field.shift) for field in _layout()),
        start=np.zeros(len(ids), dtype=np.uint64),
    )
    return words.astype(">u8").view(np.uint8).reshape(TRACKS, 8)


def track_frames(tracks: Tracks, rolling_count: int) -> bytes:
    """All track frames of a scan, for CAN-R.

    Parameters
    ----------
    tracks : TRACK_DTYPE, shape (n,), with ids of their own and this rolling count.
    rolling_count : of the scan, 0 or 1.

    Returns
    -------
    bytes
        64 frames of 24 bytes, by identifier.

    Raises
    ------
    ValueError
        As `pack`.
    """
    frames = np.zeros(TRACKS, dtype=FRAME_DTYPE)
    frames["id"] = np.arange(FIRST_ID, FIRST_ID + TRACKS)
    frames["bus"], frames["sender"], frames["dlc"] = Bus.CAN_R, Station.SENSORS, 8
    frames["data"] = pack(tracks, rolling_count)
    return frames.tobytes()


def rolling_counts(data: ArrayLike) -> NDArray[np.uint8]:
    """Rolling count of every frame, of those without a track too.

    Parameters
    ----------
    data : uint8, shape (64, 8), as `pack` gives it.

    Returns
    -------
    ndarray of uint8, shape (64,)

    Raises
    ------
    ValueError
        When the shape is another.
    """
    count = _field("rolling_count")
    return ((_words(data) >> np.uint64(count.shift)) & np.uint64(count.high)).astype(np.uint8)


def unpack(data: ArrayLike) -> Tracks:
    """Tracks of one scan from the data of its frames; what has the status NO_TARGET is left out.

    Parameters
    ----------
    data : uint8, shape (64, 8), as `pack` gives it.

    Raises
    ------
    ValueError
        When the shape is another.
    """
    words = _words(data)
    tracks = np.zeros(TRACKS, dtype=TRACK_DTYPE)
    tracks["id"] = np.arange(1, TRACKS + 1)
    for field in _layout():
        span = field.high - field.low + 1
        raw = ((words >> np.uint64(field.shift)) & np.uint64(span - 1)).astype(np.int64)
        tracks[field.column] = np.where(raw > field.high, raw - span, raw) * field.unit + 0.0  # no -0.0
    return np.asarray(tracks[tracks["status"] != TrackStatus.NO_TARGET])


def _words(data: ArrayLike) -> NDArray[np.uint64]:
    """Data of all track frames as numbers, the first byte being the highest; shape (64,)."""
    rows = np.ascontiguousarray(data, dtype=np.uint8)
    if rows.shape != (TRACKS, 8):
        raise ValueError(f"data must have the shape ({TRACKS}, 8), not {rows.shape}")
    return rows.reshape(-1).view(">u8").astype(np.uint64)


def _steps(field: _Field, values: NDArray[Any]) -> NDArray[np.int64]:
    """Nearest raw values that the bits of a field hold."""
    steps = np.asarray(values, dtype=np.float64) / field.unit
    if not np.isfinite(steps).all():
        raise ValueError(f"{field.column} is not finite")
    return np.rint(steps).clip(field.low, field.high).astype(np.int64)


def _bits(field: _Field, values: NDArray[Any]) -> NDArray[np.uint64]:
    return (_steps(field, values) & np.int64(field.high - field.low)).astype(np.uint64)
