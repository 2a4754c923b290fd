"""Checkpoints of a timeline: where a rewind may start, and how close they lie."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from fusiond.estimators.base import Snapshot
from fusiond.integrity.diagnosis import Memory

Key = tuple[int, str, int]

# Where measurements come late, checkpoints lie as close as an eighth of their age: a rewind runs at
# most that much more than it must. Not closer than half the interval of a receiver of 10 Hz, whose
# fixes come some 0.1 s late: it then has none of the fixes before to apply again.
SHARE_OF_AGE, CLOSEST_NS = 8, 50_000_000


@dataclass(slots=True)
class Checkpoint:
    """State of estimator and diagnosis after the measurement `last_key`."""

    snapshot: Snapshot
    last_key: Key | None
    memory: Memory

    def precedes(self, key: Key) -> bool:
        """True if a measurement can still follow."""
        if self.snapshot.t_ns > key[0]:
            return False
        return self.last_key is None or self.last_key < key


class Spacing:
    """Interval between checkpoints, ns: `longest_ns`, shorter for `keep_ns` after a rewind.

    Results do not depend on it, nor on a checkpoint."""

    def __init__(self, longest_ns: int, keep_ns: int) -> None:
        self._longest_ns, self._keep_ns = longest_ns, keep_ns
        self._rewound_ns = -(2**62)  # never

    def rewound(self, latest_ns: int) -> None:
        """A rewind with the last sample at `latest_ns`."""
        self._rewound_ns = latest_ns

    def _lie_close(self, latest_ns: int) -> bool:
        return latest_ns - self._rewound_ns <= self._keep_ns

    def after(self, t_ns: int, latest_ns: int) -> int:
        """Interval from a checkpoint at `t_ns` to the next."""
        if not self._lie_close(latest_ns):
            return self._longest_ns
        return min(self._longest_ns, max(CLOSEST_NS, (latest_ns - t_ns) // SHARE_OF_AGE))

    def thin(self, checkpoints: list[Checkpoint], latest_ns: int) -> None:
        """Drop those that lie closer than their age asks, but the first and the last."""
        if not self._lie_close(latest_ns):
            return
        found, longest_ns = checkpoints[:1], self._longest_ns
        for one, later in pairwise(checkpoints[1:]):
            before_ns = found[-1].snapshot.t_ns
            gap_ns = later.snapshot.t_ns - before_ns
            if gap_ns > longest_ns or (
                gap_ns > CLOSEST_NS and gap_ns > (latest_ns - before_ns) // SHARE_OF_AGE
            ):
                found.append(one)
        checkpoints[:] = [*found, *checkpoints[1:][-1:]]
