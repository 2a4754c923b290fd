"""What is kept of all series of innovations, and copied for checkpoints."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid
from fusiond.aiding.offers import PositionOffer
from fusiond.integrity import denied, returns
from fusiond.integrity.hedge import NOTHING, Hedge, differ
from fusiond.integrity.lately import SELDOM
from fusiond.integrity.means import FAST_COUNT, Means
from fusiond.integrity.moved import FINE_M, Moved, Parted, left
from fusiond.integrity.returns import Begun
from fusiond.integrity.series import NEVER_NS, Series
from fusiond.integrity.tilt import Tilting
from fusiond.navigation.error_model import DR

Array = NDArray[np.float64]


class Memory(NamedTuple):
    """All that a later restore needs."""

    records: dict[str, Series]
    doubts: tuple[int, ...]
    tilting: Tilting
    wider: Mapping[str, Array]


class Kept:
    """Series by name, doubts of the filter, sums of its tilt's corrections, and what is open."""

    def __init__(self) -> None:
        self._records: dict[str, Series] = {}
        self._shared: set[str] = set()
        """Series whose record a checkpoint has too: copied before it is changed."""
        self._doubts: tuple[int, ...] = ()
        self._tilting = Tilting()
        self.hedge = Hedge()
        self._begun, self._comes = Begun(), returns.NOTHING

    @property
    def doubts(self) -> tuple[int, ...]:
        """Instants (ns) at which the filter was in doubt, the last few of them."""
        return self._doubts

    @property
    def moved(self) -> Moved | None:
        """What the position that may be off by most may be off by: a filter that starts anew knows
        no more of it."""
        positions = [r for r in self._records.values() if r.locates]
        opened = [r.moved for r in positions if r.moved is not None]
        begun = self._begun.moved
        if begun and not any(r.device == begun.device and r.fused_ns > NEVER_NS for r in positions):
            opened.append(begun)
        return max(opened, key=lambda one: sum(one.leaves_open(one.since_ns)[:2]), default=None)

    def handed_on(self, t_ns: int) -> Moved | None:
        """What a navigation must know that goes on from this one and remembers nothing else of its
        sources: what one may be off by, or one that is left out is apart by at `t_ns`."""
        out = [r for r in self._records.values() if r.locates and r.excluded]
        opened = [left(r.device, t_ns, max(0, t_ns - r.refused_ns), r.away_m) for r in out]
        if self.moved is not None:
            opened.append(self.moved)
        return max(opened, key=lambda one: sum(one.leaves_open(t_ns)[:2]), default=None)

    def snapshot(self) -> Memory:
        """A copy of everything."""
        self._shared = set(self._records)
        mine = self._records.copy(), self._doubts, self._tilting.copied(), self.hedge.wider
        return Memory(*mine)

    def restore(self, memory: Memory) -> None:
        """Back to a snapshot."""
        self._records, self._shared = memory.records.copy(), set(memory.records)
        self._doubts, self._tilting = memory.doubts, memory.tilting.copied()
        self.hedge.wider = memory.wider

    def reset(
        self, contradicted: bool = False, failed: bool = False, moved: Moved | None = None
    ) -> None:
        """The filter starts anew: nobody is suspected. But positions that were `contradicted` by
        their velocities are to prove themselves, as after an outage; and where one before it has
        `failed`, that they are on time, or is open what they have `moved` by."""
        self._begun, self._comes = Begun(contradicted, failed, moved), returns.NOTHING
        self._records, self._shared = {}, set()
        self._doubts, self._tilting, self.hedge.wider = (), Tilting(), NOTHING

    def _own(self, aid: Aid, known: Series | None) -> Series:
        """The series of an aid, which may be changed: none was known, or a checkpoint has it."""
        if known is None:
            record = Series(aid.device, aid.locates, aid.moves, aid.t_ns, aid.no_slip)
            record.means = Means.begun(aid.white)
        else:
            self._shared.discard(aid.source)
            record = known.copied()
        self._records[aid.source] = record
        return record

    def _parts(self, record: Series, t_ns: int, by: Sequence[float]) -> None:
        """The motion is doubted for what a velocity or a position is off `by` (m/s or m)."""
        if record.locates:
            record.parted = runs(record, t_ns, by)
        elif record.moves:
            record.parted = Parted.shown(t_ns, by)
        if not record.excluded:
            self._followed(record, t_ns)

    def _goes_alone(self, record: Series, t_ns: int, said: PositionOffer, p: Array) -> None:
        """A fine position is off in a mean that is no chance, P (n, n) of the filter: where its
        device sends no velocity that would tell, the filter follows what may run away with it."""
        series = self._records.values()
        if record.sd_m > FINE_M or any(r.moves and r.device == record.device for r in series):
            return
        if not record.every_ns or not record.means.follows(p, DR, said.sd, SELDOM):
            return
        parted = runs(record, t_ns, differ(record, said, p))
        what, before = parted.followed(record.device, t_ns), record.moved
        if before is None or sum(before.speeds) < sum(what.speeds):
            known = None if before is None or not any(before.squares) else before
            record.moved = what.joined(known)

    def _followed(self, record: Series, t_ns: int) -> None:
        """A velocity is believed again, or still: where it had parted from the filter, what it may
        carry the position of its device off by is open."""
        if record.parted is None:
            return
        what, record.parted = record.parted.followed(record.device, t_ns), None
        for position in self._positions_of({record.device}):
            position.moved = what.joined(position.moved)

    def _denied_positions(self) -> list[Series]:
        """Positions that are believed of devices whose velocities are not, by what wheels say: they
        are wrong together."""
        wrong = denied.devices(self._records)
        return [r for r in self._positions_of(wrong) if not r.excluded]

    def _positions_of(self, devices: Set[str]) -> list[Series]:
        """Series of positions, which may be changed."""
        found = [n for n, r in self._records.items() if r.locates and r.device in devices]
        for name in found:
            if name in self._shared:
                self._shared.discard(name)
                self._records[name] = self._records[name].copied()
        return [self._records[name] for name in found]


def runs(record: Series, t_ns: int, by: Sequence[float]) -> Parted:
    """How fast a position goes that is off `by` (m) in the mean, within the time that this looks
    back. Of one that goes fast the mean lags behind the last of its fixes."""
    over_s = FAST_COUNT * record.every_ns * 1e-9
    off = math.hypot(by[0], by[1])
    lags = max(1.0, record.away_m / off) if off > 0.0 else 1.0
    return Parted.shown(t_ns, [lags * one / over_s for one in by])
