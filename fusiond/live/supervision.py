"""Supervision of tasks: a failed one is restarted after a delay while the daemon continues."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from drivers.base import Backoff

log = logging.getLogger("fusiond")


async def supervise(
    name: str, serve: Callable[[], Awaitable[None]], on_fault: Callable[[str], None]
) -> None:
    """Run `serve` until cancelled, and restart it whenever it ends; `on_fault(text)` receives the
    reason."""
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
