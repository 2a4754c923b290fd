"""Servers that tests of guests connect to, and how many descriptors that takes."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fusiond.configuration.outputs import Foxglove, Gpsd
from fusiond.outputs.foxglove.server import FoxgloveServer
from fusiond.outputs.gpsd.server import GpsdServer
from tests.broker import free_port
from tests.outputs.serving import Around, at_work


@asynccontextmanager
async def gpsd(around: Around | None = None) -> AsyncIterator[GpsdServer]:
    server = GpsdServer(Gpsd(port=free_port()), (around or Around()).surroundings)
    async with at_work(server):
        yield server


@asynccontextmanager
async def foxglove(around: Around | None = None, **options: Any) -> AsyncIterator[FoxgloveServer]:
    server = FoxgloveServer(
        Foxglove(port=free_port(), **options), (around or Around()).surroundings
    )
    async with at_work(server):
        yield server


def url(server: FoxgloveServer) -> str:
    return f"ws://127.0.0.1:{server.port.address[1]}"


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))
