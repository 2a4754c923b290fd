"""The map's file over HTTP: in ranges, to our own page alone. `make dashboard-check` draws it."""

from __future__ import annotations

import asyncio
from http.client import HTTPConnection
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.dashboard.vehicles import Hub
from tests.dashboard.serving import at_work
from tests.dashboard.tiles import PNG, png, tile_id, tile_of, write_map
from tests.patience import PATIENCE_S


async def _get(address: str, **headers: str) -> tuple[int, bytes, str | None]:
    def get() -> tuple[int, bytes, str | None]:
        connection = HTTPConnection(*address.split(":"), timeout=PATIENCE_S)
        connection.request("GET", "/map.pmtiles", headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read(), answer.getheader("content-range")

    return await asyncio.to_thread(get)


def _hub() -> Hub:
    return Hub(lambda: 0.0, "test")


async def test_a_map_is_served_in_ranges(tmp_path: Path) -> None:
    path = tmp_path / "town.pmtiles"
    write_map(path, png(1, 2, 3), PNG, [(z, *tile_of(30.5, 114.3, z)) for z in (10, 11)])
    size = path.stat().st_size
    async with at_work(_hub(), base_map=path) as address:
        status, body, told = await _get(address, Range="bytes=0-126")
        assert (status, told) == (206, f"bytes 0-126/{size}")
        assert body == path.read_bytes()[:127]
        assert (await _get(address, Range=f"bytes={size}-{size + 9}"))[0] == 416
        assert (await _get(address, Host="evil.example"))[0] == 421


async def test_without_a_map_the_page_is_told_so_and_not_that_something_is_wrong() -> None:
    async with at_work(_hub()) as address:
        assert await _get(address, Range="bytes=0-126") == (204, b"", None)


@pytest.mark.parametrize("content", [None, b"", b"PMTiles\x02", b"SQLite format 3\0"])
def test_an_invalid_map_is_refused_at_start(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "x.pmtiles"
    if content is not None:
        path.write_bytes(content)
    done = CliRunner().invoke(app, ["dashboard", "--port", "0", "--map", str(path)])
    assert done.exit_code == 69
    assert str(path) in done.output


def test_tile_numbers_of_the_specification() -> None:
    places = [(0, 0, 0), (1, 0, 0), (1, 0, 1), (1, 1, 1), (1, 1, 0), (2, 0, 0), (12, 3423, 1763)]
    assert [tile_id(*place) for place in places] == [0, 1, 2, 3, 4, 5, 19078479]
