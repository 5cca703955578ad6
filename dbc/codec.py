"""Encode and decode CAN messages through the generated C codec.

The hot path stays in C: a message is looked up once, then :meth:`MessageCodec.frame` and :meth:`MessageCodec.decode`
take physical values in the order of :attr:`MessageCodec.signals` (by start bit) and give bytes, and back. What only
people need (units, value tables, comments) is read from the DBC files with cantools, once and on demand.

::

    steering = database.message("steering_cmd")
    frame = steering.frame(-105.5, 5, time_us=10_000)  # 24 bytes
    angle, counter = steering.decode(frame[16:])

:data:`database` is the car's own profile, V14; ``profile("V26")`` gives the messages of another one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache, cached_property
from math import isfinite
from pathlib import Path
from struct import Struct
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dbc._codec import ffi, lib
from dbc.buses import DEFAULT_PROFILE, DIRECTORY, PROFILES, STEMS
from dbc.errors import CodecError, ConfigurationError
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, Buffer, Bus, Station

if TYPE_CHECKING:
    from cantools.database.can import Message

    from dbc.network import MessageFacts

_DATA_SIZE = 8


class MessageCodec:
    """One message. Not to be shared between threads: it works in buffers of its own.

    Attributes
    ----------
    index : row in the table of its profile.
    name, database : name of the message and stem of its DBC file.
    bus, frame_id, extended, length : address, and number of data bytes.
    sender : station that owns the message.
    cycle_us, timeout_us : nominal period and age at which the content is stale; 0 for none.
    signals : names in the order of the values.
    """

    __slots__ = (
        "_codec",
        "_data",
        "_data_buffer",
        "_frame",
        "_frame_buffer",
        "_profile",
        "_unpack",
        "_values",
        "_values_buffer",
        "bus",
        "cycle_us",
        "database",
        "extended",
        "frame_id",
        "index",
        "length",
        "name",
        "sender",
        "signals",
        "timeout_us",
    )

    def __init__(self, codec: Codec, index: int) -> None:
        row = codec._rows[index]
        entry = codec._entries[index]
        self._codec = codec
        self._profile = codec.number
        self.index = index
        self.name: str = ffi.string(entry.name).decode()
        self.database: str = ffi.string(entry.database).decode()
        self.bus = Bus(row.bus)
        self.frame_id: int = row.id
        self.extended = bool(row.extended)
        self.length: int = row.dlc
        self.sender = Station(row.sender)
        self.cycle_us: int = row.cycle_ms * 1000
        self.timeout_us: int = row.timeout_ms * 1000
        self.signals: tuple[str, ...] = tuple(
            ffi.string(entry.signals[i].name).decode() for i in range(entry.signal_count)
        )
        self._values = ffi.new("double[]", len(self.signals))
        self._values_buffer = ffi.buffer(self._values)
        self._unpack = Struct(f"={len(self.signals)}d").unpack
        self._data = ffi.new("uint8_t[]", _DATA_SIZE)
        self._data_buffer = ffi.buffer(self._data)
        self._frame = ffi.new("can_frame *")
        self._frame_buffer = ffi.buffer(self._frame)

    def __repr__(self) -> str:
        return f"MessageCodec({self.name!r}, {self.bus.name}, 0x{self.frame_id:X})"

    def encode(self, *values: float) -> bytes:
        """Encode one value per signal into 8 data bytes.

        Raises
        ------
        CodecError
            When the number of values is wrong, or one is not finite or does not fit its bits.
        """
        try:
            self._values[0 : len(self.signals)] = values
        except (IndexError, ValueError):
            raise self._wrong_count(len(values)) from None
        status = lib.codec_values_encode(self._profile, self.index, self._values, self._data)
        if status:
            raise self._refused(values, status)
        return bytes(self._data_buffer)

    def frame(self, *values: float, time_us: int = 0, sender: int | None = None) -> bytes:
        """Encode one value per signal into a frame of 24 bytes.

        Parameters
        ----------
        values : physical values in the order of :attr:`signals`.
        time_us : time stamp, microseconds.
        sender : station number; the message's owner by default.

        Raises
        ------
        CodecError
            As :meth:`encode`.
        """
        try:
            self._values[0 : len(self.signals)] = values
        except (IndexError, ValueError):
            raise self._wrong_count(len(values)) from None
        status = lib.codec_values_frame(
            self._profile,
            self.index,
            time_us,
            self.sender if sender is None else sender,
            self._values,
            self._frame,
        )
        if status:
            raise self._refused(values, status)
        return bytes(self._frame_buffer)

    def frames(self, values: ArrayLike, time_us: ArrayLike = 0, sender: int | None = None) -> bytes:
        """Encode many rows of values at once.

        Parameters
        ----------
        values : physical values, shape (n, number of signals).
        time_us : time stamps, shape (n,) or one for all.
        sender : station number; the message's owner by default.

        Returns
        -------
        bytes
            n frames.

        Raises
        ------
        CodecError
            When the shape is wrong, or a value is not finite or does not fit its bits; names row and signal.
        """
        rows = np.ascontiguousarray(values, dtype=np.float64)
        width = len(self.signals)
        if rows.ndim != 2 or rows.shape[1] != width:
            raise CodecError(f"{self.name} needs an array of shape (n, {width}), not {rows.shape}")
        times = np.ascontiguousarray(np.broadcast_to(np.asarray(time_us, dtype=np.uint64), rows.shape[0]))
        out = np.zeros(rows.shape[0], dtype=FRAME_DTYPE)
        status = lib.codec_values_frames(
            self._profile,
            self.index,
            ffi.from_buffer("uint64_t[]", times),
            self.sender if sender is None else sender,
            ffi.from_buffer("double[]", rows),
            rows.shape[0],
            ffi.from_buffer("can_frame[]", out, require_writable=True),
        )
        if status:
            row, signal = divmod(status - 1, width)
            raise CodecError(f"row {row}: {self._refused(rows[row].tolist(), signal + 1)}")
        return out.tobytes()

    def decode(self, data: Buffer) -> tuple[float, ...]:
        """Decode data bytes into one physical value per signal, in the order of :attr:`signals`.

        Raises
        ------
        CodecError
            When there are fewer bytes than the message has; more are ignored.
        """
        data = bytes(data)
        if lib.codec_values_decode(self._profile, self.index, data, len(data), self._values):
            raise CodecError(f"{self.name} has {self.length} data bytes, not {len(data)}")
        return self._unpack(self._values_buffer)

    def columns(self, frames: NDArray[np.void]) -> NDArray[np.float64]:
        """Decode frames of this message into columns; whether they are of it is not looked at.

        Parameters
        ----------
        frames : array of :data:`dbc.frames.FRAME_DTYPE`, shape (n,).

        Returns
        -------
        array
            Physical values, shape (number of signals, n).
        """
        frames = np.ascontiguousarray(frames, dtype=FRAME_DTYPE)
        return self._columns(frames, np.arange(len(frames), dtype=np.uint32))

    def _columns(self, frames: NDArray[np.void], rows: NDArray[np.uint32]) -> NDArray[np.float64]:
        """Decode those of some frames that are in the rows; both arrays contiguous."""
        values = np.empty((len(self.signals), len(rows)))
        lib.codec_values_decode_columns(
            self._profile,
            self.index,
            ffi.from_buffer("can_frame[]", frames),
            ffi.from_buffer("uint32_t[]", rows),
            len(rows),
            ffi.from_buffer("double[]", values, require_writable=True),
        )
        return values

    def finish(self, frame: Buffer, counter: int) -> bytes:
        """Write message counter and CRC into a frame of this message, as its sender does before sending.

        Parameters
        ----------
        frame : 24 bytes.
        counter : taken modulo the width of the counter field; ignored when the message has none.

        Raises
        ------
        CodecError
            When ``frame`` is not 24 bytes long.
        """
        content = bytes(frame)
        if len(content) != FRAME_SIZE:
            raise CodecError(f"a frame has {FRAME_SIZE} bytes, not {len(content)}")
        self._frame_buffer[:] = content
        lib.codec_finish(self._frame, self._codec._rows + self.index, ffi.new("uint8_t *", counter & 0xFF))
        return bytes(self._frame_buffer)

    def seal(self, frame: Buffer) -> bytes:
        """Write the CRC that fits the content of a frame of this message, its message counter included.

        Raises
        ------
        CodecError
            When ``frame`` is not 24 bytes long.
        """
        row = self._codec._rows[self.index]
        word = int.from_bytes(bytes(frame)[-_DATA_SIZE:], "little")
        return self.finish(frame, word >> row.counter_start & ((1 << row.counter_length) - 1))

    def limits(self, signal: str) -> tuple[float, float]:
        """Smallest and largest physical value that the bits of a signal hold.

        Raises
        ------
        CodecError
            When the message has no such signal.
        """
        if signal not in self.signals:
            raise _unknown(f"signal of {self.name}", signal, self.signals)
        entry = self._codec._entries[self.index].signals[self.signals.index(signal)]
        ends = (entry.raw_min * entry.scale + entry.offset, entry.raw_max * entry.scale + entry.offset)
        return min(ends), max(ends)

    @property
    def facts(self) -> MessageFacts:
        """What the DBC file says of the message, with its attributes read."""
        return self._codec.facts(self.name)

    @property
    def definition(self) -> Message:
        """The message as cantools parsed it from the DBC file: comments, value tables, declared ranges."""
        return self.facts.message

    @property
    def units(self) -> tuple[str, ...]:
        """Unit per signal; empty where the DBC file gives none."""
        return tuple(signal.unit or "" for signal in self.definition.signals)

    @property
    def choices(self) -> dict[str, dict[int, str]]:
        """Value tables by signal name, for the signals that have one."""
        return {
            signal.name: {int(value): str(name) for value, name in signal.choices.items()}
            for signal in self.definition.signals
            if signal.choices
        }

    def _wrong_count(self, count: int) -> CodecError:
        return CodecError(f"{self.name} needs {len(self.signals)} values ({', '.join(self.signals)}), not {count}")

    def _refused(self, values: Sequence[float], number: int) -> CodecError:
        signal = self.signals[number - 1]
        value = values[number - 1]
        low, high = self.limits(signal)
        problem = "is out of range" if isfinite(value) else "is not finite"
        return CodecError(f"{self.name}.{signal}: {value:g} {problem}; allowed is {low:.10g} to {high:.10g}")


class Codec:
    """All messages of the bench in one profile, by name. Mostly to be had from :func:`profile`.

    Parameters
    ----------
    directory : where the DBC files are, for what is not compiled in.
    profile : one of `dbc.buses.PROFILES`.

    Attributes
    ----------
    profile : as above.
    number : of it, ``enum codec_profile_index`` of the firmware.
    """

    def __init__(self, directory: Path = DIRECTORY, profile: str = DEFAULT_PROFILE) -> None:
        self.profile = profile
        self._directory = directory
        self.number = list(PROFILES).index(profile)
        self._rows: Any = lib.codec_profiles[self.number].messages
        self._entries: Any = lib.codec_values_profiles[self.number].messages
        self._messages = [MessageCodec(self, index) for index in range(lib.codec_profiles[self.number].count)]
        self._by_name = {message.name: message for message in self._messages}
        self._by_address = {(message.bus, message.extended, message.frame_id): message for message in self._messages}

    def __iter__(self) -> Iterator[MessageCodec]:
        return iter(self._messages)

    def __len__(self) -> int:
        return len(self._messages)

    def message(self, name: str) -> MessageCodec:
        """Look a message up by name.

        Raises
        ------
        CodecError
            When there is none; names the nearest one.
        """
        try:
            return self._by_name[name]
        except KeyError:
            raise _unknown("message", name, self._by_name) from None

    def find(self, bus: int, frame_id: int, extended: bool = False) -> MessageCodec | None:
        """Look a message up by address."""
        return self._by_address.get((Bus(bus), extended, frame_id))

    def identify(self, frames: NDArray[np.void]) -> NDArray[np.int32]:
        """Row of each frame in the profile's table, or the negative ``codec_status`` for which a receiver drops it.

        Parameters
        ----------
        frames : array of :data:`dbc.frames.FRAME_DTYPE`, shape (n,).
        """
        frames = np.ascontiguousarray(frames, dtype=FRAME_DTYPE)
        index = np.empty(len(frames), dtype=np.int32)
        lib.codec_values_identify(
            self.number,
            ffi.from_buffer("can_frame[]", frames),
            len(frames),
            ffi.from_buffer("int32_t[]", index, require_writable=True),
        )
        return index

    def decode_columns(
        self, frames: NDArray[np.void]
    ) -> dict[str, dict[str, tuple[NDArray[np.uint64], NDArray[np.float64]]]]:
        """Decode recorded frames into columns.

        Parameters
        ----------
        frames : array of :data:`dbc.frames.FRAME_DTYPE`, shape (n,). Frames that no receiver would accept are left
            out; :meth:`identify` tells which.

        Returns
        -------
        dict
            By message, then by signal: times in microseconds and physical values, both of shape (number of frames of
            that message,). The signals of a message share one array of times.
        """
        frames = np.ascontiguousarray(frames, dtype=FRAME_DTYPE)
        index = self.identify(frames)
        order = np.argsort(index, kind="stable").astype(np.uint32)
        first = np.searchsorted(index[order], np.arange(len(self) + 1))
        columns: dict[str, dict[str, tuple[NDArray[np.uint64], NDArray[np.float64]]]] = {}
        for message, start, stop in zip(self, first[:-1], first[1:], strict=True):
            if start == stop:
                continue
            rows = order[start:stop]
            values = message._columns(frames, rows)
            times = frames["time_us"][rows]
            columns[message.name] = {
                signal: (times, column) for signal, column in zip(message.signals, values, strict=True)
            }
        return columns

    def check_sources(self) -> None:
        """Check that the profile's DBC files are those that the C codec was built from.

        Raises
        ------
        ConfigurationError
            Names the first file that is missing or was changed since.
        """
        for stem in PROFILES[self.profile]:
            path = self._directory / f"{stem}.dbc"
            try:
                digest = hashlib.sha256(path.read_bytes()).hexdigest()
            except OSError as error:
                raise ConfigurationError(path, "", error.strerror or "cannot be read") from error
            if digest != ffi.string(lib.codec_values_sha256[STEMS.index(stem)]).decode():
                raise ConfigurationError(path, "", "differs from the file that the codec was built from; build again")

    def facts(self, name: str) -> MessageFacts:
        """Return what the DBC file says of a message.

        Raises
        ------
        CodecError
            When there is no such message.
        ConfigurationError
            When a DBC file is missing, broken or not the one that the C codec was built from.
        """
        return self._facts[self.message(name).name]

    @cached_property
    def _facts(self) -> Mapping[str, MessageFacts]:
        # cantools takes longer to import than all of this to run; most users never need it.
        from dbc.network import load_network  # noqa: PLC0415

        network = {facts.message.name: facts for facts in load_network(self._directory, self.profile)}
        self.check_sources()
        return network


def _unknown(kind: str, name: str, known: Iterable[str]) -> CodecError:
    nearest = get_close_matches(name, list(known), n=1, cutoff=0.0)
    return CodecError(f"no {kind} is called {name!r}; the nearest is {nearest[0]!r}")


@cache
def profile(name: str) -> Codec:
    """Return the messages of a profile; each is made once.

    Raises
    ------
    CodecError
        When there is none of that name; says which there are.
    """
    if name not in PROFILES:
        raise CodecError(f"no profile is called {name!r}; there are {', '.join(PROFILES)}")
    return Codec(profile=name)


#: The messages of the car's own profile.
database = profile(DEFAULT_PROFILE)
