"""Call that may block for seconds, in a detached thread.

A thread of the loop's own pool is joined before the process may end: a name server that does not
answer would hold up the end of the daemon by more than its service manager allows.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


async def aside(call: Callable[[], T], discard: Callable[[T], None]) -> T:
    """Result of `call`. `discard` gets what comes after this was cancelled."""
    loop = asyncio.get_running_loop()
    outcome: asyncio.Future[T] = loop.create_future()

    def settle(found: list[T], error: Exception | None) -> None:
        if not outcome.cancelled():
            if error is not None:
                outcome.set_exception(error)
            else:
                outcome.set_result(found[0])
        elif found:
            discard(found[0])

    def work() -> None:
        found: list[T] = []
        failed: Exception | None = None
        try:
            found.append(call())
        except Exception as error:
            failed = error
        try:
            loop.call_soon_threadsafe(settle, found, failed)
        except RuntimeError:  # the loop is closed: this came too late for anybody
            for orphan in found:
                discard(orphan)

    threading.Thread(target=work, name="aside", daemon=True).start()
    try:
        return await outcome
    except asyncio.CancelledError:
        if outcome.done() and not outcome.cancelled() and outcome.exception() is None:
            discard(outcome.result())
        raise
