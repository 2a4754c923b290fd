"""Rows of a solution on their way from the navigator to a file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.files.solution_csv import SolutionWriter
from fusiond.navigation.rotation import rpy_from_quaternions
from fusiond.navigation.strapdown import Q0

Array = NDArray[np.float64]


class Rows(NamedTuple):
    """Solutions of successive samples: `times` (m,) ns, `nav` (m, 10), `sigmas` (m, 9) in the order
    of the file, `status` (m,) indices into `fusiond.files.solution_csv.STATUS`."""

    times: NDArray[np.int64]
    nav: Array
    sigmas: Array
    status: NDArray[np.int64]

    def part(self, begin: int, end: int) -> Rows:
        """Rows `begin` ... `end` - 1, as views."""
        part = slice(begin, end)
        return Rows(self.times[part], self.nav[part], self.sigmas[part], self.status[part])


class RowsWriter:
    """Writes rows to a file; a figure that the model holds (not `stated`, (9,)) has no sigma."""

    def __init__(self, out: Path, stated: NDArray[np.bool_]) -> None:
        self._writer = SolutionWriter(out)
        self._stated = stated

    def write(self, rows: Rows) -> None:
        """Append rows."""
        nav = rows.nav
        rpy = np.empty((len(nav), 3))
        rpy_from_quaternions(nav[:, Q0:], rpy)
        self._writer.rows(
            np.asarray(rows.times * 1e-9, dtype=np.float64),
            nav[:, 0],
            (nav[:, 1] + np.pi) % (2.0 * np.pi) - np.pi,
            nav[:, 2],
            nav[:, 3:6],
            rpy,
            np.where(self._stated, rows.sigmas, np.nan),
            rows.status,
        )

    def close(self) -> None:
        """Write out what is left."""
        self._writer.close()
