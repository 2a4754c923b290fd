"""Reading logs: whole, cut off, damaged, and several parts of one recording as one.

A file is read from its beginning and needs no index: what a power cut has left of it is read up to
its last whole chunk. A chunk that is damaged is passed over. `problems` says what was wrong.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

from fusiond.recording.channels import INPUT
from fusiond.recording.log_file import FORMAT, METADATA
from fusiond.recording.records import DamagedRecordError, Record, unpack

RECORD_LIMIT = 1 << 30
"""A damaged length must not ask for all the memory: a chunk has 128 KiB, an attachment a few MB."""
_DAMAGED = (EOFError, struct.error, McapError, ValueError, zstandard.ZstdError, RuntimeError)


class LogError(Exception):
    """A file that is no log of fusiond, or one of a later format: the text says which and why."""


class LogMessage(NamedTuple):
    """A message of a log. `t_log_ns` is CLOCK_MONOTONIC plus the log's `epoch_ns`."""

    topic: str
    t_log_ns: int
    data: bytes
    sequence: int

    def json(self) -> Any:
        """What it says, of a channel other than the input."""
        return json.loads(self.data)


@dataclass
class About:
    """What a log says of itself."""

    metadata: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)

    @property
    def epoch_ns(self) -> int:
        """What the log's times are ahead of CLOCK_MONOTONIC."""
        return int(self.metadata["epoch_ns"])

    @property
    def sources(self) -> list[str]:
        """The drivers' names, in the order in which records number them."""
        named: list[str] = json.loads(self.metadata["sources"])
        return named


class Log:
    """A recording in one or several files, in order. Raises `LogError`, and OSError for what cannot
    be read.

    `problems` fills while messages are read: what is wrong with the files, each sentence once.
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
        """The messages of these channels, of all by default, as they were written."""
        wanted = frozenset(topics)
        for path in self.paths:
            for found in _messages(path, self._problem):
                if not wanted or found.topic in wanted:
                    yield found

    def records(self) -> Iterator[Record]:
        """The input, record by record; a gap in it ends up in `problems`."""
        last = 0
        for message in self.messages(INPUT):
            if last and message.sequence != last + 1:
                lost = message.sequence - last - 1
                self._problem(f"{lost} messages of input are missing after message {last}")
            last = message.sequence
            try:
                yield from unpack(message.data)
            except DamagedRecordError as error:
                self._problem(f"message {message.sequence} of input: {error}")

    def _problem(self, text: str) -> None:
        if text not in self.problems:
            self.problems.append(text)

    @property
    def first_part(self) -> bool:
        """Whether the recording's beginning is there."""
        return self.about.metadata["part"] == "0"


def described_by(path: Path) -> About:
    """What the log at `path` says of itself. Raises `LogError`."""
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
    return about


def _messages(path: Path, problem: Callable[[str], None]) -> Iterator[LogMessage]:
    topics: dict[int, str] = {}
    for record in _records(path, problem):
        for inner in _opened(record, path, problem):
            if isinstance(inner, Channel):
                topics[inner.id] = inner.topic
            elif isinstance(inner, Message) and inner.channel_id in topics:
                topic = topics[inner.channel_id]
                yield LogMessage(topic, inner.log_time, inner.data, inner.sequence)


def _opened(record: McapRecord, path: Path, problem: Callable[[str], None]) -> Iterable[McapRecord]:
    if not isinstance(record, Chunk):
        return (record,)
    try:
        return breakup_chunk(record, validate_crc=True)
    except _DAMAGED as error:
        problem(f"{path.name}: a damaged chunk is left out: {error}")
        return ()


def _records(path: Path, problem: Callable[[str], None]) -> Iterator[McapRecord]:
    """Records up to the summary, chunks unopened; what is cut off goes to `problem`."""
    with path.open("rb") as file:
        records = StreamReader(file, emit_chunks=True, record_size_limit=RECORD_LIMIT).records
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
