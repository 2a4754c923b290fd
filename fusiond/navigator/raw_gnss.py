r"""Tight coupling: a receiver's raw epochs become measurements of corrected ranges and rates.

Broadcast data (ephemerides, ionosphere) are stored. Each epoch is corrected for the filter's
position at its instant (an error of 100 m changes a correction by 1 cm). Before the filter starts,
the solution of the epoch alone serves the alignment.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from drivers.raw.messages import Ephemeris, NavigationMessage, RawGnssEpoch
from fusiond.aiding.base import AidingMeasurement, Innovation, NotApplicable, State
from fusiond.aiding.heading_history import HeadingHistory
from fusiond.aiding.initialisation_candidates import Candidate, PositionCandidate, VelocityCandidate
from fusiond.aiding.pseudorange import RANGE_BIAS, PseudorangeMeasurement, nothing_left
from fusiond.configuration.aiding import RawAiding
from fusiond.estimators.update_with_exclusion import KEPT
from fusiond.gnss.best_four_satellites import best_four
from fusiond.gnss.ecef import ned_axes, to_ecef, to_geodetic
from fusiond.gnss.orbit import WEEK_S
from fusiond.gnss.range_bias_filter import RangeBiases, subtract_biases
from fusiond.gnss.range_error_displacement import Displacement, plausible
from fusiond.gnss.range_kernel import (
    CARRIER_VARIANCE,
    RANGE_VALUES,
    RATE_VARIANCE,
    VARIANCE,
)
from fusiond.gnss.ranges import (
    ChosenSignals,
    RangeModel,
    RangeOptions,
    Rows,
    TrackedSignals,
    initial_carriers,
)
from fusiond.gnss.single_point import SinglePoint, single_point
from fusiond.gnss.store import EphemerisStore
from fusiond.navigator.raw_sky import REASONS, Sky, sky_of

Array = NDArray[np.float64]

REMEMBERED_NS = 12_000_000_000
"""Age beyond which epochs are too old for the timeline, which rewinds by ten seconds."""
NOTHING = np.zeros((3, 3))
NOWHERE = Displacement(
    *(0.0, (), np.zeros((3, 2)), np.zeros(0), NOTHING, NOTHING, NOTHING),
    *(np.zeros((3, 2)), np.zeros(0), {}, ()),
)
"""Rows of an epoch without satellites."""


class _Corrected(NamedTuple):
    """Corrected epoch for a vehicle near `guess` (ECEF, m), computed from `place` (rad, rad, m)."""

    place: tuple[float, float, float]
    followed: TrackedSignals
    guess: Array
    rows: Rows
    measurement: PseudorangeMeasurement


@dataclass(slots=True)
class _Memory:
    """Cached results of an epoch. `left` is the output of the filter's last run for the next epoch.
    `followed` is the epoch after the one whose `kept` is `after`, and `kept` its carriers' state;
    `displacement` and `levels` belong to its sky, once corrected."""

    corrected: _Corrected | None = None
    counted: bool = False
    left: Array = field(default_factory=nothing_left)
    before: Array = field(default_factory=nothing_left)
    followed: TrackedSignals | None = None
    after: Array | None = None
    kept: Array = field(default_factory=initial_carriers)
    displacement: Displacement | None = None
    levels: RangeBiases | None = None

    def is_after(self, before: _Memory) -> bool:
        """True if the carriers were tracked from that epoch to this one."""
        return self.followed is not None and self.after is before.kept


@immutable(eq=False)
class RawEpochMeasurement(AidingMeasurement):
    """Epoch with chosen signals, corrected for the filter's position at its instant.

    The result depends on the state at the epoch's own instant, not on the filter's progress at
    arrival, so the order of arrival does not matter.
    """

    screened: ClassVar[bool] = True
    locates: ClassVar[bool] = True
    placed: ClassVar[bool] = True

    receiver: RawGnss
    epoch: RawGnssEpoch
    picked: ChosenSignals
    memory: _Memory = field(default_factory=_Memory)

    @property
    def shares(self) -> tuple[str, ...]:
        return RANGE_BIAS

    def at(self, nav: Array) -> PseudorangeMeasurement:
        """Ranges of the epoch for a vehicle at `nav`; possibly without satellites."""
        lat, lon, height = nav[:3].tolist()
        followed = self.receiver.followed(self)
        found, key = self.memory.corrected, (lat, lon, height)
        if found is None or found.place != key or found.followed is not followed:
            guess = np.array(to_ecef(lat, lon, height))
            found = _Corrected(key, followed, guess, *self.receiver.correct(self, followed, guess))
            self.memory.corrected = found
        return found.measurement

    def without_attitude(self, way: HeadingHistory) -> LevelEpoch:
        return LevelEpoch(self.source, self.t_ns, self.gate, self, way, robust=self.robust)

    def innovation(self, state: State) -> Innovation | NotApplicable:
        return self.at(state.nav).innovation(state)

    def candidates(self) -> Sequence[Candidate]:
        """Position and velocity of the epoch alone; none without a solution."""
        return self.receiver.alone(self)

    def series(self, whitened: Sequence[float], codes: Sequence[int]) -> Mapping[str, Array]:
        found = self.memory.corrected
        return {} if found is None else found.measurement.series(whitened, codes)

    def judged(self, codes: Sequence[int], whitened: Sequence[float]) -> None:
        if self.memory.corrected is not None:
            self.receiver.judged(self, self.memory.corrected, codes, whitened)


@immutable(eq=False)
class LevelEpoch(AidingMeasurement):
    """Epoch for a vehicle of unknown attitude (`AidingMeasurement.without_attitude`)."""

    screened: ClassVar[bool] = True
    locates: ClassVar[bool] = True
    placed: ClassVar[bool] = True

    epoch: RawEpochMeasurement
    way: HeadingHistory

    @property
    def shares(self) -> tuple[str, ...]:
        return RANGE_BIAS

    def at(self, nav: Array) -> PseudorangeMeasurement:
        """Ranges of the epoch for a vehicle at `nav`."""
        return self.epoch.at(nav).without_attitude(self.way)

    def innovation(self, state: State) -> Innovation | NotApplicable:
        return self.at(state.nav).innovation(state)

    def judged(self, codes: Sequence[int], whitened: Sequence[float]) -> None:
        found = self.epoch.memory.corrected
        if found is not None:
            level = found._replace(measurement=found.measurement.without_attitude(self.way))
            self.epoch.receiver.judged(self.epoch, level, codes, whitened)


class RawGnss:
    """Raw data of one receiver. `refused` counts satellites by reason, `<system>_<reason>`;
    `recent` are its last epochs in order of time."""

    def __init__(self, source: str, section: RawAiding) -> None:
        self.source = source
        self._section = section
        self.gate = section.gate_probability
        self._store = EphemerisStore()
        options = RangeOptions(
            section.systems, math.radians(section.elevation_mask_deg), section.cno_mask_db_hz
        )
        self._model = RangeModel(self._store, options)
        self._guess: Array | None = None
        self._left_out: dict[str, str] = {}
        self._judged: (
            tuple[RawEpochMeasurement, _Corrected, Sequence[int], Sequence[float]] | None
        ) = None
        self._counted_ns = -1
        self.recent: list[RawEpochMeasurement] = []
        self._forgotten: tuple[Displacement | None, RangeBiases | None] = None, None
        """Levels of the last sky before the recent epochs."""
        self.refused: Counter[str] = Counter()

    def learn(self, message: NavigationMessage) -> None:
        """Store a satellite's message."""
        replaced = self._store.replaced
        self._store.add(message)
        if self._store.replaced > replaced and isinstance(message, Ephemeris):
            self.refused[f"{message.system}_number_of_another"] += 1

    def measurement(self, epoch: RawGnssEpoch, t_ns: int) -> RawEpochMeasurement:
        """Make a measurement of an epoch, with the present ephemerides."""
        picked = self._model.pick(epoch)
        measurement = RawEpochMeasurement(self.source, t_ns, self.gate, self, epoch, picked)
        insort(self.recent, measurement, key=_instant)
        oldest = self.recent[-1].t_ns - REMEMBERED_NS
        forgotten = self.recent[: bisect_left(self.recent, oldest, key=_instant)]
        for earlier in forgotten:
            memory = earlier.memory
            if memory.displacement is not None:
                self._forgotten = memory.displacement, memory.levels
        del self.recent[: len(forgotten)]
        return measurement

    def followed(self, measurement: RawEpochMeasurement) -> TrackedSignals:
        """Epoch with carriers tracked through all earlier epochs, in any order of arrival: a
        delayed epoch changes later ones."""
        recent = self.recent
        at = bisect_left(recent, measurement.t_ns, key=_instant)
        while (
            at < len(recent)
            and recent[at] is not measurement
            and recent[at].t_ns == measurement.t_ns
        ):
            at += 1
        if at == len(recent) or recent[at] is not measurement:  # older than all that is remembered
            return measurement.memory.followed or self._follow(measurement, None)
        first = at
        while first > 0 and not recent[first].memory.is_after(recent[first - 1].memory):
            first -= 1
        for k in range(first, at + 1):
            memory, before = recent[k].memory, recent[k - 1].memory if k else None
            if before is None and memory.followed is None:
                self._follow(recent[k], None)
            elif before is not None and not memory.is_after(before):
                self._follow(recent[k], before)
        found = measurement.memory.followed
        assert found is not None
        return found

    def _follow(self, measurement: RawEpochMeasurement, before: _Memory | None) -> TrackedSignals:
        memory = measurement.memory
        memory.after = None if before is None else before.kept
        memory.kept = initial_carriers() if before is None else before.kept.copy()
        memory.before = nothing_left() if before is None else before.left
        memory.followed = found = self._model.follow(measurement.picked, memory.kept)
        return found

    def alone(self, measurement: RawEpochMeasurement) -> list[Candidate]:
        """Position and velocity of an epoch alone, for the alignment; none without a solution."""
        found = single_point(self._model, self.followed(measurement), self._guess)
        candidates: list[Candidate] = []
        if isinstance(found, str) or not found.consistent:
            self.refused[found if isinstance(found, str) else "inconsistent"] += 1
        else:
            self._guess = found.position
            candidates = self._fix(found, measurement.t_ns)
        left_out = measurement.picked.plan.refused
        if self._guess is not None:
            left_out = self._model.evaluate(self.followed(measurement), self._guess).refused
        self._judged, self._left_out = None, dict(left_out)
        self._count(measurement, left_out, self.followed(measurement))
        return candidates

    def correct(
        self, measurement: RawEpochMeasurement, followed: TrackedSignals, guess: Array
    ) -> tuple[Rows, PseudorangeMeasurement]:
        """Rows of an epoch for a vehicle near `guess` (ECEF, m), and their measurement."""
        rows = self._model.evaluate(followed, guess)
        if self._section.best_four and (best := best_four(rows.line_of_sight)) is not None:
            chosen = {rows.satellites[k] for k in best[0]}
            rows = rows.without([s for s in rows.satellites if s not in chosen])
        t_s = measurement.epoch.week * WEEK_S + measurement.epoch.tow_s
        before, last = self._sky_before(measurement)
        levels = subtract_biases(last, rows, t_s)
        scale, values = self._section.sigma_scale**2, rows.values[:RANGE_VALUES]
        if scale != 1.0:
            values = values.copy()
            values[[VARIANCE, RATE_VARIANCE, CARRIER_VARIANCE]] *= scale
        displacement, kept = self._displaced(measurement, rows, levels, before)
        return rows, PseudorangeMeasurement(
            self.source,
            measurement.t_ns,
            measurement.gate,
            rows.satellites,
            values,
            rows.clock,
            self._section.lever_arm_m,
            measurement.epoch.clock_reset,
            measurement.t_ns * 1e-9 - t_s,
            measurement.memory.before,
            measurement.memory.left,
            displacement.shape,
            kept,
            levels.seen,
            robust=measurement.robust,
        )

    def _sky_before(
        self, measurement: RawEpochMeasurement
    ) -> tuple[Displacement | None, RangeBiases | None]:
        """Displacement and levels of the last epoch before one that had satellites."""
        at = bisect_left(self.recent, measurement.t_ns, key=_instant)
        for k in range(at - 1, -1, -1):
            memory = self.recent[k].memory
            if memory.displacement is not None:
                return memory.displacement, memory.levels
        return self._forgotten

    def _displaced(
        self,
        measurement: RawEpochMeasurement,
        rows: Rows,
        levels: RangeBiases,
        before: Displacement | None,
    ) -> tuple[Displacement, tuple[Array, Array] | None]:
        """Displacement by an epoch's sky, and the part carried over from the epoch before; None:
        all."""
        if not rows.satellites:
            return NOWHERE, None
        memory, t_s, variance = measurement.memory, levels.t_s, levels.variance
        memory.levels = levels
        fits = np.empty(len(rows.satellites), bool)
        if 0 < plausible(rows.values, rows.clock, fits) < len(fits):
            rows, variance = rows.only(fits), variance[fits]
        if before is not None and before.holds(rows, t_s):
            memory.displacement = before
            return before, None
        memory.displacement = now = Displacement.of(rows, t_s, variance, before)
        return now, None if before is None else now.carried(before)

    def judged(
        self,
        measurement: RawEpochMeasurement,
        corrected: _Corrected,
        codes: Sequence[int],
        whitened: Sequence[float],
    ) -> None:
        """Record a processed epoch; one repeated by a rewind counts once."""
        self._judged = measurement, corrected, codes, whitened
        self._guess = corrected.guess
        self._count(measurement, corrected.rows.refused, corrected.followed)
        if not codes or measurement.t_ns <= self._counted_ns:
            return
        self._counted_ns = measurement.t_ns
        if codes.count(KEPT) == len(codes):
            return
        for (satellite, what), code in zip(corrected.measurement.labels, codes, strict=True):
            if code != KEPT:
                self.refused[f"{satellite[0]}_{what}_{REASONS.get(code, 'gated')}"] += 1

    def _count(
        self,
        measurement: RawEpochMeasurement,
        refused: Sequence[tuple[str, str]],
        followed: TrackedSignals,
    ) -> None:
        """Count the refused satellites of an epoch."""
        if not measurement.memory.counted:
            measurement.memory.counted = True
            for satellite, reason in refused:
                self.refused[f"{satellite[0]}_{reason}"] += 1
            for satellite, reason in followed.slips:
                self.refused[f"{satellite[0]}_{reason}" if satellite else reason] += 1

    def sky(self) -> Sky:
        """Result of the last epoch."""
        if self._judged is None:
            return Sky(refused=dict(self._left_out))
        judged, corrected, codes, whitened = self._judged
        return sky_of(
            judged.epoch, corrected.rows, corrected.measurement, corrected.guess, codes, whitened
        )

    def _fix(self, found: SinglePoint, t_ns: int) -> list[Candidate]:
        x, y, z = (float(v) for v in found.position)
        lat, lon, height = to_geodetic(x, y, z)
        axes = ned_axes(lat, lon)
        covariance = axes.T @ found.covariance @ axes
        n, e, d = np.sqrt(np.diag(covariance)).tolist()
        lever = self._section.lever_arm_m
        # Its errors last: the ranges that follow have them, and are no proof of it.
        shape = Displacement.of(found.rows, 0.0, found.rows.lasting).shape.tolist()
        share = tuple(map(tuple, shape))
        of = (n, e, d), lever, RANGE_BIAS, "", "", share
        candidates: list[Candidate] = [PositionCandidate(t_ns, lat, lon, height, *of)]
        if found.velocity is not None:
            v_n, v_e, v_d = (axes.T @ found.velocity).tolist()
            sd = self._section.start_velocity_sd_m_s
            candidates.append(VelocityCandidate(t_ns, (v_n, v_e, v_d), (sd, sd, sd), lever))
        return candidates


def _instant(measurement: RawEpochMeasurement) -> int:
    return measurement.t_ns
