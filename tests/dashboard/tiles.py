"""A map in one file for tests: PMTiles 3 with one tile at each zoom, as its specification says.

Written without the dashboard's reader, from github.com/protomaps/PMTiles (spec/v3/spec.md) and the
Mapbox Vector Tile specification 2.1.
"""

from __future__ import annotations

import gzip
import json
import math
import struct
import zlib
from collections.abc import Iterable
from pathlib import Path

MVT, PNG = 1, 2


def tile_of(lat_deg: float, lon_deg: float, zoom: int) -> tuple[int, int]:
    """Column and row of the Web Mercator's tile there."""
    n = 2**zoom
    north = math.asinh(math.tan(math.radians(lat_deg)))
    return int((lon_deg + 180.0) / 360.0 * n), int((1.0 - north / math.pi) / 2.0 * n)


def tile_id(zoom: int, x: int, y: int) -> int:
    """Number of a tile along the Hilbert curves."""
    found = (4**zoom - 1) // 3
    s = 2**zoom // 2
    while s:
        right, below = int(x & s > 0), int(y & s > 0)
        found += s * s * ((3 * right) ^ below)
        if not below:
            if right:
                x, y = s - 1 - x, s - 1 - y
            x, y = y, x
        s //= 2
    return found


def varint(value: int) -> bytes:
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])


def png(red: int, green: int, blue: int, size: int = 256) -> bytes:
    """An image of one colour."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    row = b"\0" + bytes([red, green, blue]) * size
    head = struct.pack(">2I5B", size, size, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(row * size)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def all_water() -> bytes:
    """A vector tile whose layer `water` is one polygon over all of it, packed."""

    def field(number: int, data: bytes) -> bytes:
        return varint(number << 3 | 2) + varint(len(data)) + data

    def zigzag(value: int) -> int:
        return value << 1 if value >= 0 else (-value << 1) - 1

    move, line, close = 1 | 1 << 3, 2 | 3 << 3, 7 | 1 << 3
    corners = (move, 0, 0, line, 4096, 0, 0, 4096, -4096, 0, close)
    commands = {0, 3, 10}
    numbers = (n if k in commands else zigzag(n) for k, n in enumerate(corners))
    geometry = b"".join(map(varint, numbers))
    feature = varint(3 << 3) + varint(3) + field(4, geometry)
    layer = field(1, b"water") + field(2, feature) + varint(5 << 3) + varint(4096)
    return gzip.compress(field(3, varint(15 << 3) + varint(2) + layer))


def write_map(
    path: Path,
    tile: bytes,
    kind: int,
    places: Iterable[tuple[int, int, int]],
    attribution: str = "a test's map",
) -> None:
    """`tile` at each of `places` (zoom, x, y), in directories of two levels."""
    ids = sorted(tile_id(*place) for place in places)
    zooms = [zoom for zoom, _, _ in places]

    def directory(entries: list[tuple[int, int, int, int]]) -> bytes:
        """Of (id, run, length, offset)."""
        before = [0, *(entry[0] for entry in entries)]
        numbers = [len(entries), *(e[0] - b for e, b in zip(entries, before, strict=False))]
        for k in (1, 2):
            numbers += [entry[k] for entry in entries]
        numbers += [entry[3] + 1 for entry in entries]
        return gzip.compress(b"".join(map(varint, numbers)))

    leaf = directory([(found, 1, len(tile), 0) for found in ids])
    root = directory([(ids[0], 0, len(leaf), 0)])
    about = gzip.compress(json.dumps({"attribution": f"<b>{attribution}</b>"}).encode())
    at, parts = 127, []
    for part in (root, about, leaf, tile):
        parts += [at, len(part)]
        at += len(part)
    head = struct.pack(
        "<7sB8Q3Q6B4iB2i",
        *(b"PMTiles", 3, *parts, len(ids), len(ids), 1),
        *(1, 2, 2 if kind == MVT else 1, kind, min(zooms), max(zooms)),
        *(-1800000000, -850000000, 1800000000, 850000000, min(zooms), 0, 0),
    )
    assert len(head) == 127
    path.write_bytes(head + root + about + leaf + tile)
