"""Writer of one MCAP file: first the description of the log, then messages in chunks.

Every file carries configuration, DBC files, version and host, so that it can be read alone. Synced
data survive a power cut, which loses an open chunk alone.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from mcap.writer import CompressionType, Writer

from fusiond.recording.channels import Channel

CHUNK_BYTES = 128 * 1024
"""Lost at most when a chunk is cut off; compressed at once in 15 ms, where 1 MiB takes 70."""
METADATA = "fusiond"
FORMAT = "1"
"""Version of the format of records and metadata; a reader refuses a higher one."""
SUFFIX = ".mcap"


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file that belongs to the log: the configuration, a DBC."""

    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True, slots=True)
class About:
    """Description of a log; docs/recording.md lists `metadata`."""

    metadata: Mapping[str, str]
    attachments: tuple[Attachment, ...] = ()

    def part(self, number: int) -> About:
        return About({**self.metadata, "part": str(number)}, self.attachments)


class LogFile:
    """MCAP file while it is written. OSError passes, from every method."""

    def __init__(self, path: Path, about: About, t_log_ns: int) -> None:
        self.path = path
        self._file = path.open("xb", buffering=1 << 20)
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=f"fusiond {version('fusiond')}")
        self._writer.add_metadata(METADATA, dict(about.metadata))
        for each in about.attachments:
            self._writer.add_attachment(t_log_ns, t_log_ns, each.name, each.media_type, each.data)
        self._channels: dict[str, int] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._synced = self._file.tell()
        self._unflushed = 0
        self.messages = 0

    @property
    def size(self) -> int:
        """Bytes written; those since the last sync count before compression."""
        return self._synced + self._unflushed

    def write(self, channel: Channel, t_log_ns: int, data: bytes, sequence: int = 0) -> None:
        """Append a message."""
        number = self._channels.get(channel.topic)
        if number is None:
            number = self._register(channel)
        self._writer.add_message(number, t_log_ns, data, t_log_ns, sequence)
        self._unflushed += len(data)
        self.messages += 1

    def _register(self, channel: Channel) -> int:
        content = channel.schema()
        key = channel.schema_name, content
        schema = self._schemas.get(key)
        if schema is None:
            schema = self._writer.register_schema(
                channel.schema_name, channel.schema_encoding, content
            )
            self._schemas[key] = schema
        number = self._writer.register_channel(channel.topic, channel.encoding, schema)
        self._channels[channel.topic] = number
        return number

    def sync(self) -> None:
        """Write everything to disk before returning."""
        self._writer.flush()
        self._synced, self._unflushed = self._file.tell(), 0
        os.fsync(self._file.fileno())

    def finish(self) -> None:
        """Write the index and close."""
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def abandon(self) -> None:
        """Close a file that can no longer be written; it is readable up to its last whole chunk."""
        try:
            self._file.close()
        except OSError:  # the buffer could not be written; raw closes all the same
            raw = getattr(self._file, "raw")  # noqa: B009 (BinaryIO does not say so)
            raw.close()
