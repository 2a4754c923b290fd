"""Timeline: measurements in order of validity, checkpoints of the filter, exact rewinding.

A delayed measurement rewinds the filter to the last checkpoint before its instant; it is applied
there, and everything after it runs again. The resulting state equals, bit for bit, that of arrival
in order of validity, if the measurement is younger than the oldest checkpoint. Measurements of one
instant are ordered by source, not by arrival; a feedback that is due comes first.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from fusiond.aiding.base import AidingMeasurement, Feedback
from fusiond.aiding.initialisation_candidates import Candidate
from fusiond.estimators.base import Estimator, Outcome
from fusiond.estimators.measurement_loop_kernel import JUDGE, KEEP
from fusiond.integrity.catalogue import Kind
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.strapdown import STEP_RESTS_S
from fusiond.navigator.checkpoints import Checkpoint, Key, Spacing
from fusiond.navigator.health_check import RAISED_BY_NUMBERS
from fusiond.navigator.packed_measurements import MeasurementRows, Span, raw_of
from fusiond.navigator.ungated_innovation import RawInnovation, raw_innovation

# Outcomes that say something of a source.
JUDGED = frozenset({"fused", "gated", "isolated"})
# Measurements that may wait for the start or for the IMU: more than a minute of all that a
# well-equipped vehicle sends. Beyond it the oldest are given up.
MOST_WAITING = 4096


@dataclass(slots=True)
class Entry:
    """Measurement on the timeline with its latest outcome. `serial` distinguishes equal sources;
    `judged`: a verdict has used its innovation, which a rewind computes again. `error` is the cause
    of `failed`; `raw` is stored if `keeps_raw`. `row` is the packed measurement, empty without one,
    `value` what a frozen sensor would repeat and `span` the constants of a source's rows."""

    key: Key
    measurement: AidingMeasurement
    feedback: Feedback = "at_once"
    row: bytes = b""
    value: object = None
    span: Span | None = None
    outcome: Outcome | None = None
    judged: bool = False
    error: str = ""
    raw: RawInnovation | None = None


@dataclass(slots=True)
class Counters:
    """Outcomes by source; number and total length of `rewinds`."""

    outcomes: defaultdict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    rewinds: int = 0
    rewound_ns: int = 0


class Timeline:
    """Timeline of an estimator: IMU samples and measurements in order of validity.

    `on_outcome` is called with each applied entry, again after a rewind.
    """

    def __init__(
        self,
        estimator: Estimator,
        imu: ImuBuffer,
        keep_s: float,
        checkpoint_s: float,
        on_outcome: Callable[[Entry], None] | None = None,
        kinds: Sequence[Kind] = (),
    ) -> None:
        self.estimator = estimator
        self.imu = imu
        self.counters = Counters()
        self.keeps_raw = False
        """True if entries are to have their raw innovation: a log wants it, at 10 us a
        measurement."""
        self.decided = True
        """True after any decision since the last reset to False, beyond fusing measurements in
        service."""
        self._keep_ns = round(keep_s * 1e9)
        self._spacing = Spacing(round(checkpoint_s * 1e9), self._keep_ns)
        self._due_ns = 0
        """Instant of the next checkpoint."""
        self._on_outcome = on_outcome
        self._entries: list[Entry] = []
        self._keys: list[Key] = []
        self._next = 0
        self._checkpoints: list[Checkpoint] = []
        self.diagnosis = Diagnosis(kinds)
        self._isolates = estimator.isolates
        self._rows = MeasurementRows(estimator)

    def start(self, used: Collection[Candidate] = ()) -> None:
        """Start at the estimator's state: earlier measurements are too old, and those that it
        contains, `used`, are not applied again."""
        self._next = 0
        self.diagnosis.reset()
        self._checkpoints = [Checkpoint(self.estimator.snapshot(), None, self.diagnosis.snapshot())]
        self._space()
        t_ns = self.estimator.t_ns
        self._give_up(bisect_left(self._keys, (t_ns, "", 0)), "no_alignment")
        for row in range(bisect_left(self._keys, (t_ns + 1, "", 0)) - 1, -1, -1):
            candidates = self._entries[row].measurement.candidates()
            if any(_same(one, other) for one in candidates for other in used):
                self._count(self._entries[row], Outcome("start"))
                del self._entries[row], self._keys[row]
        self.imu.needed = self.estimator.sample

    def clear(self) -> None:
        """Drop all waiting measurements, before a restart of the estimator."""
        del self._entries[: self._next], self._keys[: self._next]
        self._next = 0
        self._give_up(len(self._entries), "no_alignment")
        self._checkpoints.clear()
        self.imu.needed = None

    @property
    def waiting(self) -> int:
        """Number of measurements whose instant the filter has not reached."""
        return len(self._entries) - self._next

    @property
    def oldest_ns(self) -> int:
        """Earliest instant of validity that is still accepted."""
        return self._checkpoints[0].snapshot.t_ns if self._checkpoints else 0

    def insert(self, measurement: AidingMeasurement, serial: int = 0) -> Entry:
        """Insert a measurement by validity; refused at once as `too_old` or `duplicate`."""
        # What is due to be fed back is fed back before anything of the same instant is applied: the
        # next RDSS request may leave at the very instant at which its predecessor's fix arrived.
        # Of one instant, velocities come first: after an outage a false position passes its gate by
        # the outage's sigma and takes the velocity along, and then the honest velocity would fail.
        first = " " if measurement.moves and not measurement.locates else ""
        feedback: Feedback = measurement.feedback if measurement.waits else "at_once"
        key = (
            measurement.t_ns,
            "" if feedback == "release" else first + measurement.source,
            serial,
        )
        entry = Entry(key, measurement, feedback, *self._rows.packed(measurement))
        oldest = self._checkpoints[0] if self._checkpoints else None
        if oldest and key[0] <= oldest.snapshot.t_ns and not oldest.precedes(key):
            self._count(entry, Outcome("too_old"))
            return entry
        last = len(self._keys)
        at = last if not last or self._keys[-1] < key else bisect_left(self._keys, key)
        if at < last and self._keys[at] == key:
            self._count(entry, Outcome("duplicate"))
            return entry
        self._keys.insert(at, key)
        self._entries.insert(at, entry)
        if self._checkpoints and (
            at < self._next or (at == self._next and measurement.t_ns < self.estimator.t_ns)
        ):
            if at < self._next:
                self._next += 1
            self._rewind(key)
        elif len(self._entries) - self._next > MOST_WAITING:
            self._give_up(1, "no_imu" if self._checkpoints else "no_alignment")
        return entry

    def advance(self, record: bool = False) -> None:
        """Apply every measurement whose instant the IMU has reached, and propagate to its last
        sample."""
        latest, imu, kept = self.imu.latest_ns, self.imu, self._checkpoints
        estimator, end = self.estimator, bisect_left(self._keys, (latest + 1,), self._next)
        while self._next < end:
            if self._run_rows(end, record):
                continue
            entry = self._entries[self._next]
            if (t_ns := entry.key[0]) > estimator.t_ns or estimator.passing:
                estimator.propagate(imu, t_ns, record)
                if estimator.t_ns >= self._due_ns:
                    self._checkpoint()
            self._count(entry, self._apply(entry))
            self._next += 1
        estimator.propagate(imu, latest, record, passing=True)
        if estimator.t_ns >= self._due_ns:
            self._checkpoint()
            self._spacing.thin(kept, latest)
        horizon = latest - self._keep_ns
        if len(kept) > 1 and kept[1].snapshot.t_ns <= horizon:
            self._forget(horizon)

    @contextmanager
    def past(self, t_ns: int) -> Iterator[None]:
        """Context with the estimator's state at `t_ns` (from `oldest_ns` on), after all
        measurements valid until then; restored bit for bit afterwards.

        It runs from the last checkpoint before, at the cost of a rewind to that instant; nothing is
        counted or reported.
        """
        estimator = self.estimator
        present = estimator.snapshot()
        checkpoint = next(c for c in reversed(self._checkpoints) if c.snapshot.t_ns <= t_ns)
        memory = self.diagnosis.snapshot()
        self.diagnosis.restore(checkpoint.memory)
        estimator.restore(checkpoint.snapshot)
        try:
            for row in range(self._following(checkpoint), len(self._entries)):
                at_ns = self._keys[row][0]
                if at_ns > t_ns:
                    break
                if at_ns > estimator.t_ns or estimator.passing:
                    estimator.propagate(self.imu, at_ns)
                self._apply(self._entries[row])
            estimator.propagate(self.imu, t_ns, passing=True)
            yield
        finally:
            estimator.restore(present)
            self.diagnosis.restore(memory)

    def _run_rows(self, end: int, record: bool) -> bool:
        """Run the estimator over the next packed entries before `end` that need gate and hypotheses
        only; False if the next one needs more."""
        estimator, kept_ns = self.estimator, self._checkpoints[-1].snapshot.t_ns
        if not estimator.runs:
            return False
        which, every_ns = range(self._next, end), self._due_ns - kept_ns
        batch = self._rows.batch(self._entries, which, self.diagnosis, self._due_ns)
        if batch is None:
            return False
        ran = estimator.run(self.imu, *batch, record, (kept_ns, every_ns))
        entries = self._entries[self._next : self._next + ran.done]
        outcomes = self._rows.went_on(entries, ran.results[: ran.done])
        for k, (entry, outcome) in enumerate(zip(entries, outcomes, strict=True)):
            entry.raw = raw_of(ran.results[k].tolist(), outcome.degrees) if self.keeps_raw else None
            self._next += 1
            judged = ran.how == JUDGE and k + 1 == ran.done
            self._count(entry, self._judged(entry, outcome) if judged else outcome)
        if ran.how == KEEP:
            self._checkpoint()
        return ran.done > 0 or ran.how == KEEP

    def _judged(self, entry: Entry, outcome: Outcome) -> Outcome:
        """Outcome of a measurement, judged by gate and hypotheses."""
        measurement, self.decided = entry.measurement, True
        try:
            one = self.diagnosis.series[measurement.source]
            correction = self.diagnosis.judge(measurement, one, outcome, self.estimator)
            if correction is not None:
                self.estimator.adopt(correction.mean, correction.spread)
        except RAISED_BY_NUMBERS as error:
            entry.error = repr(error)
            return Outcome("failed")
        return outcome

    def _give_up(self, count: int, name: str) -> None:
        """Drop the first `count` waiting entries."""
        rows = slice(self._next, self._next + count)
        for entry in self._entries[rows]:
            self._count(entry, Outcome(name))
        del self._entries[rows], self._keys[rows]

    def _apply(self, entry: Entry) -> Outcome:
        """Apply a measurement; an exception costs only that measurement."""
        estimator, diagnosis, self.decided = self.estimator, self.diagnosis, True
        try:
            if entry.feedback == "release":
                estimator.release()
            elif entry.feedback == "hold":
                estimator.hold()
            measurement = entry.measurement
            if measurement.placed:
                measurement = measurement.at(estimator.nav)
            entry.raw = raw_innovation(measurement, estimator) if self.keeps_raw else None
            if self._isolates:
                outcome = estimator.update(measurement)
                self._rests(measurement, outcome)
                return outcome
            one = diagnosis.comes(measurement, estimator)
            if one.stale and not one.out:
                return Outcome("repeated")
            if one.out:
                outcome = estimator.look(
                    measurement, diagnosis.lasting(measurement, one, estimator)
                )
            else:
                outcome = estimator.update(measurement, one.noise)
            self._rests(measurement, outcome)
            if outcome.name in JUDGED:
                correction = diagnosis.judge(measurement, one, outcome, estimator)
                if correction is not None:
                    estimator.adopt(correction.mean, correction.spread)
        except RAISED_BY_NUMBERS as error:
            entry.error = repr(error)
            return Outcome("failed")
        return outcome

    def _rests(self, measurement: AidingMeasurement, outcome: Outcome) -> None:
        """Store a measurement of rest, for the propagation after it."""
        if measurement.constraint and measurement.rests_s:
            self.estimator.step[STEP_RESTS_S] = measurement.rests_s * (outcome.name == "fused")

    def _count(self, entry: Entry, outcome: Outcome) -> None:
        before, entry.outcome = entry.outcome, outcome
        if before is None or before.name != outcome.name:
            counts = self.counters.outcomes[entry.measurement.source]
            counts[outcome.name] += 1
            if before is not None:
                counts[before.name] -= 1
        if self._on_outcome is not None:
            self._on_outcome(entry)

    def _checkpoint(self) -> None:
        last_key = self._keys[self._next - 1] if self._next else self._checkpoints[-1].last_key
        self._checkpoints.append(
            Checkpoint(self.estimator.snapshot(), last_key, self.diagnosis.snapshot())
        )
        self._space()

    def _space(self) -> None:
        """Find the instant of the next checkpoint."""
        t_ns = self._checkpoints[-1].snapshot.t_ns
        self._due_ns = t_ns + self._spacing.after(t_ns, self.imu.latest_ns)

    def _rewind(self, key: Key) -> None:
        """Rewind to the last checkpoint before `key`."""
        before = self.estimator.t_ns
        self._spacing.rewound(self.imu.latest_ns)
        while len(self._checkpoints) > 1 and not self._checkpoints[-1].precedes(key):
            self._checkpoints.pop()
        checkpoint = self._checkpoints[-1]
        self._space()
        self.estimator.restore(checkpoint.snapshot)
        diagnosis = self.diagnosis
        findings, excluded = diagnosis.findings, diagnosis.excluded
        diagnosis.restore(checkpoint.memory)
        same = diagnosis.findings is findings and diagnosis.excluded == excluded
        self.decided |= self._isolates or not same
        self._next = self._following(checkpoint)
        self.counters.rewinds += 1
        self.counters.rewound_ns += max(0, before - key[0])

    def _following(self, checkpoint: Checkpoint) -> int:
        """Row of the first entry after the checkpoint."""
        last_key = checkpoint.last_key
        return 0 if last_key is None else bisect_left(self._keys, last_key) + 1

    def _forget(self, horizon_ns: int) -> None:
        """Drop checkpoints and entries that are no longer needed."""
        drop = 0
        while (
            drop + 1 < len(self._checkpoints)
            and self._checkpoints[drop + 1].snapshot.t_ns <= horizon_ns
        ):
            drop += 1
        if drop:
            del self._checkpoints[:drop]
        oldest = self._checkpoints[0]
        self.imu.needed = oldest.snapshot.sample
        if oldest.last_key is None:
            return
        stale = bisect_left(self._keys, oldest.last_key, 0, self._next)
        if stale:
            del self._entries[:stale]
            del self._keys[:stale]
            self._next -= stale


def _same(one: Candidate, other: Candidate) -> bool:
    """True if two candidates are equal; vectors may be arrays, if given by a caller in Python."""
    return type(one) is type(other) and all(
        a is b or np.array_equal(np.asarray(a), np.asarray(b))
        for a, b in zip(one, other, strict=True)
    )
