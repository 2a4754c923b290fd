r"""Least-squares position, velocity and clocks from a single epoch.

    y - rho(x) = H [dr, b, n] + noise,   H = [-l, clock columns, S],   n ~ N(0, I)
    dx = N^-1 H^T W (y - rho),   N = H^T W H + diag(0, .., 0, 1, 1, 1)

l (n, 3) are lines of sight; there is one clock offset for each present system; W = 1 / sigma^2. S n
is the residual of ionosphere and troposphere common to the whole sky, and BeiDou-2's offset, with
their sigmas as priors (`fusiond.gnss.ranges.Rows.common`). The iteration starts at the earth's
centre if no position is known, and ends with a step under 1 mm. The rates give velocity and one
drift in the same way. Residual test: the sum of squares over sigma^2, and |n|^2, against chi^2 with
as many degrees of freedom as there are rows more than positions and clocks; while it fails, the row
with the largest normalised residual

    w_k = r_k / sqrt(S_kk),   S = W^-1 - H N^-1 H^T

is removed (`residual`), as long as more rows than unknowns remain.

Dilution of precision, from Q = (H^T H)^-1 with position in north-east-down:

    HDOP^2 = q_nn + q_ee,  VDOP^2 = q_dd,  PDOP^2 = HDOP^2 + VDOP^2
    TDOP^2 = sum of the clocks' q,  GDOP^2 = PDOP^2 + TDOP^2

With several clocks TDOP includes all of them, so that GDOP^2 is still the trace of Q.

Source: Groves, 2nd edition, 9.4.1 and 9.4.3, residual test 17.4; Baarda, A Testing Procedure
for Use in Geodetic Networks (1968), whose level of 0.001 is kept.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from drivers.raw.messages import SYSTEMS, RawGnssEpoch
from fusiond.gnss.ecef import ned_axes, to_geodetic
from fusiond.gnss.ranges import RangeModel, Rows, TrackedSignals
from fusiond.navigation.chi_square import quantile

Array = npt.NDArray[np.float64]

FALSE_ALARM = 0.001
MAX_ITERATIONS = 12
STEP_M = 1e-3
MAX_CONDITION = 1e5
"""Largest condition number of H: GDOP over about 1e4, where 1 m of range is 10 km."""


class Dops(NamedTuple):
    """Dilutions of precision, without unit."""

    gdop: float
    pdop: float
    hdop: float
    vdop: float
    tdop: float


class SinglePoint(NamedTuple):
    """`position` (3,) ECEF m with `covariance` (3, 3) m^2; `clock_m` by system letter;
    `velocity` (3,) ECEF m/s with `velocity_covariance` (3, 3) (m/s)^2 and `drift_m_s`, None without
    enough rates;
    `rows` those used; `refused` pairs of satellite and reason;
    `statistic` of the residual test against `bound` with `redundancy` degrees of freedom."""

    position: Array
    covariance: Array
    clock_m: dict[str, float]
    velocity: Array | None
    velocity_covariance: Array | None
    drift_m_s: float | None
    dops: Dops
    rows: Rows
    refused: tuple[tuple[str, str], ...]
    statistic: float
    bound: float
    redundancy: int

    @property
    def consistent(self) -> bool:
        """True if the residual test passes, or if there is no redundancy to test."""
        return self.redundancy == 0 or self.statistic <= self.bound


def design(line_of_sight: Array, system: npt.NDArray[np.intp]) -> tuple[Array, list[int]]:
    """Design matrix H (n, 3 + clocks) of position and clocks, and the system index of each
    clock."""
    present = sorted(set(system.tolist()))
    h = np.zeros((len(system), 3 + len(present)))
    h[:, :3] = -line_of_sight
    for j, s in enumerate(present):
        h[:, 3 + j] = system == s
    return h, present


def dops(line_of_sight: Array, system: npt.NDArray[np.intp], receiver: Array) -> Dops | None:
    """DOPs of lines of sight (n, 3) in ECEF with one clock per system; None if not observable."""
    h, _ = design(line_of_sight, system)
    lat, lon, _ = to_geodetic(float(receiver[0]), float(receiver[1]), float(receiver[2]))
    h[:, :3] = h[:, :3] @ ned_axes(lat, lon)
    if len(h) < h.shape[1] or np.linalg.cond(h) > MAX_CONDITION:
        return None
    q = np.diag(np.linalg.inv(h.T @ h))
    return Dops(*np.sqrt([q.sum(), q[:3].sum(), q[:2].sum(), q[2], q[3:].sum()]).tolist())


class _Fit(NamedTuple):
    position: Array
    clocks: Array
    common: Array
    rows: Rows
    h: Array
    systems: list[int]
    covariance: Array
    residual: Array


def single_point(
    model: RangeModel, epoch: RawGnssEpoch | TrackedSignals, guess: Array | None = None
) -> SinglePoint | str:
    """Solve one epoch; returns `too_few`, `geometry` or `diverged` without a solution.

    `guess` (3,) ECEF m: approximate position of the receiver.
    """
    followed = epoch if isinstance(epoch, TrackedSignals) else model.followed(epoch)
    position = np.zeros(3) if guess is None else np.array(guess, float)
    out: list[str] = []
    while True:
        fit = _fit(model, followed, position, out)
        if isinstance(fit, str):
            return fit
        position, rows = fit.position, fit.rows
        n, m = len(fit.h), fit.h.shape[1] - len(fit.common)
        statistic = float(fit.residual**2 @ (1.0 / rows.variance)) + float(fit.common @ fit.common)
        bound = quantile(n - m, FALSE_ALARM) if n > m else 0.0
        if n - m < 2 or statistic <= bound:
            break
        spread = rows.variance - np.einsum("ij,jk,ik->i", fit.h, fit.covariance, fit.h)
        w = np.abs(fit.residual) / np.sqrt(np.maximum(spread, 1e-6 * rows.variance))
        out.append(rows.satellites[int(np.argmax(w))])
    quality = dops(rows.line_of_sight, rows.system, position)
    if quality is None:
        return "geometry"
    velocity, velocity_covariance, drift = _velocity(rows)
    return SinglePoint(
        position,
        fit.covariance[:3, :3],
        {SYSTEMS[s]: float(c) for s, c in zip(fit.systems, fit.clocks, strict=True)},
        velocity,
        velocity_covariance,
        drift,
        quality,
        rows,
        rows.refused + tuple((s, "residual") for s in out),
        statistic,
        bound,
        n - m,
    )


def _fit(
    model: RangeModel, followed: TrackedSignals, position: Array, out: list[str]
) -> _Fit | str:
    """Gauss-Newton from `position`, without the satellites in `out`."""
    for _ in range(MAX_ITERATIONS):
        rows = model.evaluate(followed, position)
        if out:
            rows = rows.without(out)
        h, systems = design(rows.line_of_sight, rows.system)
        n, m = h.shape
        if n < m or m == 3:
            return "too_few"
        if np.linalg.cond(h) > MAX_CONDITION:
            return "geometry"
        weight = 1.0 / rows.variance
        h = np.column_stack([h, rows.common])
        normal: Array = h.T @ (h * weight[:, None])
        normal[range(m, h.shape[1]), range(m, h.shape[1])] += 1.0
        covariance = np.asarray(np.linalg.inv(normal), np.float64)
        y = rows.pseudorange_m - rows.range_m
        x = covariance @ (h.T @ (weight * y))
        position = position + x[:3]
        if np.abs(x[:3]).max() < STEP_M:
            residual: Array = y - h @ x
            return _Fit(position, x[3:m], x[m:], rows, h, systems, covariance, residual)
    return "diverged"


def _velocity(rows: Rows) -> tuple[Array | None, Array | None, float | None]:
    """Velocity (3,) ECEF m/s, its covariance and drift m/s, from the rows with a rate."""
    has = np.isfinite(rows.rate_m_s)
    if has.sum() < 4:
        return None, None, None
    los = rows.line_of_sight[has]
    h = np.column_stack([-los, np.ones(len(los))])
    if np.linalg.cond(h) > MAX_CONDITION:
        return None, None, None
    y = rows.rate_m_s[has] - np.einsum("ij,ij->i", los, rows.velocity[has])
    weight = 1.0 / rows.rate_variance[has]
    covariance = np.asarray(np.linalg.inv(h.T @ (h * weight[:, None])), np.float64)
    x = covariance @ (h.T @ (weight * y))
    return x[:3], covariance[:3, :3], float(x[3])
