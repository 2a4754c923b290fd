"""Encoding of input records, the contents of the channel `/fusiond/input`.

    record  = kind u8 | source u8 | readings u16 | length u32 | t_ns i64 | payload | reading ...
    reading = clock u8 | t_ns i64 | ahead_ns i64

Little-endian; `t_ns` is CLOCK_MONOTONIC_RAW of the recording host. `source` is the place of the
driver's name in `sources` of the metadata, 255 for none. `length` is that of the payload. The
readings are those that the daemon made of the host's clocks (0 realtime, 1 boottime, 2
CLOCK_MONOTONIC: how far that is ahead of `t_ns`) from this record on until the next, in order.

Records stand in the order in which the daemon handled them: a log is played by handling them again.

    kind        payload
    start       JSON: what the daemon had loaded when the recording began
    tick        inputs u64, overruns u64, latency_ns i64, digest 8 bytes; t_ns is the tick's
    deadline read        bytes of one read
    frame       CAN id u32, flags u8 (1 extended, 2 remote, 4 error, 8 stamped), realtime_ns i64,
                data
    open        nothing
    close       why, UTF-8
    controller  its state
    timer       its name
    sent        bytes that the driver gave to its device: an output, which replay compares
    command     JSON: an operator's command, with its name
    correction  bytes of a caster's frame that the driver used itself
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple

from drivers.can.bus import CanFrame
from fusiond.clock.host import ReadClock

NO_SOURCE = 255
_HEAD = struct.Struct("<BBHIq")
_READING = struct.Struct("<Bqq")
_FRAME = struct.Struct("<IBq")
_TICK = struct.Struct("<QQq8s")
_EXTENDED, _REMOTE, _ERROR, _STAMPED = 1, 2, 4, 8
_MOST_READINGS = 0xFFFF
REALTIME, BOOTTIME, SLEWED = range(3)
_CLOCKS: tuple[ReadClock, ...] = ("realtime", "boottime", "slewed")

Reading = tuple[int, int, int]
"""Index of the clock in `realtime, boottime, slewed`; monotonic ns; how far it is ahead, ns."""


class Kind(IntEnum):
    """Kind of a record."""

    START = 0
    TICK = 1
    READ = 2
    FRAME = 3
    OPEN = 4
    CLOSE = 5
    CONTROLLER = 6
    TIMER = 7
    SENT = 8
    COMMAND = 9
    CORRECTION = 10


_KINDS = {int(kind): kind for kind in Kind}
_OF_DAEMON = frozenset({Kind.START, Kind.TICK, Kind.COMMAND})
_OF_JSON = frozenset({Kind.START, Kind.COMMAND})
_OF_TEXT = frozenset({Kind.CLOSE, Kind.CONTROLLER, Kind.TIMER})


class Record(NamedTuple):
    """One record; `payload` follows the table above."""

    kind: Kind
    source: int
    t_ns: int
    payload: bytes
    readings: Sequence[Reading] = ()


class Tick(NamedTuple):
    """The payload of a tick: inputs handled since the recording began, ticks skipped since the
    daemon began, how late it was (ns), and the digest of the solution and the filter after it."""

    inputs: int
    overruns: int
    latency_ns: int
    digest: bytes


class DamagedRecordError(ValueError):
    """Error: bytes that are not records."""


def reading(clock: ReadClock, t_ns: int, ahead_ns: int) -> Reading:
    return _CLOCKS.index(clock), t_ns, ahead_ns


def pack(record: Record) -> bytes:
    """Encode a record."""
    readings = record.readings[:_MOST_READINGS]
    head = _HEAD.pack(record.kind, record.source, len(readings), len(record.payload), record.t_ns)
    if not readings:
        return head + record.payload
    return b"".join((head, record.payload, *(_READING.pack(*r) for r in readings)))


def unpack(data: bytes) -> Iterator[Record]:
    """Decode the records of a message. Raises `DamagedRecordError`."""
    at, end = 0, len(data)
    try:
        while at < end:
            kind, source, count, length, t_ns = _HEAD.unpack_from(data, at)
            at += _HEAD.size
            payload = data[at : at + length]
            if len(payload) < length:
                raise DamagedRecordError("a record goes beyond its message")
            at += length
            readings: list[Reading] = []
            if count:  # one record in ten has any
                rows = range(at, at + count * _READING.size, _READING.size)
                readings = [_READING.unpack_from(data, row) for row in rows]
                at += count * _READING.size
            yield Record(_KINDS[kind], source, t_ns, payload, readings)
    except (struct.error, KeyError) as error:
        raise DamagedRecordError(str(error)) from error


def check(record: Record, sources: int) -> None:
    """Check a record of a log with `sources`. Raises `DamagedRecordError`."""
    kind, source, _, payload, _ = record
    if kind in _OF_DAEMON:
        if source != NO_SOURCE:
            raise DamagedRecordError(f"a {kind.name.lower()} of source {source}")
    elif source >= sources:
        raise DamagedRecordError(f"source {source} of {sources}")
    if kind is Kind.READ:  # most of all
        return
    if kind is Kind.FRAME:
        if len(payload) < _FRAME.size:
            raise DamagedRecordError("a frame that is cut")
    elif kind is Kind.TICK:
        if len(payload) != _TICK.size:
            raise DamagedRecordError("a tick of another length")
    elif kind in _OF_JSON:
        _object(payload)
    elif kind in _OF_TEXT:
        try:
            payload.decode()
        except UnicodeDecodeError as error:
            raise DamagedRecordError(str(error)) from None


def _object(payload: bytes) -> None:
    try:
        said = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise DamagedRecordError(f"no JSON: {error}") from None
    if not isinstance(said, dict):
        raise DamagedRecordError("no JSON object")


def frame_payload(frame: CanFrame) -> bytes:
    flags = (
        _EXTENDED * frame.extended
        | _REMOTE * frame.remote
        | _ERROR * frame.error
        | _STAMPED * (frame.realtime_ns is not None)
    )
    return _FRAME.pack(frame.can_id, flags, frame.realtime_ns or 0) + frame.data


def frame_of(record: Record) -> CanFrame:
    """The frame of a record of kind FRAME. Raises `DamagedRecordError`."""
    try:
        can_id, flags, realtime_ns = _FRAME.unpack_from(record.payload)
    except struct.error as error:
        raise DamagedRecordError(str(error)) from error
    return CanFrame(
        can_id,
        flags & _EXTENDED != 0,
        record.payload[_FRAME.size :],
        record.t_ns,
        realtime_ns if flags & _STAMPED else None,
        flags & _REMOTE != 0,
        flags & _ERROR != 0,
    )


def tick_payload(tick: Tick) -> bytes:
    return _TICK.pack(*tick)


def tick_of(record: Record) -> Tick:
    """The payload of a record of kind TICK. Raises `DamagedRecordError`."""
    try:
        return Tick._make(_TICK.unpack(record.payload))
    except struct.error as error:
        raise DamagedRecordError(str(error)) from error


KINDS_BY_INPUT = {
    "read": Kind.READ,
    "frame": Kind.FRAME,
    "open": Kind.OPEN,
    "close": Kind.CLOSE,
    "controller": Kind.CONTROLLER,
    "sent": Kind.SENT,
    "correction": Kind.CORRECTION,
}
"""Record kinds by kind of `drivers.external_inputs`; any other kind is a timer of the driver."""


def input_record(
    source: int, kind: str, t_ns: int, payload: bytes | str | CanFrame | None
) -> Record:
    """The record of a driver's input."""
    found = KINDS_BY_INPUT.get(kind, Kind.TIMER)
    if isinstance(payload, CanFrame):
        data = frame_payload(payload)
    elif isinstance(payload, str):
        data = payload.encode()
    elif found is Kind.TIMER:
        data = kind.encode()
    else:
        data = payload or b""
    return Record(found, source, t_ns, data)


def input_of(record: Record) -> tuple[str, bytes | str | CanFrame | None]:
    """Input of a driver: kind and payload for `Inputs.take`."""
    kind = record.kind
    if kind is Kind.FRAME:
        return "frame", frame_of(record)
    match kind:
        case Kind.READ | Kind.SENT | Kind.CORRECTION:
            return kind.name.lower(), record.payload
        case Kind.TIMER:
            return record.payload.decode(), None
        case Kind.OPEN:
            return "open", None
        case Kind.CLOSE | Kind.CONTROLLER:
            return kind.name.lower(), record.payload.decode()
        case _:
            raise DamagedRecordError(f"{kind.name.lower()} is no input of a driver")
