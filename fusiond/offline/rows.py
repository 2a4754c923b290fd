"""Rows of a solution on their way from the navigator to a file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.files.solution_csv import SolutionWriter

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
        self._writer.states(rows.times, rows.nav, rows.sigmas, self._stated, rows.status)

    def close(self) -> None:
        """Write out what is left."""
        self._writer.close()
