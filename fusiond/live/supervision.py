"""Supervision of parts: a failed part is restarted after a delay, the daemon continues."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from drivers.base import Backoff

log = logging.getLogger("fusiond")


async def supervise(
    name: str, serve: Callable[[], Awaitable[None]], on_fault: Callable[[str], None]
) -> None:
    """Call `serve` again and again until cancelled; `on_fault(text)` receives each end of it."""
    backoff = Backoff()
    while True:
        try:
            await serve()
            reason = "it ended by itself"
        except Exception as error:
            log.exception("%s failed", name)
            reason = repr(error)
        on_fault(f"{reason}: restarting it")
        await asyncio.sleep(backoff.next())
