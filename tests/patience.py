"""How tests wait: for a condition, never for a time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

PATIENCE_S = 120.0
"""Only bounds a run that hangs; nothing passes or fails by its length, on a busy host either."""


async def until(condition: Callable[[], bool]) -> None:
    """Wait for what happens in another process or thread, or at the far end of a line."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110 - nothing announces it
            await asyncio.sleep(0.002)
