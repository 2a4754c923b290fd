"""Place for one value, in which a new value replaces an unread one."""

from __future__ import annotations

import asyncio
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """Latest value: `put` never waits, `next` waits for a new one. `replaced` counts values that
    were replaced unread; `last` is the newest, read or not."""

    def __init__(self) -> None:
        self.last: T | None = None
        self.replaced = 0
        self._new = asyncio.Event()

    def put(self, value: T) -> None:
        self.replaced += self._new.is_set()
        self.last = value
        self._new.set()

    async def next(self) -> T:
        await self._new.wait()
        self._new.clear()
        assert self.last is not None, "set together with the event"
        return self.last
