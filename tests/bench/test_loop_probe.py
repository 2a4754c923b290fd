"""The probe of the attack bench tells what held the event loop up, and what it did meanwhile."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

from tests.places import REPOSITORY

HELD_UP = """
import asyncio, gc, sys, threading, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from benchmarks.loop_probe import Probe

def computes():
    end = time.thread_time() + 0.1
    while time.thread_time() < end:
        pass

def sleeps():
    time.sleep(0.1)

def imports():
    import colorsys
    time.sleep(0.05)

def collects():
    gc.collect()
    time.sleep(0.05)

Probe(Path(sys.argv[1])).install()

async def main():
    loop = asyncio.get_running_loop()
    for call in (computes, sleeps, imports, collects):
        loop.call_soon(call)
        await asyncio.sleep(0.05)

asyncio.run(main())
"""


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Lines by the longest callback of their turn; that of the end."""
    out = tmp_path_factory.mktemp("probe") / "loop.jsonl"
    subprocess.run([sys.executable, "-c", HELD_UP, out, REPOSITORY], check=True)
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    turns = [line for line in lines if line["what"] == "callbacks"]
    return {turn["callbacks"][0][0]: turn for turn in turns} | {"ended": lines[-1]}


def test_a_callback_that_computes_is_told_from_one_that_waits(
    told: dict[str, dict[str, Any]],
) -> None:
    computes, sleeps = told["computes"], told["sleeps"]
    assert computes["cpu_ms"] >= 100.0
    assert sleeps["wall_ms"] >= 100.0
    assert sleeps["blocked_ms"] > 50.0 > sleeps["cpu_ms"]


def test_modules_and_collections_are_told(told: dict[str, dict[str, Any]]) -> None:
    assert "colorsys" in told["imports"]["imported"]
    assert told["collects"]["gc"] == {"2": 1}
    assert told["collects"]["gc_ms"] > 0.0


def test_the_end_has_the_processor_time_by_callback(told: dict[str, dict[str, Any]]) -> None:
    seconds, calls = told["ended"]["cpu_s"]["computes"]
    assert seconds >= 0.1
    assert calls == 1
