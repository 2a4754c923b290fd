"""Reader of logs: whole, truncated or damaged ones, and the parts of a recording as one log.

A file is read from its beginning and needs no index: after a power cut it is readable up to its
last whole chunk. Damaged chunks are skipped, and so are chunks that would decompress to more than
the recorder's can (57 kB of such a file became 3.3 GB). `problems` lists the defects.
"""

from __future__ import annotations

import importlib
import json
import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, BinaryIO, NamedTuple, cast

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader

from fusiond.recording.channels import INPUT
from fusiond.recording.mcap_writer import FORMAT, METADATA
from fusiond.recording.records import DamagedRecordError, Record, check, unpack

RECORD_LIMIT = 1 << 26
"""A damaged length must not ask for all the memory: a chunk has 128 KiB, an attachment a few MB."""
CHUNK_LIMIT = 1 << 24
"""Bytes of a chunk, decompressed: ours have 128 KiB and a message more; other writers, by whom logs
were merged, make 4 MiB (the tool `mcap`)."""
RATIO_LIMIT, RATIO_FREE = 100, 1 << 18
"""Limits of a chunk's decompressed size: ratio, and bytes that are always allowed. Chunks of drives
have a ratio of 4 to 5; repeated bytes 0xD3 from a line have 188. The free bytes are two of our
chunks."""
WINDOW_LIMIT = 1 << 23
"""Largest window of a zstd decompressor (RFC 8878, section 3.1.1.1.2)."""
LATEST_NS = 253_402_300_800 * 1_000_000_000
"""POSIX time (ns) of the end of 9999: reports on a log have four digits for a year."""
MOST_PROBLEMS = 100
"""Most problems listed for a log; a damaged log can have one for each byte."""
_DAMAGED = (EOFError, struct.error, McapError, ValueError, zstandard.ZstdError, RuntimeError)


_RECORD = struct.Struct("<BQ")
"""Opcode and length of an MCAP record."""
_MESSAGE = struct.Struct("<HIQ8x")
"""MCAP message header: channel, sequence and log time."""
_CHANNEL = struct.Struct("<HHI")
"""MCAP channel header: channel, schema and length of the topic."""


class LogError(Exception):
    """Error: a file that is not a log of fusiond, or has a later format; the text names the
    reason."""


class LogMessage(NamedTuple):
    """Message of a log. `t_log_ns` is the daemon's clock plus the log's `epoch_ns`."""

    topic: str
    t_log_ns: int
    data: bytes
    sequence: int

    def json(self) -> Any:
        """Decoded message of a channel other than the input. Raises ValueError."""
        try:
            return json.loads(self.data)
        except RecursionError:
            raise ValueError("JSON that is nested too deep") from None


@dataclass
class About:
    """Metadata of a log."""

    metadata: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)

    @property
    def epoch_ns(self) -> int:
        """Lead of the log's times over CLOCK_MONOTONIC."""
        return int(self.metadata["epoch_ns"])

    @property
    def sources(self) -> list[str]:
        """Names of the drivers, in the order in which records number them."""
        named: list[str] = json.loads(self.metadata["sources"])
        return named


class Log:
    """Recording in one or several files, in order. Raises `LogError`, and OSError for an unreadable
    file.

    `problems` fills while messages are read: the defects of the files, each sentence once.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        if not paths:
            raise LogError("no log given")
        described = [(path, described_by(path)) for path in paths]
        described.sort(key=lambda d: (d[1].metadata["run"], int(d[1].metadata["part"])))
        runs = {about.metadata["run"] for _, about in described}
        if len(runs) > 1:
            raise LogError(f"these are parts of {len(runs)} recordings: give those of one")
        self.paths = [path for path, _ in described]
        self.about = described[0][1]
        self.problems: list[str] = []
        first = int(self.about.metadata["part"])
        for place, (path, about) in enumerate(described):
            if int(about.metadata["part"]) != first + place:
                self._problem(f"{path.name}: a part before it is missing")

    def messages(self, *topics: str) -> Iterator[LogMessage]:
        """Messages of these channels, by default of all, in recorded order."""
        wanted = frozenset(topics)
        for path in self.paths:
            yield from _messages(path, wanted, self._problem)

    def records(self) -> Iterator[Record]:
        """Records of the input. A gap is listed in `problems`, and so is a record that cannot
        belong to this log, which is left out."""
        last, sources = 0, len(self.about.sources)
        first_ns, end_ns = -self.about.epoch_ns, LATEST_NS - self.about.epoch_ns
        for message in self.messages(INPUT):
            if last and message.sequence != last + 1:
                lost = message.sequence - last - 1
                self._problem(f"{lost} messages of input are missing after message {last}")
            last = message.sequence
            found = unpack(message.data)
            while True:
                try:
                    record = next(found)
                    check(record, sources)
                    if not first_ns <= record.t_ns < end_ns or not all(
                        first_ns <= t_ns < end_ns for _, t_ns, _ in record.readings
                    ):
                        raise DamagedRecordError("a time that cannot be")
                except StopIteration:
                    break
                except DamagedRecordError as error:
                    self._problem(f"message {message.sequence} of input: {error}")
                    continue
                yield record

    def _problem(self, text: str) -> None:
        if text not in self.problems and len(self.problems) < MOST_PROBLEMS:
            self.problems.append(text)

    @property
    def first_part(self) -> bool:
        """True if the recording's first part is present."""
        return self.about.metadata["part"] == "0"


def described_by(path: Path) -> About:
    """Metadata of the log at `path`. Raises `LogError`."""
    about = About()
    for record in _records(path, lambda text: None):
        if isinstance(record, Metadata) and record.name == METADATA:
            about.metadata = dict(record.metadata)
        elif isinstance(record, Attachment):
            about.attachments[record.name] = record.data
        elif isinstance(record, Chunk):
            break
    if not about.metadata:
        raise LogError(f"{path}: no log of fusiond: it has no metadata {METADATA!r}")
    if about.metadata.get("format") != FORMAT:
        found = about.metadata.get("format")
        raise LogError(f"{path}: format {found}; this version reads {FORMAT}")
    try:
        _ = about.metadata["run"], about.metadata["vehicle"], int(about.metadata["part"])
        _ = about.epoch_ns, [name.encode() for name in about.sources]
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise LogError(f"{path}: its metadata {METADATA!r} are damaged: {error!r}") from None
    return about


def _messages(
    path: Path, wanted: Collection[str], problem: Callable[[str], None]
) -> Iterator[LogMessage]:
    """Messages of the channels `wanted`, of all if it is empty."""
    topics: dict[int, str | None] = {}

    def name(channel: int, topic: str) -> None:
        topics[channel] = topic if not wanted or topic in wanted else None

    for record in _records(path, problem):
        if isinstance(record, Chunk):
            try:
                yield from _opened(_decompressed(record), topics, name)
            except _DAMAGED as error:
                problem(f"{path.name}: a damaged chunk is left out: {error}")
        elif isinstance(record, Channel):
            name(record.id, record.topic)
        elif isinstance(record, Message) and (topic := topics.get(record.channel_id)) is not None:
            yield LogMessage(topic, record.log_time, record.data, record.sequence)


def _opened(
    data: bytes, topics: Mapping[int, str | None], name: Callable[[int, str], None]
) -> Iterator[LogMessage]:
    """Messages of a decompressed chunk whose channel has a topic; `name` receives its channels.

    The bytes of a chunk are read directly: an object for each message, most of them unwanted, would
    cost more than the rest of reading a log. Raises one of `_DAMAGED`.
    """
    length = len(data)
    at = 0
    while at < length:
        opcode, size = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        end = at + size
        if end > length:
            raise EndOfFile
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time = _MESSAGE.unpack_from(data, at)
            topic = topics.get(channel)
            if topic is not None:
                yield LogMessage(topic, log_time, data[at + _MESSAGE.size : end], sequence)
        elif opcode == Opcode.CHANNEL:
            channel, _, count = _CHANNEL.unpack_from(data, at)
            name(channel, data[at + _CHANNEL.size : at + _CHANNEL.size + count].decode())
        at = end


def _decompressed(chunk: Chunk) -> bytes:
    """Decompressed bytes of a chunk, checked against the stated length. Raises one of `_DAMAGED`.

    Decompression stops at the limit of a chunk, whatever length the record and the frame state.
    """
    said = chunk.uncompressed_size
    most = min(CHUNK_LIMIT, RATIO_FREE + RATIO_LIMIT * len(chunk.data))
    if said > most:
        raise ValueError(f"{said} bytes when decompressed, at most {most} are read")
    match chunk.compression:
        case "":
            data = chunk.data
        case "zstd":
            unzipping = zstandard.ZstdDecompressor(max_window_size=WINDOW_LIMIT)
            with unzipping.stream_reader(chunk.data) as stream:
                data = stream.read(said + 1)
        case "lz4":
            lz4 = importlib.import_module("lz4.frame")
            data = lz4.LZ4FrameDecompressor().decompress(chunk.data, max_length=said + 1)
        case other:
            raise ValueError(f"compressed by {other!r}, which is not read")
    if len(data) != said:
        raise ValueError(f"{len(data)} bytes when decompressed, not {said}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("its checksum is wrong")
    return data


class _Bounded:
    """File whose reads are limited to a record's size: the package mcap trusts lengths inside a
    record."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def read(self, count: int) -> bytes:
        if count > RECORD_LIMIT:
            raise EndOfFile
        return self._file.read(count)


class _Unindexed(StreamReader):
    """File without the indices behind chunks, which a sequential reader skips."""

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        return None if opcode == Opcode.MESSAGE_INDEX else super()._read_record(opcode, length)


def _records(path: Path, problem: Callable[[str], None]) -> Iterator[McapRecord]:
    """Records up to the summary, with unopened chunks; `problem` receives a truncation."""
    with path.open("rb") as file:
        bounded = cast(IO[bytes], _Bounded(file))
        records = _Unindexed(bounded, emit_chunks=True, record_size_limit=RECORD_LIMIT).records
        try:
            first = next(records, None)
        except _DAMAGED as error:
            raise LogError(f"{path}: no MCAP file: {error or 'empty'}") from error
        if first is None:
            raise LogError(f"{path}: no MCAP file")
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except _DAMAGED as error:
                problem(f"{path.name}: cut off: {type(error).__name__}; `fusiond log recover`")
                return
            if isinstance(record, Footer):
                return
            yield record
