"""Geoid height above the ellipsoid, for clients that need heights above the sea.

    N(lat, lon) = bilinear in EGM96 at whole degrees,    H = h - N

N in metres above WGS 84, h the ellipsoid's height, H above mean sea level. The table is EGM96 of
NIMA and NASA (1996) to whole metres, rows from 90 to -90 deg, columns from 0 to 359 deg east. Its
error is 0.5 m in the middle of plains and seas, and up to 10 m along deep trenches and high ranges.
A configured value replaces the table.
"""

from __future__ import annotations

import zlib
from functools import cache
from math import floor
from pathlib import Path
from typing import NamedTuple

from fusiond.outputs.derived_figures import known, usable
from fusiond.outputs.messages.nav import NavMessage

_FILE = Path(__file__).with_name("egm96.bin")
_ROWS, _COLUMNS = 181, 360


@cache
def load() -> memoryview:
    """Table (181, 360) of signed bytes (m); read once."""
    return memoryview(zlib.decompress(_FILE.read_bytes())).cast("b")


class SeaHeight(NamedTuple):
    """Height above mean sea level, and geoid height N, both in m."""

    above_sea_m: float
    separation_m: float


def sea_height(nav: NavMessage, configured_m: float | None) -> SeaHeight | None:
    """Height of a solution above the sea, by the configured geoid height or else the table. None if
    position, height or the height's sigma is unknown."""
    lat, lon, height = known(nav.lat_deg), known(nav.lon_deg), known(nav.height_m)
    if not usable(nav) or lat is None or lon is None or height is None:
        return None
    if known(nav.sd_d_m) is None:
        return None
    separation_m = geoid_separation_m(lat, lon) if configured_m is None else configured_m
    return SeaHeight(height - separation_m, separation_m)


def geoid_separation_m(lat_deg: float, lon_deg: float) -> float:
    """Geoid height N (m) at a place."""
    table = load()
    south, east = min(max(90.0 - lat_deg, 0.0), 180.0), lon_deg % 360.0
    row, column = min(floor(south), _ROWS - 2), floor(east) % _COLUMNS
    down, along = south - row, east - floor(east)
    after = (column + 1) % _COLUMNS
    upper, lower = row * _COLUMNS, (row + 1) * _COLUMNS
    above = (1.0 - along) * table[upper + column] + along * table[upper + after]
    below = (1.0 - along) * table[lower + column] + along * table[lower + after]
    return (1.0 - down) * above + down * below
