"""Aids of a timeline as rows of numbers, for runs of an estimator over many of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid
from fusiond.aiding.packed import BODY, HEADER, MEASURED, MOTION_ASKED, SIZE
from fusiond.estimators.base import THRESHOLDS, Estimator, Outcome
from fusiond.estimators.fault_bank import NOTHING
from fusiond.estimators.noise_scale import SIZE as NOISE_SIZE
from fusiond.estimators.row_kernels import (
    BECAME,
    DEGREES,
    ENDS,
    INNOVATION,
    MOVES,
    NIS,
    OF_STATE,
    WHITENED,
)
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.integrity.service import Series
from fusiond.navigator.raw_innovation import RawInnovation, of_rows

if TYPE_CHECKING:
    from fusiond.navigator.timeline import Entry

Array = NDArray[np.float64]

_PADDING = [bytes(max(0, 8 * (SIZE - BODY) - count)) for count in range(8 * (SIZE - BODY) + 1)]
"""By the length of a body: what makes a row of it."""


@dataclass(slots=True)
class Span:
    """A series' part of a batch: its number, instant and value of the last, and at how many the
    vehicle moved."""

    one: Series
    number: int
    t_ns: int = 0
    value: object = None
    moved: int = 0


class MeasurementRows:
    """Rows for one estimator; none for one that takes aids one by one."""

    def __init__(self, estimator: Estimator) -> None:
        self._runs = estimator.runs is not None
        self._bank = estimator.hypotheses
        self._model = estimator.model
        self._known: dict[str, tuple[int, int, int, int]] = {}
        """By source: number of its series, what its rows are and its device, what is asked."""
        self._noise = np.zeros((0, NOISE_SIZE))
        self._spans: dict[str, Span] = {}

    def packed(self, measurement: Aid) -> tuple[bytes, object]:
        """An aid's row, empty where it has none, and what a frozen sensor would repeat of it."""
        alike = self._runs and not measurement.robust
        packed = measurement.packed(self._model) if alike else None
        if packed is None:
            return b"", None
        known = self._known.get(measurement.source) or self._new(measurement)
        kind, rows, body = packed
        row = HEADER.pack(kind, measurement.t_ns, rows, THRESHOLDS[measurement.gate, rows], *known)
        shown = None if measurement.constraint else type(measurement).shown
        return row + body + _PADDING[len(body)], None if shown is None else shown(measurement)

    def _new(self, measurement: Aid) -> tuple[int, int, int, int]:
        """Constants of an aid's source."""
        number, asked, bank = len(self._known), 0, self._bank
        of = (NOTHING, -1) if bank is None else bank.of(measurement)
        self._noise = np.zeros((number + 1, NOISE_SIZE))
        if not measurement.constraint:
            asked = MEASURED if measurement.locates else MEASURED | MOTION_ASKED
        known = self._known[measurement.source] = number, *of, asked
        return known

    def batch(
        self, entries: Sequence[Entry], which: range, diagnosis: Diagnosis, until_ns: int
    ) -> tuple[Array, Array] | None:
        """The first `which` of entries up to one that has no row, or of which more is to be judged:
        a series that is not nominal, a value that repeats itself; or that is not before `until_ns`.
        Rows (k, SIZE), and the noise scales of all series (s, .); None of none."""
        rows, values, spans = [], {}, self._spans
        spans.clear()
        for k in which:
            entry = entries[k]
            if not entry.row:
                break
            measurement, value = entry.aid, entry.value
            source = measurement.source
            if source not in spans:
                one = diagnosis.plain(measurement)
                if one is None:
                    break
                number = self._known[source][0]
                spans[source], values[source] = Span(one, number), one.value
                self._noise[number] = one.noise
            if value is not None:
                if value == values[source]:
                    break
                values[source] = value
            rows.append(entry.row)
            if entry.key[0] >= until_ns:
                break
        if not rows:
            return None
        return np.frombuffer(bytearray().join(rows)).reshape(-1, SIZE), self._noise

    def went_on(self, entries: Sequence[Entry], results: Sequence[Sequence[float]]) -> None:
        """Tell the series of a batch that so many of its aids have come, with these results."""
        spans = self._spans
        for entry, result in zip(entries, results, strict=True):
            span = spans[entry.aid.source]
            span.t_ns, span.value = entry.key[0], entry.value
            span.moved += result[MOVES] > 0.0
        for span in spans.values():
            if span.t_ns:
                span.one.went_on(span.t_ns, span.value, span.moved)
                span.one.noise[:] = self._noise[span.number]


def outcome_of(result: Sequence[float]) -> Outcome:
    """Outcome of a measurement with a row, by what a run has made of it."""
    name, degrees = ENDS[int(result[BECAME])], int(result[DEGREES])
    whitened = tuple(result[WHITENED : WHITENED + degrees]) if name == "fused" else ()
    return Outcome(name, result[NIS], degrees, whitened)


def raw_of(result: Sequence[float], degrees: int) -> RawInnovation | None:
    """Raw innovation of one, by what a run has made of it; None where it did not apply."""
    if degrees == 0:
        return None
    columns = [list(result[at : at + 6]) for at in range(OF_STATE, OF_STATE + 6 * degrees, 6)]
    return of_rows(list(result[INNOVATION : INNOVATION + degrees]), columns)
