r"""Isolation of local filters: two tests, isolation, return.

Innovation test   sum over the last W innovations of min(nu^T S^-1 nu, gate), each a chi-square of
                  its dimension while filter and sensor agree, against the quantile 1 - p of the
                  chi-square with all their degrees of freedom. Capped at the gate, so that a single
                  outlier does not isolate a source: with three axes and the default gate, p and W
                  it would once in 5000 cases, two in 2 %, three in 60 %, four do. While the window
                  is not full yet, two in a row are enough.
Difference test   d^T (P_i + P_o)^-1 d, local filter against all others on position and velocity
                  (fusiond.estimators.federated.fusion_kernels), against the quantile 1 - p. It
                  finds a slow drift, which a local filter follows with small innovations. The
                  filter that stands out most is the one isolated; among fewer than three nobody can
                  say which.

p is the probability of a false alarm of one test. Both tests are conservative: capped innovations
are less than chi-square, and local filters that each carry Q / beta of the common process noise
have a covariance above the true one.

An isolated filter is reset to the master before each measurement of its sensor, whose innovation is
then judged. After `readmit_after` innovations in a row inside the gate, whose sum is below the
quantile `READMISSION`, it is readmitted.

Source: Brumback and Srinath, IEEE Trans. AC 32 (1987), 1133 (chi-square tests on states); Carlson
and Berarducci, NAVIGATION 41 (1994), 297 (isolation in federated filters); Baarda's data snooping
for the choice of the worst.
"""

from __future__ import annotations

from typing import NamedTuple

from fusiond.estimators.base import gate_threshold

# A local filter is isolated only while another is believed that was heard in the last ten seconds
# (as long as a position holds the mode `navigating`): there must be somebody to disagree with.
RECENT_NS = 10_000_000_000
NEVER_NS = -(2**62)
# The sum of the innovations that bring a sensor back lies below this quantile: a healthy sensor
# waits once more in a thousand cases, and a bias of 1.2 sigma over twenty fixes does not come back.
READMISSION = 0.999
# A difference names the worst only among at least so many.
FEWEST_TO_COMPARE = 3

INNOVATION, DIFFERENCE = "innovation test", "difference test"


class Record(NamedTuple):
    """State of one local filter; never changed, so that a snapshot may hold it.

    `window`: (NIS, degrees) of the last innovations; `reason`: of its isolation; `passes`:
    innovations in a row that have passed since; `received_ns`: its last fused measurement.
    """

    window: tuple[tuple[float, int], ...] = ()
    reason: str = ""
    passes: int = 0
    received_ns: int = NEVER_NS


class FaultDetection:
    """Records by local filter, 0 ... count - 1, and the tests on them.

    `false_alarm`: probability of each test; `window`, `readmit_after`: innovations.
    """

    def __init__(self, count: int, false_alarm: float, window: int, readmit_after: int) -> None:
        self._pass, self._window, self._readmit_after = 1.0 - false_alarm, window, readmit_after
        self.records = [Record()] * count

    def reset(self) -> None:
        """Reset: all local filters are trusted, without measurements."""
        self.records = [Record()] * len(self.records)

    def is_isolated(self, local: int) -> bool:
        """True if a local filter is kept out."""
        return bool(self.records[local].reason)

    def received(self, local: int, t_ns: int) -> None:
        """Record a measurement of a local filter fused at `t_ns`."""
        self.records[local] = self.records[local]._replace(received_ns=t_ns)

    def innovation(self, local: int, nis: float, degrees: int, threshold: float) -> bool:
        """Add an innovation of a trusted filter; True if its window still passes."""
        record = self.records[local]
        window = (*record.window, (min(nis, threshold), degrees))[-self._window :]
        self.records[local] = record._replace(window=window)
        return self._passes(window, self._pass)

    def worst(self, statistics: dict[int, float], degrees: int) -> int | None:
        """Filter whose difference from the others fails worst; None if none fails."""
        if len(statistics) < FEWEST_TO_COMPARE:
            return None
        local = max(statistics, key=lambda i: statistics[i])
        return local if statistics[local] > gate_threshold(self._pass, degrees) else None

    def may_isolate(self, local: int, t_ns: int) -> bool:
        """True if another trusted filter had a recent measurement."""
        return any(
            i != local and not r.reason and t_ns - r.received_ns <= RECENT_NS
            for i, r in enumerate(self.records)
        )

    def isolate(self, local: int, reason: str) -> None:
        """Isolate a filter."""
        self.records[local] = self.records[local]._replace(window=(), reason=reason, passes=0)

    def behaves(self, local: int, nis: float, degrees: int, threshold: float) -> bool:
        """Add an innovation of an isolated filter; True if it is readmitted."""
        record = self.records[local]
        if not nis <= threshold:
            self.records[local] = record._replace(window=(), passes=0)
            return False
        window = (*record.window, (nis, degrees))[-self._readmit_after :]
        passes = record.passes + 1
        if passes < self._readmit_after or not self._passes(window, READMISSION):
            self.records[local] = record._replace(window=window, passes=passes)
            return False
        self.records[local] = Record(received_ns=record.received_ns)
        return True

    @staticmethod
    def _passes(window: tuple[tuple[float, int], ...], probability: float) -> bool:
        total, degrees = sum(n for n, _ in window), sum(d for _, d in window)
        return total <= gate_threshold(probability, degrees)
