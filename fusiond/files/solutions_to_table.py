"""Conversion of a navigator's solutions to the table of a solution file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from fusiond.files.csv_tables import Floats
from fusiond.files.measurement_csv import TrajectoryTable
from fusiond.navigation.solution import Solution


def trajectory_of(solutions: Iterable[Solution]) -> TrajectoryTable:
    """Table of solutions with `t_s` = `t_ns` in seconds, NaN for unknown values."""
    rows = list(solutions)
    return TrajectoryTable(
        t_s=np.array([s.t_ns * 1e-9 for s in rows], dtype=np.float64),
        lat_rad=np.array([s.lat_rad for s in rows], dtype=np.float64),
        lon_rad=np.array([s.lon_rad for s in rows], dtype=np.float64),
        height_m=np.array([s.height_m for s in rows], dtype=np.float64),
        v=_columns([s.v_ned_m_s for s in rows]),
        rpy=_columns([s.rpy_rad for s in rows]),
        sd_position=_columns([s.sd_ned_m for s in rows]),
        sd_v=_columns([s.sd_v_ned_m_s for s in rows]),
        sd_rpy=_columns([s.sd_rpy_rad for s in rows]),
        status=[str(s.mode) for s in rows],
        rejected=[],
    )


def _columns(vectors: Sequence[tuple[float, float, float]]) -> Floats:
    """Array (n, 3) of vectors, also for n = 0."""
    return np.array(vectors, dtype=np.float64).reshape(-1, 3)
