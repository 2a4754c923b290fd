"""Short messages on disk, so that waiting and unreported ones survive a restart.

A thread writes the file atomically after each change; changes during a write follow in the next. A
command to send a message is answered once the message is on disk.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.live.rdss_messaging import Messaging
from fusiond.live.state_keeper import state_file
from fusiond.navigator.state_file import (
    MOST_BYTES,
    DamagedStateError,
    read_state,
    set_aside,
    write_state,
)

if TYPE_CHECKING:  # a vehicle without a terminal never loads them
    from fusiond.live.stored_messages import KeptBox, KeptMessages

log = logging.getLogger("fusiond")


class MessageKeeper:
    """Store of one vehicle's messages, beside its saved state; unused without a configured state
    file.

    `on_event(code, text)` receives `messages_damaged`, and `messages_not_kept` once a row of
    failures."""

    def __init__(
        self,
        config: Config,
        clock: Clock,
        on_event: Callable[[str, str], None],
        environ: Mapping[str, str] = os.environ,
    ) -> None:
        beside = state_file(config, environ)
        self._path = None if beside is None else beside.with_suffix(".messages.json")
        self._clock = clock
        self._event = on_event
        self.written = 0
        """Revision of the messages that is stored."""
        self._error = ""
        self._working: asyncio.Task[None] | None = None

    def load(self, messaging: Messaging) -> str | None:
        """Restore the last run's messages, aged by the time since then. Returns the stored JSON, or
        None."""
        if self._path is None or not os.path.lexists(self._path):
            return None
        from fusiond.live.stored_messages import KEPT_MESSAGES  # noqa: PLC0415

        try:
            kept = read_state(self._path, KEPT_MESSAGES)
        except DamagedStateError as error:
            self._event("messages_damaged", f"{self._path}: {error}; {set_aside(self._path)}")
            return None
        if kept is None:
            return None
        t_ns = self._clock.now_ns()
        utc_ns = self._clock.utc_ns(t_ns)
        passed_s = 0.0
        if utc_ns is not None and kept.utc_s is not None:
            passed_s = max(0.0, utc_ns * 1e-9 - kept.utc_s)
        boxes = {name: _aged(box, passed_s) for name, box in kept.boxes.items()}
        kept = replace(kept, boxes=boxes, taken_up_ns=t_ns)
        messaging.resume(kept)
        return KEPT_MESSAGES.dump_json(kept).decode()

    def keep(self, t_ns: int, messaging: Messaging) -> None:
        """Write changes, unless a write is pending; once the revision is another."""
        busy = self._working is not None and not self._working.done()
        if self._path is None or busy or messaging.revision == self.written:
            return
        revision, text = messaging.revision, _text(messaging.state(t_ns))
        self._working = asyncio.create_task(self._write(self._path, revision, text))

    async def kept(self, revision: int, messaging: Messaging) -> str:
        """Wait until this revision is on disk. Returns "", or why it could not be written."""
        if self._path is None:
            return "not kept over a restart: no state_file"
        while self.written < revision and not self._error:
            self.keep(self._clock.now_ns(), messaging)
            if self._working is not None:
                await asyncio.wait([self._working])
        return self._error and f"not kept on disk: {self._error}"

    async def close(self, t_ns: int, messaging: Messaging) -> None:
        """Write the last state, after a pending write has ended."""
        if self._working is not None:
            await asyncio.wait([self._working])
        if self._path is not None and messaging.revision != self.written:
            await self._write(self._path, messaging.revision, _text(messaging.state(t_ns)))

    async def _write(self, path: Path, revision: int, text: bytes) -> None:
        try:
            await asyncio.to_thread(write_state, path, text, True)
        except OSError as error:
            if not self._error:
                self._event("messages_not_kept", f"{path}: {error}")
            self._error = error.strerror or str(error)
        else:
            self._error = ""
        self.written = revision


def _aged(box: KeptBox, passed_s: float) -> KeptBox:
    return replace(box, waiting=tuple(replace(m, age_s=m.age_s + passed_s) for m in box.waiting))


def _text(kept: KeptMessages) -> bytes:
    """Encode as JSON, with as many unreported messages as the state file has room for."""
    from fusiond.live.stored_messages import KEPT_MESSAGES  # noqa: PLC0415

    text = KEPT_MESSAGES.dump_json(kept)
    while len(text) > MOST_BYTES - 100 and kept.untold:
        kept = replace(kept, untold=kept.untold[1:])
        text = KEPT_MESSAGES.dump_json(kept)
    return text
