r"""Where a receiver's positions leap against its own velocities.

    r_k = p_k - p_k-1 - (v_k + v_k-1) / 2 (t_k - t_k-1)

Stamps that begin to be late by tau, or end to be, make a leap of v tau, and what the fixes before it
say of a lateness is not true of those after it. Noise of s an axis has norms of the median
s sqrt(2 ln 2), which a few leaps do not move.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fusiond.aiding.offers import PositionOffer, VelocityOffer
from fusiond.navigator.alignment.start import as_geodetic

# Beyond as many sigmas chance leaps once in seventy million.
LEAP_SIGMAS = 6.0
# A lateness that changes by less (s) is as good as the same: the least that is told of one.
SAME_S = 0.05
# Over longer intervals (s) trapezoids of the velocity are no way.
LONGEST_S = 4.0


class Epoch(NamedTuple):
    """A measurement's velocity and, where it has one, its position."""

    velocity: VelocityOffer
    position: PositionOffer | None


def since_leap(epochs: Sequence[Epoch]) -> Sequence[Epoch]:
    """Of epochs in order of time those since the last leap."""
    if len(epochs) < 2 or any(epoch.position is None for epoch in epochs):
        return epochs
    places = [(e.position.lat_rad, e.position.lon_rad) for e in epochs if e.position is not None]
    metres = 1.0 / as_geodetic(np.ones(3), places[0][0])[:2]
    steps = np.diff(np.array(places), axis=0)
    steps[:, 1] -= 2.0 * math.pi * np.round(steps[:, 1] / (2.0 * math.pi))
    v = np.array([e.velocity.v_ned[:2] for e in epochs])
    dt_s = np.diff([e.velocity.t_ns for e in epochs]) * 1e-9
    mean_v = 0.5 * (v[1:] + v[:-1])
    off = np.hypot(*(steps * metres - mean_v * dt_s[:, None]).T)
    looked = dt_s <= LONGEST_S
    if not looked.any():
        return epochs
    chance = LEAP_SIGMAS * float(np.median(off[looked])) / math.sqrt(2.0 * math.log(2.0))
    leaps = np.flatnonzero(looked & (off > np.maximum(chance, SAME_S * np.hypot(*mean_v.T))))
    return epochs[leaps[-1] + 1 :] if leaps.size else epochs
