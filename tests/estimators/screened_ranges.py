"""The axes of fixes as ranges with a receiver clock in them: a measurement judged row by row."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from drivers.immutable import immutable
from fusiond.aiding.base import AidingMeasurement, Innovation, Linearised, NotApplicable, State
from fusiond.aiding.position import PositionMeasurement
from fusiond.models.blocks import CLOCK_OFFSET


@immutable()
class Ranges(AidingMeasurement):
    """A fix's axes, twice, each with the receiver's clock in it (m); `wrong` is added to one."""

    screened: ClassVar[bool] = True

    fix: PositionMeasurement
    clock_m: float
    wrong: float = 0.0
    left_out: bool = False

    def innovation(self, state: State) -> Innovation | NotApplicable:
        once = self.fix.innovation(state)
        assert isinstance(once, Innovation)
        z, h, r = np.tile(once.z, 2), np.tile(once.h, (2, 1)), np.tile(once.r, 2)
        slot = state.model.slots_of(CLOCK_OFFSET)[0]
        h[:, slot] = -1.0
        z += state.xi[slot] - self.clock_m
        z[4] += self.wrong
        keep = np.arange(6) != 4 if self.left_out else np.full(6, True)
        return Innovation(z[keep], h[keep], r[keep])


def ranges(
    measurements: list[list[Linearised]],
    jump_at: int = 99,
    wrong_at: int = 99,
    left_out: bool = False,
) -> list[list[Linearised]]:
    """The fixes of a drive as ranges: the clock at 5 m, then 3 km; one bad row at an epoch."""
    found: list[list[Linearised]] = []
    for k, (fix, velocity) in enumerate(measurements):
        assert isinstance(fix, PositionMeasurement)
        clock = 3000.0 if k >= jump_at else 5.0
        wrong = 300.0 if k == wrong_at else 0.0
        skip = left_out and k == wrong_at
        found.append([velocity, Ranges("raw", fix.t_ns, 1 - 1e-9, fix, clock, wrong, skip)])
    return found
