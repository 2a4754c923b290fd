"""Thread that writes logs, so that no tick waits for a disk.

Messages go into a bounded queue; when a slow disk fills it, messages are lost and counted, and
their sequence shows the gap. Twice a second the thread writes the queue, closes the chunk and
syncs: a power cut loses that and the disk's own delay.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pydantic import TypeAdapter

from fusiond.clock.host import SECOND_NS
from fusiond.configuration.recording import Recording
from fusiond.outputs.messages.base import Message
from fusiond.recording.channels import CHANNELS, OF_FOXGLOVE, InnovationMessage
from fusiond.recording.mcap_writer import SUFFIX, About, LogFile

log = logging.getLogger("fusiond")

WRITE_S = 0.5
"""Interval (s) of writes with sync: with the disk's delay still below the 2 s that may be lost."""
QUEUE = 20_000
"""Most waiting messages: over a minute at 200 a second, 15 MB; a longer stall of the disk loses
messages."""
KEEP_EVERY_NS = 10 * SECOND_NS
"""Interval of the check for surplus logs: at most 10 MB are written in it."""
MB = 1_000_000
_INNOVATION = TypeAdapter(InnovationMessage)


@dataclass(frozen=True, slots=True)
class Item:
    """Message for a channel, at `t_log_ns`. The thread encodes models as JSON."""

    topic: str
    t_log_ns: int
    payload: bytes | Message | InnovationMessage
    sequence: int = 0


class LogWriter:
    """Writer of one recording into files `STEM_0000.mcap`, ... of `folder`, until closed.

    `about()` describes it; it is called in the thread, since it reads files. The attributes may be
    read at any time: `path` of the current file, `synced` True after a first sync, `stopped` the
    reason of an end by itself, `dropped` messages, `free_mb` of the disk.
    """

    def __init__(
        self,
        folder: Path,
        stem: str,
        vehicle: str,
        about: Callable[[], About],
        options: Recording,
        t_log_ns: int,
    ) -> None:
        self._folder, self._stem, self._vehicle = folder, stem, vehicle
        self._describe = about
        self._options = options
        self._queue: deque[Item] = deque()
        self._closing = threading.Event()
        self._t_log_ns = t_log_ns
        self._looked_ns = 0
        self._file: LogFile | None = None
        self.parts = 0
        self.synced = False
        self.stopped: str | None = None
        self.dropped = 0
        self.free_mb: float | None = None
        self.path = self._part_path()
        self._thread = threading.Thread(target=self._run, name="log writer", daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Queue a message; beyond the limit of the queue it is counted as lost."""
        if len(self._queue) >= QUEUE:
            self.dropped += 1
            return
        self._queue.append(item)

    def close(self) -> None:
        """Write the queue and finish the file, in the writer's own thread."""
        self._closing.set()

    def wait(self) -> None:
        """Wait until the file is closed."""
        self._thread.join()

    @property
    def busy(self) -> bool:
        return self._thread.is_alive()

    # ------------------------------------------------------------------ the thread

    def _run(self) -> None:
        try:
            self._look_at_the_disk()
            self._about = self._describe()
            self._file = self._open(self._t_log_ns)
            self._keep_newest()
            while not self._closing.wait(WRITE_S):
                self._write_waiting()
                self._file.sync()
                self.synced = True
                self._look_at_the_disk()
                self._keep_newest()
            self._write_waiting()
            self._file.finish()
        except OSError as error:
            self._stop(error.strerror or str(error))
        except _DiskFullError as error:
            self._finish_full()
            self._stop(str(error))
        except Exception as error:
            log.exception("recording failed")
            self._stop(repr(error))

    def _finish_full(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.finish()

    def _write_waiting(self) -> None:
        file = self._file
        assert file is not None
        for _ in range(len(self._queue)):
            item = self._queue.popleft()
            if self._is_full(file.size, item.t_log_ns):
                file.finish()
                file = self._file = self._open(item.t_log_ns)
            for channel, data in _worded(item):
                file.write(CHANNELS[channel], item.t_log_ns, data, item.sequence)

    def _part_path(self) -> Path:
        return self._folder / f"{self._stem}_{self.parts:04d}{SUFFIX}"

    def _open(self, t_log_ns: int) -> LogFile:
        self._folder.mkdir(parents=True, exist_ok=True)
        self.path = self._part_path()
        made = LogFile(self.path, self._about.part(self.parts), t_log_ns)
        self._began_ns = t_log_ns
        self.parts += 1
        return made

    def _is_full(self, size: int, t_log_ns: int) -> bool:
        age_min = (t_log_ns - self._began_ns) / (60 * SECOND_NS)
        o = self._options
        return size > o.split_mb * MB or age_min > o.split_min

    def _look_at_the_disk(self) -> None:
        """Stop recording while the disk still has room for the index. Raises `_DiskFullError`."""
        free_mb, least_mb = _free_mb(self._folder), self._options.min_free_mb
        self.free_mb = free_mb
        if free_mb < least_mb:
            raise _DiskFullError(
                f"{free_mb:.0f} MB left on the disk, recording.min_free_mb is {least_mb:.0f}"
            )

    def _keep_newest(self) -> None:
        """Remove this vehicle's oldest logs beyond `keep_mb`, periodically."""
        now_ns = time.monotonic_ns()
        if now_ns - self._looked_ns < KEEP_EVERY_NS:
            return
        self._looked_ns = now_ns
        logs = sorted(logs_of(self._folder, self._vehicle), key=_age)
        sizes = [_size(path) for path in logs]
        excess = sum(sizes) - self._options.keep_mb * MB
        for path, size in zip(logs, sizes, strict=True):
            if excess <= 0 or path == self.path:
                break
            with contextlib.suppress(OSError):
                path.unlink()
            excess -= size

    def _stop(self, why: str) -> None:
        log.warning("recording stops: %s", why)
        if self._file is not None:
            self._file.abandon()
        self.stopped = why


class _DiskFullError(Exception):
    """Error: the disk is almost full."""


def _worded(item: Item) -> list[tuple[str, bytes]]:
    """Messages of an item as topic and bytes: its own, and one for other tools where there is
    one."""
    payload = item.payload
    match payload:
        case bytes():
            return [(item.topic, payload)]
        case InnovationMessage():
            return [(item.topic, _INNOVATION.dump_json(payload))]
    made = [(item.topic, payload.model_dump_json().encode())]
    for channel in OF_FOXGLOVE:
        beside = channel.payload(payload) if item.topic == f"/{channel.topic.name}" else None
        if beside is not None:
            made.append((channel.name, beside))
    return made


def log_stem(vehicle: str, utc_ns: int, run: str) -> str:
    """Name of a recording without part and suffix: vehicle, time of its begin, unique number."""
    return f"{vehicle}_{datetime.fromtimestamp(utc_ns / SECOND_NS, UTC):%Y%m%dT%H%M%SZ}_{run[:8]}"


def logs_of(folder: Path, vehicle: str) -> list[Path]:
    """Logs of one vehicle in a folder: only these are counted and removed. Links and folders of
    such a name are left out, since this program writes none."""
    named = re.compile(rf"{re.escape(vehicle)}_\d{{8}}T\d{{6}}Z_[0-9a-f]{{8}}_\d{{4}}{SUFFIX}")
    return [
        path
        for path in folder.iterdir()
        if named.fullmatch(path.name) and path.is_file() and not path.is_symlink()
    ]


def _age(path: Path) -> tuple[int, str]:
    try:
        return path.stat().st_mtime_ns, path.name
    except OSError:
        return 0, path.name


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _free_mb(folder: Path) -> float:
    """Free space (MB) of the folder's disk."""
    while not folder.exists():
        folder = folder.parent
    about = os.statvfs(folder)
    return about.f_bavail * about.f_frsize / MB
