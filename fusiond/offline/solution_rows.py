"""Buffer of solution rows from the navigator to a file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.files.solution_csv import SolutionWriter
from fusiond.navigation.solution import HEIGHT_KNOWN_SD_M, HELD_UNKNOWN_M
from fusiond.navigation.strapdown import HEIGHT

Array = NDArray[np.float64]


class Rows(NamedTuple):
    """Solutions of successive samples: `times` (m,) ns, `nav` (m, 10), `sigmas` (m, 9) in the
    file's order, `status` (m,) indices into `fusiond.files.solution_csv.STATUS`."""

    times: NDArray[np.int64]
    nav: Array
    sigmas: Array
    status: NDArray[np.int64]

    def part(self, begin: int, end: int) -> Rows:
        """Rows `begin` ... `end` - 1, as views."""
        part = slice(begin, end)
        return Rows(self.times[part], self.nav[part], self.sigmas[part], self.status[part])


class RowsWriter:
    """Writer of rows to a file. A value that the model holds (not `stated`, (9,)) has no sigma; an
    unknown height has an empty cell."""

    def __init__(self, out: Path, stated: NDArray[np.bool_]) -> None:
        self._writer = SolutionWriter(out)
        self._stated = stated

    def write(self, rows: Rows) -> None:
        """Append rows."""
        nav, sigmas = rows.nav, rows.sigmas
        held = np.abs(nav[:, HEIGHT]) < HELD_UNKNOWN_M
        unknown = sigmas[:, 2] > HEIGHT_KNOWN_SD_M if self._stated[2] else held
        if unknown.any():
            nav, sigmas = nav.copy(), sigmas.copy()
            nav[unknown, HEIGHT] = sigmas[unknown, 2] = np.nan
        self._writer.states(rows.times, nav, sigmas, self._stated, rows.status)

    def close(self) -> None:
        """Write the remaining rows."""
        self._writer.close()
