"""A call in a thread that nobody waits for: its outcome, and what comes too late."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading

import pytest

from drivers.detached_call import aside
from tests.patience import PATIENCE_S, until


async def test_what_it_returns_and_what_it_raises() -> None:
    discarded: list[int] = []
    assert await aside(lambda: 7, discarded.append) == 7
    with pytest.raises(ZeroDivisionError):
        await aside(lambda: 1 // 0, discarded.append)
    assert discarded == []


async def test_what_comes_after_a_cancel_is_given_back() -> None:
    may_end, discarded = threading.Event(), list[str]()

    def slow() -> str:
        may_end.wait(PATIENCE_S)
        return "port"

    task = asyncio.create_task(aside(slow, discarded.append))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    may_end.set()
    await until(lambda: discarded == ["port"])


async def test_a_cancel_in_the_turn_in_which_it_comes() -> None:
    discarded: list[str] = []
    began, may_end = threading.Event(), threading.Event()

    def slow() -> str:
        began.set()
        may_end.wait(PATIENCE_S)
        return "port"

    task = asyncio.create_task(aside(slow, discarded.append))
    await until(began.is_set)
    may_end.set()
    for thread in threading.enumerate():
        if thread.name == "aside":
            thread.join()  # its outcome is in the loop's queue, and nobody has seen it
    asyncio.get_running_loop().call_soon(task.cancel)
    with pytest.raises(asyncio.CancelledError):
        await task
    assert discarded == ["port"]


def test_a_process_ends_while_a_call_hangs() -> None:
    program = """
import asyncio, threading
from drivers.detached_call import aside
async def main():
    asyncio.create_task(aside(threading.Event().wait, print))
    await asyncio.sleep(0)
asyncio.run(main())
"""
    subprocess.run([sys.executable, "-c", program], timeout=PATIENCE_S, check=True)
