"""Timeline measurements as packed rows, for batches of an estimator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.packed import BODY, HEADER, MEASURED, MOTION_ASKED, SIZE
from fusiond.estimators.base import THRESHOLDS, Estimator, Outcome
from fusiond.estimators.fault_bank_interface import Hypotheses
from fusiond.estimators.measurement_loop_kernel import (
    ENDS,
    INNOVATION,
    OF_STATE,
)
from fusiond.estimators.noise_scale import SIZE as NOISE_SIZE
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.integrity.series_states import Series
from fusiond.navigator.ungated_innovation import RawInnovation, of_rows

if TYPE_CHECKING:
    from fusiond.navigator.timeline import Entry

Array = NDArray[np.float64]

_PADDING = [bytes(max(0, 8 * (SIZE - BODY) - count)) for count in range(8 * (SIZE - BODY) + 1)]
"""Padding by length of a body."""


@dataclass(slots=True, eq=False)
class Span:
    """Constants of a series for a batch: its number, and the bank's codes of its rows, its device
    and its measurement; of the present batch the instant and value of the last measurement, and the
    number in motion."""

    constants: tuple[int, int, int, int]
    batch: int = 0
    one: Series | None = None
    t_ns: int = 0
    value: object = None
    moved: int = 0


class MeasurementRows:
    """Rows for one estimator; none for an estimator without batches."""

    def __init__(self, estimator: Estimator) -> None:
        self._bank = estimator.hypotheses if estimator.runs else None
        self._model = estimator.model
        self._noise = np.zeros((0, NOISE_SIZE))
        self._known: dict[str, Span] = {}
        """Known spans by source."""
        self._batch = 0
        self._spans: list[Span] = []
        """Spans of a batch."""

    def packed(self, measurement: AidingMeasurement) -> tuple[bytes, object, Span | None]:
        """Row of a measurement, the value that a frozen sensor would repeat, and the span of its
        source; empty without a row."""
        bank = None if measurement.robust else self._bank
        packed = None if bank is None else measurement.packed(self._model)
        if bank is None or packed is None:
            return b"", None, None
        span = self._known.get(measurement.source) or self._new(measurement, bank)
        (kind, rows, body), of = packed, span.constants
        row = HEADER.pack(kind, measurement.t_ns, rows, THRESHOLDS[measurement.gate, rows], *of)
        shown = None if measurement.constraint else type(measurement).shown
        value = None if shown is None else shown(measurement)
        return row + body + _PADDING[len(body)], value, span

    def _new(self, measurement: AidingMeasurement, bank: Hypotheses) -> Span:
        """Span of a new source."""
        number, asked = len(self._known), 0
        self._noise = np.zeros((number + 1, NOISE_SIZE))
        if not measurement.constraint:
            asked = MEASURED if measurement.locates else MEASURED | MOTION_ASKED
        span = self._known[measurement.source] = Span((number, *bank.of(measurement), asked))
        return span

    def batch(
        self, entries: Sequence[Entry], which: range, diagnosis: Diagnosis, until_ns: int
    ) -> tuple[Array, Array] | None:
        """First of `which` entries that can run as one batch: before `until_ns`, with rows, nominal
        series and no repeated values. Rows (k, SIZE), and the noise scales of all series (s, .);
        None for an empty batch."""
        rows, spans = [], self._spans
        spans.clear()
        self._batch = number = self._batch + 1
        for k in which:
            entry = entries[k]
            span, value = entry.span, entry.value
            if span is None:
                break
            if span.batch != number:
                one = diagnosis.plain(entry.measurement)
                if one is None:
                    break
                span.batch, span.one, span.value = number, one, one.value
                span.t_ns = span.moved = 0
                self._noise[span.constants[0]] = one.noise
                spans.append(span)
            if value is not None:
                if value == span.value:
                    break
                span.value = value
            rows.append(entry.row)
            if entry.key[0] >= until_ns:
                break
        if not rows:
            return None
        return np.frombuffer(bytearray().join(rows)).reshape(-1, SIZE), self._noise

    def went_on(self, entries: Sequence[Entry], results: Array) -> list[Outcome]:
        """Update the series of a batch with its results; the outcomes."""
        outcomes = []
        for entry, result in zip(entries, results[:, : INNOVATION + 1].tolist(), strict=True):
            became, nis, moves, count, *whitened, first = result
            if (span := entry.span) is not None:
                span.t_ns, span.value = entry.key[0], entry.value
                if moves:
                    span.moved += 1
            name, degrees = ENDS[int(became)], int(count)
            fused = name == "fused"
            shown = tuple(whitened[:degrees]) if fused else ()
            of_first = first if fused else math.nan
            outcomes.append(Outcome(name, nis, degrees, shown, first=of_first))
        for span in self._spans:
            if (one := span.one) is not None and span.t_ns:
                one.went_on(span.t_ns, span.value, span.moved)
                one.noise[:] = self._noise[span.constants[0]]
        return outcomes


def raw_of(result: Sequence[float], degrees: int) -> RawInnovation | None:
    """Raw innovation of a result of a batch; None if not applied."""
    if degrees == 0:
        return None
    columns = [list(result[at : at + 6]) for at in range(OF_STATE, OF_STATE + 6 * degrees, 6)]
    return of_rows(list(result[INNOVATION : INNOVATION + degrees]), columns)
