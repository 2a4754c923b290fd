"""Projection of latitude and longitude to metres on a plane, for plots."""

from __future__ import annotations

import numpy as np

from fusiond.files.csv_tables import Floats
from fusiond.files.measurement_csv import TrajectoryTable
from fusiond.navigation.earth import meridian_radius, transverse_radius

Origin = tuple[float, float, float]
"""Latitude, longitude (rad), height (m)."""


def origin_of(table: TrajectoryTable) -> Origin | None:
    """The first position of a track; None where it has none."""
    known = np.flatnonzero(np.isfinite(table.lat_rad) & np.isfinite(table.lon_rad))
    if not len(known):
        return None
    k = known[0]
    height = float(table.height_m[k])
    return float(table.lat_rad[k]), float(table.lon_rad[k]), height if np.isfinite(height) else 0.0


def metres_from(origin: Origin, table: TrajectoryTable) -> Floats:
    """North, east along the parallel of each point, and up (n, 3), in m. For maps of tens of
    kilometres: at 100 km the surface lies 800 m below the plane, and distances along it stay
    right."""
    lat, lon, height = origin
    turn = (table.lon_rad - lon + np.pi) % (2.0 * np.pi) - np.pi
    north = (table.lat_rad - lat) * (meridian_radius(lat) + height)
    east = turn * (transverse_radius(lat) + height) * np.cos(table.lat_rad)
    return np.stack([north, east, table.height_m - height], axis=1)
