"""Call that may block for seconds, in a detached thread.

The process waits at exit for threads of the loop's pool: a name server that does not reply would
delay the daemon's end by more than its service manager allows. It does not wait for a detached
thread.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


async def aside(call: Callable[[], T], discard: Callable[[T], None]) -> T:
    """Result of `call`. If the wait is cancelled, `discard` gets the result when it comes."""
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
        except RuntimeError:  # the loop is closed: nobody waits any more
            for orphan in found:
                discard(orphan)

    threading.Thread(target=work, name="aside", daemon=True).start()
    try:
        return await outcome
    except asyncio.CancelledError:
        if outcome.done() and not outcome.cancelled() and outcome.exception() is None:
            discard(outcome.result())
        raise
