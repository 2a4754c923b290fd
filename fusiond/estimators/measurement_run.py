"""Run of packed measurements through one filter, in one kernel call."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import LENT_ROWS
from fusiond.estimators.fault_bank_interface import Hypotheses
from fusiond.estimators.propagation import RECORD
from fusiond.estimators.row_kernels import AT_H, RESULT, TURNED, Axes, run_for
from fusiond.estimators.state_array import Memory
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer

Array = NDArray[np.float64]


class Ran(NamedTuple):
    """Result of a run: number of finished measurements, `DONE` or the reason of its end, results
    (k, RESULT)."""

    done: int
    how: int
    results: Array


class Filter(Protocol):
    """Part of a filter that a run changes beside its memory."""

    t_ns: int
    sample: int
    passing: bool
    turned: float
    kernel_options: int


class MeasurementRun:
    """`run_rows` of one filter: its memory, bank and axes, with what it `knows` (KNOWS,)."""

    def __init__(
        self,
        filter_: Filter,
        memory: Memory,
        model: Model,
        bank: Hypotheses,
        axes: Axes,
        knows: Array,
    ) -> None:
        work = np.zeros(AT_H + LENT_ROWS * (model.size + model.width))
        self._filter, self._memory, self._kernel = filter_, memory.array, run_for(model.width)
        self._given = (
            *(*bank.table[:3], model.column_of, model.initial, *axes),
            *(bank.mounting, work, bank.rows, bank.work, knows, bank.found),
        )
        self._hold_height, self._knows = model.hold_height, knows

    def __call__(
        self, imu: ImuBuffer, rows: Array, series: Array, record: bool, kept: tuple[int, int]
    ) -> Ran:
        """Apply measurements `rows` (k, SIZE), each at its instant, with the noise of their
        `series` (s, .); `kept`: instant (ns) of the last checkpoint, and the interval to the next.
        """
        f, results = self._filter, np.empty((len(rows), RESULT))
        options = f.kernel_options | (RECORD if record else 0)
        f.sample, f.t_ns, done, how = self._kernel(
            *(self._memory, imu.packed, rows, results, series, *self._given),
            *(f.sample, f.t_ns, options, self._hold_height, f.passing, *kept),
        )
        f.passing, f.turned = False, self._knows.item(TURNED)
        return Ran(done, how, results)
