"""The five buses as their DBC files describe them: loading, checks and the facts that a codec needs.

Used by the generators and, lazily, by :mod:`dbc.codec`. Depends on cantools only, because the build runs it
before anything is compiled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cantools.database
from cantools.database.can import Database, Message, Signal
from cantools.database.errors import Error

from dbc.buses import DEFAULT_PROFILE, DIRECTORY, PROFILES, Bus, Station
from dbc.errors import ConfigurationError

#: Station behind each node (BU_) of the DBC files.
STATIONS: Mapping[str, Station] = MappingProxyType(
    {
        "OBC": Station.OBC,
        "RAPTOR": Station.RAPTOR,
        "SPACE_DRIVE": Station.SPACE_DRIVE,
        "AUTONOMY": Station.AUTONOMY,
        "OPERATOR": Station.OPERATOR,
        "GNSS": Station.SENSORS,
        "GNSS_A": Station.SENSORS,
        "GNSS_B": Station.SENSORS,
        "IMU": Station.SENSORS,
        "RADAR": Station.SENSORS,
    }
)

_COUNTER_BITS_MAX = 8
_CRC_BITS = 16
_DATA_MAX = 8
_SIGNAL_BITS_MAX = 32  # a raw value and its scaled double convert into each other without loss


@dataclass(frozen=True)
class MessageFacts:
    """One message with what its DBC attributes say.

    Attributes
    ----------
    database : stem of the DBC file.
    message : the message as cantools parsed it.
    bus, sender : where it travels and who owns it.
    receivers : who any of its signals is for.
    cycle_ms, timeout_ms : nominal period and age at which the content is stale; 0 for none.
    frames_per_cycle : frames of this message sent in one period.
    counter, crc : signals that hold the message counter and the CRC, if any.
    """

    database: str
    message: Message
    bus: Bus
    sender: Station
    receivers: frozenset[Station]
    cycle_ms: int
    timeout_ms: int
    frames_per_cycle: int
    counter: Signal | None
    crc: Signal | None

    @property
    def key(self) -> tuple[int, bool, int]:
        """Order of codec_table: bus, 29-bit ids after 11-bit ids, id."""
        return int(self.bus), bool(self.message.is_extended_frame), int(self.message.frame_id)


def raw_limits(signal: Signal) -> tuple[int, int]:
    """Smallest and largest raw value that the bits of a signal hold."""
    if signal.is_signed:
        return -(1 << (signal.length - 1)), (1 << (signal.length - 1)) - 1
    return 0, (1 << signal.length) - 1


def load_database(path: Path, strict: bool = True) -> Database:
    """Parse one DBC file.

    Parameters
    ----------
    path : the file.
    strict : whether signals that overlap or do not fit into their message are errors.

    Raises
    ------
    ConfigurationError
        When the file cannot be read or parsed, with the parser's reason in one line.
    """
    try:
        # cp1252 is what Vector's tools write; cantools' own default.
        database = cantools.database.load_file(path, database_format="dbc", encoding="cp1252", strict=strict)
    except OSError as error:
        raise ConfigurationError(path, "", error.strerror or "cannot be read") from error
    except (Error, UnicodeDecodeError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigurationError(path, "", f"not a valid DBC file: {reason}") from error
    if not isinstance(database, Database):
        raise ConfigurationError(path, "", "not a DBC file")
    return database


def load_network(directory: Path = DIRECTORY, profile: str = DEFAULT_PROFILE) -> list[MessageFacts]:
    """All messages of a profile's DBC files, in the order of its table in the codec.

    Parameters
    ----------
    directory : of the files.
    profile : one of `dbc.buses.PROFILES`.

    Raises
    ------
    ConfigurationError
        Names the file, the message and what the codec does not support.
    """
    facts = []
    for stem, bus in PROFILES[profile].items():
        path = directory / f"{stem}.dbc"
        database = load_database(path)
        bit_rate(path, database)  # attributes stand last: a file that was cut off lacks it
        facts += [_message_facts(path, stem, bus, message) for message in database.messages]
    return sorted(facts, key=lambda row: row.key)


@cache
def own_network(profile: str = DEFAULT_PROFILE) -> tuple[MessageFacts, ...]:
    """The messages of the files that come with raceloop, read once; see `load_network`."""
    return tuple(load_network(profile=profile))


def bit_rate(path: Path, database: Database) -> int:
    """Bit rate of the bus in bit/s, from the attribute Baudrate.

    Raises
    ------
    ConfigurationError
        When the attribute is missing or not positive.
    """
    attributes: Mapping[str, Any] = database.dbc.attributes if database.dbc is not None else {}
    rate: int = _attribute(attributes, "Baudrate", 0)
    if rate <= 0:
        raise ConfigurationError(path, "Baudrate", "is missing; allowed is a positive number of bit/s")
    return rate


def _message_facts(path: Path, stem: str, bus: Bus, message: Message) -> MessageFacts:
    if message.length > _DATA_MAX:
        raise ConfigurationError(path, message.name, f"{message.length} bytes; classic CAN carries at most {_DATA_MAX}")
    if message.is_multiplexed():
        raise ConfigurationError(path, message.name, "multiplexed; only plain messages are supported")
    for signal in message.signals:
        if signal.is_float or signal.length > _SIGNAL_BITS_MAX:
            raise ConfigurationError(
                path, f"{message.name}.{signal.name}", f"only integers of at most {_SIGNAL_BITS_MAX} bits are supported"
            )
    senders = [name for name in message.senders if name in STATIONS]
    if len(senders) != 1:
        raise ConfigurationError(path, message.name, f"needs exactly one sender out of {', '.join(sorted(STATIONS))}")
    receivers = {name for signal in message.signals for name in signal.receivers}
    if not receivers or not receivers <= STATIONS.keys():
        raise ConfigurationError(path, message.name, f"needs receivers, all out of {', '.join(sorted(STATIONS))}")
    attributes: Mapping[str, Any] = message.dbc.attributes if message.dbc is not None else {}
    return MessageFacts(
        database=stem,
        message=message,
        bus=bus,
        sender=STATIONS[senders[0]],
        receivers=frozenset(STATIONS[name] for name in receivers),
        cycle_ms=_attribute(attributes, "GenMsgCycleTime", 0),
        timeout_ms=_attribute(attributes, "GenMsgTimeout", 0),
        frames_per_cycle=_attribute(attributes, "FramesPerCycle", 1),
        counter=_check_signal(
            path, message, _attribute(attributes, "CounterSignal", ""), range(1, _COUNTER_BITS_MAX + 1)
        ),
        crc=_check_signal(path, message, _attribute(attributes, "CrcSignal", ""), range(_CRC_BITS, _CRC_BITS + 1)),
    )


def _attribute(attributes: Mapping[str, Any], name: str, default: Any) -> Any:
    return attributes[name].value if name in attributes else default


def _check_signal(path: Path, message: Message, name: str, lengths: range) -> Signal | None:
    """Signal that an attribute names, checked for what codec.c can read: little-endian, unsigned, width, unscaled."""
    if not name:
        return None
    for signal in message.signals:
        if signal.name == name:
            break
    else:
        raise ConfigurationError(path, message.name, f"attribute names the signal {name}, which does not exist")
    plain = signal.byte_order == "little_endian" and not signal.is_signed and (signal.scale, signal.offset) == (1, 0)
    aligned = lengths.start == 1 or signal.start % 8 == 0
    if not plain or not aligned or signal.length not in lengths:
        raise ConfigurationError(
            path,
            f"{message.name}.{name}",
            f"must be little-endian, unsigned, unscaled, {lengths.start} to {lengths.stop - 1} bits, a CRC at a byte",
        )
    return signal
