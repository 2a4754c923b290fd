"""A part that falls is restarted, told, and ended only by cancellation."""

from __future__ import annotations

import asyncio

import pytest

from fusiond.live.supervision import supervise


async def test_a_part_that_raises_or_ends_is_restarted(caplog: pytest.LogCaptureFixture) -> None:
    falls: list[str] = []
    serving = asyncio.Event()
    calls = 0

    async def serve() -> None:
        nonlocal calls
        calls += 1
        if calls == 1:
            raise RuntimeError("a defect")
        if calls == 3:
            serving.set()
            await asyncio.Event().wait()

    task = asyncio.create_task(supervise("the part", serve, falls.append))
    await asyncio.wait_for(serving.wait(), 60.0)
    assert falls == ["RuntimeError('a defect'): restarting it", "it ended by itself: restarting it"]
    assert [r.getMessage() for r in caplog.records if r.exc_info] == ["the part failed"]
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert len(falls) == 2
