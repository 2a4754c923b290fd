r"""Position jumps of a receiver, detected by its own velocities.

    r_k = p_k - p_k-1 - (v_k + v_k-1) / 2 (t_k - t_k-1)

A delay tau that starts or ends makes a jump of v tau, and fixes before it are no evidence on the
delay after it. Noise of s an axis has norms of the median s sqrt(2 ln 2), which a few jumps do not
change.

If the sum of r along the track, which telescopes to the noise of two positions, stays below v tau,
no delay tau has started, although an inertial unit that was turned for some seconds would fit one.

If the velocities alone are delayed by tau, the positions lead them,

    d_k = sum r = tau (v_k - v_0)

and tau is the slope of one by the other. The IMU shows the delay of the velocities, this slope that
of the positions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.initialisation_candidates import PositionCandidate, VelocityCandidate
from fusiond.navigation.distributions import median
from fusiond.navigator.alignment.start import as_geodetic

Array = NDArray[np.float64]

# Beyond as many sigmas chance leaps once in seventy million.
LEAP_SIGMAS = 6.0
# A delay that changes by less (s) is as good as the same: the least that is told of one.
SAME_S = 0.05
# Over longer intervals (s) trapezoids of the velocity are no way.
LONGEST_S = 4.0
# Slower (m/s) a delay may change by a second within the noise of a position.
SLOW_M_S = 3.0
# A look goes by fixes of so long (15 s, and 10 s that it waits for a better one).
LOOKED_NS = 30_000_000_000
# So much change of velocity (m/s) shows a delay: at 1 m/s^2 one of half a second is off by ten
# sigma of a receiver's velocity meanwhile.
SHOWING_M_S = 5.0


class Epoch(NamedTuple):
    """Velocity of a measurement and, if available, its position."""

    velocity: VelocityCandidate
    position: PositionCandidate | None


def since_leap(epochs: Sequence[Epoch]) -> Sequence[Epoch]:
    """Epochs, in order of time, since the last position jump."""
    steps = _steps(epochs)
    if steps is None or not (looked := steps.dt_s <= LONGEST_S).any():
        return epochs
    size = np.hypot(*steps.off_m.T)
    chance = LEAP_SIGMAS * median(size[looked]) / math.sqrt(2.0 * math.log(2.0))
    speed = np.hypot(*steps.v_m_s.T)
    jumps = np.flatnonzero(looked & (size > np.maximum(chance, SAME_S * speed)))
    return epochs[jumps[-1] + 1 :] if jumps.size else epochs


def unchanged(epochs: Sequence[Epoch], by_s: float, doubted_ns: int = 0) -> bool:
    """True if the receiver's delay cannot have grown by `by_s` within the data nor have been larger
    before: the positions have followed the velocities, which had changed enough to show a delay.
    Data after a contradiction at `doubted_ns` are no proof: a solution restarted by delayed fixes
    agrees with them for a while."""
    steps = _steps(epochs)
    if steps is None:
        return False
    speed = np.hypot(*steps.v_m_s.T)
    unseen = np.flatnonzero((speed < SLOW_M_S) | (steps.dt_s > LONGEST_S))
    first = int(unseen[-1]) + 1 if unseen.size else 0
    later = -np.sum(steps.off_m[first:] * steps.v_m_s[first:], axis=1) / speed[first:] ** 2
    times = np.array([e.velocity.t_ns for e in epochs[first:]])
    before = (times > doubted_ns + LOOKED_NS) & (times <= times[-1] - LOOKED_NS)
    if not before.any() or np.ptp(np.cumsum(later)) > 0.5 * by_s:
        return False
    v = np.array([e.velocity.v_ned[:2] for e in epochs[first:]])[before]
    return math.hypot(*np.ptp(v, axis=0)) >= SHOWING_M_S


def velocities_alone(epochs: Sequence[Epoch], by_s: float) -> bool:
    """True if velocities are delayed by `by_s` more than before (negative: less), and positions fit
    the old delay better."""
    steps = _steps(epochs)
    if steps is None or (steps.dt_s > LONGEST_S).any():
        return False
    off = np.vstack((np.zeros(2), np.cumsum(steps.off_m, axis=0)))
    v = np.array([e.velocity.v_ned[:2] for e in epochs])
    off, v = off - off.mean(axis=0), v - v.mean(axis=0)
    return float(np.sum(off * v)) / by_s > 0.5 * float(np.sum(v * v))


class _Steps(NamedTuple):
    """Steps between epochs (k,): length, position error (k, 2), and mean velocity (k, 2), north and
    east."""

    dt_s: Array
    off_m: Array
    v_m_s: Array


def _steps(epochs: Sequence[Epoch]) -> _Steps | None:
    """Steps between epochs; None without steps or positions."""
    if len(epochs) < 2 or any(epoch.position is None for epoch in epochs):
        return None
    places = [(e.position.lat_rad, e.position.lon_rad) for e in epochs if e.position is not None]
    metres = 1.0 / as_geodetic(np.ones(3), places[0][0])[:2]
    steps = np.diff(np.array(places), axis=0)
    steps[:, 1] -= 2.0 * math.pi * np.round(steps[:, 1] / (2.0 * math.pi))
    v = np.array([e.velocity.v_ned[:2] for e in epochs])
    dt_s = np.diff([e.velocity.t_ns for e in epochs]) * 1e-9
    mean_v = 0.5 * (v[1:] + v[:-1])
    return _Steps(dt_s, steps * metres - mean_v * dt_s[:, None], mean_v)
