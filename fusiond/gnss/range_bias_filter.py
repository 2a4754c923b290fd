r"""Constant range bias of each satellite while it is tracked.

The mean over the sky of the errors e_k, of `Rows.lasting` variance L, is a displacement or a clock
error (fusiond.gnss.range_error_displacement); the rest of e_k shows in the innovations nu, as the
other satellites bound the position. For each satellite a filter of one state

    V <- min(V + max(L_before - L, 0) + 2 L dt / tau, L)             r, V = 0, L of a fresh one
    nu = mean of its system's z less z_k,   R = c (w + u P u^T),   c = max(1, 2 T / dt)
    K = f V / (f^2 V + R),   r <- r + K nu,   V <- (1 - K f) V,   f = 1 - its weight in the mean

z_k is the filter's prediction minus the range with r subtracted, so that nu is the error of r; w
the variance of errors that do not last, u P u^T that of the position; T the correlation time of
multipath, tau that of orbit errors. r is subtracted from the range, and V replaces L in its
variance. So a satellite that remains alone keeps the information that it had among others. L falls
as its two carriers determine the delay, since that changes e_k. Innovations beyond three sigma are
excluded, also from the mean, the largest first.

Source: Groves, 2nd edition, 3.2 and 9.4.4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fusiond.gnss import range_kernel as rk
from fusiond.gnss.carrier_phase import MULTIPATH_S, SLOTS
from fusiond.gnss.ranges import Rows
from fusiond.navigation.compiled import compiled

Array = npt.NDArray[np.float64]

LASTS_S = 1800.0
"""Correlation time of orbit errors, as of `bias_correlation_s`."""
EVERY_S = 0.9
"""Interval of the innovations that are used: multipath makes closer ones repeat the same error."""
FORGOTTEN_S = 300.0
"""Time after which a satellite is treated as new; street corners hide it for less."""
SIGMAS = 3.0
# Columns of a satellite's slot: r (m), V and L (m^2), and when it was last seen (GPS time, s; 0:
# never). Slot 0, which no satellite has: when levels were last learned.
COLUMNS = 4
_OFFSET, _VARIANCE, _PRIOR, _T = range(COLUMNS)


@compiled("void(f8[:, ::1], f8[:, ::1], f8, f8[::1], f8[::1])")
def _expect(levels: Array, values: Array, t_s: float, offset: Array, variance: Array) -> None:
    """Write r (n,) and V (n,) for the rows in `values` at `t_s`, and subtract them."""
    for k in range(offset.shape[0]):
        known = levels[int(values[rk.SLOT, k])]
        prior = values[rk.LASTING, k]
        offset[k], variance[k] = 0.0, prior
        since = t_s - known[_T]
        if known[_T] > 0.0 and 0.0 <= since <= FORGOTTEN_S:
            more = max(known[_PRIOR] - prior, 0.0) + 2.0 * prior * since / LASTS_S
            offset[k], variance[k] = known[_OFFSET], min(known[_VARIANCE] + more, prior)
        values[rk.CORRECTED, k] -= offset[k]
        values[rk.VARIANCE, k] += variance[k] - prior


@compiled(
    "void(f8[:, ::1], f8[:, ::1], i8[::1], f8, f8[::1], f8[::1], f8[::1], f8[::1])",
    allocates=True,
)
def _learn(
    levels: Array,
    values: Array,
    clock: npt.NDArray[np.int64],
    t_s: float,
    offset: Array,
    variance: Array,
    z: Array,
    place: Array,
) -> None:
    """Store r and V of rows, after an update by innovations z (n,), if any, with the position's
    variances `place` (n,)."""
    n = clock.shape[0]
    for k in range(n):
        known = levels[int(values[rk.SLOT, k])]
        known[_OFFSET], known[_VARIANCE] = offset[k], variance[k]
        known[_PRIOR], known[_T] = values[rk.LASTING, k], t_s
    if z.shape[0] != n or n == 0:
        return
    span = t_s - levels[0, _T] if levels[0, _T] > 0.0 else 0.0
    times = max(1.0, 2.0 * MULTIPATH_S / max(span, EVERY_S))
    levels[0, _T] = t_s
    fits = np.ones(n, np.bool_)
    for system in range(3):
        total, mean, many, worst = 0.0, 0.0, 0, 0
        while worst >= 0:  # exclude the farthest one first, because it shifts the mean
            total, mean, many, worst = 0.0, 0.0, 0, -1
            for k in range(n):
                if clock[k] == system and fits[k]:
                    w = 1.0 / (values[rk.VARIANCE, k] + place[k])
                    total += w
                    mean += w * z[k]
                    many += 1
            if many < 2:
                break
            mean /= total
            most = SIGMAS * SIGMAS
            for k in range(n):
                if clock[k] == system and fits[k]:
                    nu = mean - z[k]
                    square = nu * nu / (values[rk.VARIANCE, k] + place[k])
                    if square > most:
                        worst, most = k, square
            if worst >= 0:
                fits[worst] = False
        for k in range(n):
            if many < 2 or clock[k] != system or not fits[k]:
                continue
            spread = values[rk.VARIANCE, k] + place[k]
            f = 1.0 - 1.0 / (spread * total)
            gain = f * variance[k]
            gain /= f * gain + times * max(spread - variance[k], 0.0)
            known = levels[int(values[rk.SLOT, k])]
            known[_OFFSET] = offset[k] + gain * (mean - z[k])
            known[_VARIANCE] = (1.0 - gain * f) * variance[k]


_NONE = np.zeros(0)


class RangeBiases(NamedTuple):
    """Epoch at `t_s`: levels (SLOTS, 4) before it, r and V (n,) of its `rows`, and the filter's
    data `seen` by its measurement, z and the position's variances (n,), for the update of the
    levels."""

    t_s: float
    before: Array
    rows: Rows
    offset: Array
    variance: Array
    seen: list[tuple[Array, Array]] | None

    def after(self) -> Array:
        """Levels after the epoch, once the filter has processed it."""
        found = self.before.copy()
        z, place = self.seen[0] if self.seen else (_NONE, _NONE)
        of = self.offset, self.variance
        _learn(found, self.rows.values, self.rows.clock, self.t_s, *of, z, place)
        return found


def subtract_biases(last: RangeBiases | None, rows: Rows, t_s: float) -> RangeBiases:
    """Subtract the levels from an epoch's rows; the variances keep the unknown part."""
    before = np.zeros((SLOTS, COLUMNS)) if last is None else last.after()
    n = len(rows.satellites)
    offset, variance = np.empty(n), np.empty(n)
    _expect(before, rows.values, t_s, offset, variance)
    teaches = abs(t_s - before.item(_T)) >= EVERY_S
    return RangeBiases(t_s, before, rows, offset, variance, [] if teaches else None)
