"""Aids of a timeline as rows of numbers, for runs of an estimator over many of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid
from fusiond.aiding.packed import BODY, HEADER, MEASURED, MOTION_ASKED, NAMES, SIZE
from fusiond.estimators.aid_run import (
    BECAME,
    FUSED,
    GATED,
    INNOVATION,
    NIS,
    NOT_FINITE,
    OF_STATE,
    WHITENED,
)
from fusiond.estimators.base import THRESHOLDS, Estimator, Outcome
from fusiond.estimators.noise_scale import SIZE as NOISE_SIZE
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.integrity.service import Series
from fusiond.navigator.raw_innovation import RawInnovation, of_rows

if TYPE_CHECKING:
    from fusiond.navigator.timeline import Entry

Array = NDArray[np.float64]

_BODY_BYTES = 8 * (SIZE - BODY)


class Batch(NamedTuple):
    """Rows of aids in order, the series of each, and the noise scales of all series (s, .) with the
    numbers of those that are of it."""

    rows: list[bytes]
    series: list[Series]
    noise: Array
    of: dict[int, Series]

    def arrays(self) -> tuple[Array, Array]:
        """Aids (k, SIZE) and noise scales as kernels take them."""
        for number, one in self.of.items():
            self.noise[number] = one.noise
        return np.frombuffer(bytearray().join(self.rows)).reshape(-1, SIZE), self.noise

    def learned(self) -> None:
        """Hand the noise scales back to their series."""
        for number, one in self.of.items():
            one.noise[:] = self.noise[number]


class AidRows:
    """Rows for one estimator; none for one that takes aids one by one."""

    def __init__(self, estimator: Estimator) -> None:
        runs = estimator.runs
        self._bank = None if runs is None else runs.bank
        self._model = estimator.model
        self._numbers: dict[str, int] = {}
        """Of each source."""
        self._noise = np.zeros((0, NOISE_SIZE))

    def packed(self, aid: Aid) -> tuple[bytes, object]:
        """An aid's row, empty where it has none, and what a frozen sensor would repeat of it."""
        packed = None if self._bank is None or aid.robust else aid.packed(self._model)
        if packed is None or self._bank is None:
            return b"", None
        source, shown, asked = aid.source, type(aid).shown, 0
        number = self._numbers.get(source)
        if number is None:
            number = self._numbers[source] = len(self._numbers)
            self._noise = np.zeros((number + 1, NOISE_SIZE))
        if not aid.constraint:
            asked = MEASURED if aid.locates else MEASURED | MOTION_ASKED
        kind, rows, body = packed
        head = kind, aid.t_ns, rows, THRESHOLDS[aid.gate, rows], number
        of = self._bank.of_source.get(source) or self._bank.of(aid)
        row = HEADER.pack(*head, *of, asked) + body.ljust(_BODY_BYTES, b"\0")
        return row, None if shown is None or aid.constraint else shown(aid)

    def batch(
        self, entries: Sequence[Entry], which: range, diagnosis: Diagnosis, until_ns: int
    ) -> Batch:
        """The first `which` of entries up to one that has no row, or of which more is to be judged:
        a series that is out, a value that repeats itself; or that is not before `until_ns`."""
        rows: list[bytes] = []
        series: list[Series] = []
        of: dict[int, Series] = {}
        values: dict[str, object] = {}
        for number in which:
            entry = entries[number]
            aid, value = entry.aid, entry.value
            one = diagnosis.plain(aid) if entry.row else None
            if one is None or (value is not None and value == values.get(aid.source, one.value)):
                break
            values[aid.source] = value
            of[self._numbers[aid.source]] = one
            rows.append(entry.row)
            series.append(one)
            if aid.t_ns >= until_ns:
                break
        return Batch(rows, series, self._noise, of)


def outcome_of(row: bytes, result: Sequence[float]) -> Outcome:
    """Outcome of an aid with a row, by what a run has made of it."""
    became, degrees = int(result[BECAME]), HEADER.unpack_from(row)[2]
    if became == FUSED:
        whitened = tuple(result[WHITENED : WHITENED + degrees])
        return Outcome("fused", result[NIS], degrees, whitened)
    if became == GATED:
        return Outcome("gated", result[NIS], degrees)
    if became == NOT_FINITE:
        return Outcome("not_finite", result[NIS], degrees)
    return Outcome(NAMES[became])


def raw_of(result: Sequence[float], degrees: int) -> RawInnovation | None:
    """Raw innovation of an aid, by what a run has made of it; None where it did not apply."""
    if degrees == 0:
        return None
    columns = [list(result[at : at + 6]) for at in range(OF_STATE, OF_STATE + 6 * degrees, 6)]
    return of_rows(list(result[INNOVATION : INNOVATION + degrees]), columns)
