r"""Compiled kernel: propagation of covariances over several accumulated samples at once.

The transition of a sample is linear in C_nb, the force in navigation axes, and rate and force in
body axes (fusiond.navigation.error_model). So to first order the transition over H seconds is that
of the means,

    sum h = H,   sum h (f_n, w_b, f_b, C_nb) / H,   sum h n / H  (the noise n of each sample)

and the second order (velocity from a gyro, position from a tilt) follows from the three steps that
cross an interval. The neglected term is the change of rate and force within H times their effect
within H, a fraction of one crossing, of either sign: over a drive with bends and stops it changes a
sigma by 1e-4 at most (tests/estimators/test_multi_sample_covariance.py).

Covariances are propagated at the first sample beyond each multiple of `GRID_NS`, independent of the
calls; before an update; and around samples that are not part of a mean: a gap, an interval at rest,
and each sample if errors or a transition are propagated. P may be read between two of these
instants: covariances are then ahead of the sums, and the earlier ones are stored (`HELD`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.covariance_propagation import covariance_for
from fusiond.estimators.tilt_axes_propagation import rest_axes, turn_down, turn_tilt
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE, coefficients
from fusiond.navigation.strapdown import STEP_DCM, STEP_SMOOTH_N, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

GRID_NS = 20_000_000
"""Length of a block: a vehicle that turns by 1 rad/s turns by 3 deg in it."""

SPAN, STEPS, DENSITIES = 0, 1, 1 + STEP_SMOOTH_N
SUMS = DENSITIES + 6
"""Sums over an interval: seconds; the means of what a step leaves up to C_nb (18,), and of the
noise of the samples (6,)."""

# What the vehicle may do while the IMU is silent, one sigma of the mean rate (rad/s) and force
# (m/s^2) against the sample that is held: a car that turns or brakes at a comfortable limit. Real
# drives showed up to 0.09 rad/s (pitch, an engine that shakes the IMU) and 0.12 rad/s (yaw, 4 s in
# town) and 0.4 to 0.8 m/s^2 RMS over silences of 0.05 to 4 s, with single ones of four times that.
GAP_RATE_RAD_S = 0.1
GAP_FORCE_M_S2 = 1.0


@compiled("void(f8[::1], f8[::1], f8, f8[::1], i8)", forceinline=True)
def add_up(sums: Array, step: Array, h: float, densities: Array, row: int) -> None:
    """Add a step (28,) of h seconds, with noise of a row of `densities` (6 m,)."""
    sums[SPAN] += h
    share = h / sums[SPAN]
    if share == 1.0:  # the first
        for j in range(STEP_SMOOTH_N):
            sums[STEPS + j] = step[j]
        for j in range(6):
            sums[DENSITIES + j] = densities[6 * row + j]
        return
    for j in range(STEP_SMOOTH_N):
        sums[STEPS + j] += share * (step[j] - sums[STEPS + j])
    for j in range(6):
        sums[DENSITIES + j] += share * (densities[6 * row + j] - sums[DENSITIES + j])


@compiled("void(f8[::1], i8, b1[::1], f8[::1], f8, f8)", forceinline=True)
def widen_for_gap(
    cov: Array, width: int, active: NDArray[np.bool_], nav: Array, whole: float, h: float
) -> None:
    """Add to `cov`, flat and of `width` rows, the uncertainty of h seconds in an IMU silence of
    `whole` seconds.

    The velocity of a turning vehicle turns with it, dv = v x dphi, and its position by half of that
    a second. Without this correlation the no-slip constraint would take the velocity as evidence of
    the heading.
    """
    turned = GAP_RATE_RAD_S**2 * whole * h
    n, e, d = nav[VN], nav[VN + 1], nav[VN + 2]
    across = ((0.0, -d, e), (d, 0.0, -n), (-e, n, 0.0))
    for i in range(3):
        for j in range(3):
            both = 0.0  # of (v x dphi) with itself
            for k in range(3):
                both += across[i][k] * across[j][k]
            for r, c, q in (
                (i, j, 1.0 if i == j else 0.0),
                (3 + i, j, across[i][j]),
                (i, 3 + j, across[j][i]),
                (3 + i, 3 + j, both),
                (6 + i, j, 0.5 * whole * across[i][j]),
                (i, 6 + j, 0.5 * whole * across[j][i]),
                (6 + i, 3 + j, 0.5 * whole * both),
                (3 + i, 6 + j, 0.5 * whole * both),
                (6 + i, 6 + j, 0.25 * whole * whole * both),
            ):
                if active[r] and active[c]:
                    cov[r * width + c] += q * turned
    for r in range(3, CORE_SIZE):
        if active[r]:
            q = GAP_FORCE_M_S2**2 * whole * h
            cov[r * width + r] += q if r < 6 else 0.25 * q * whole * whole


@compiled("void(f8[::1], i8, b1[::1], f8[::1], f8[::1], i8, f8)", forceinline=True)
def shake(
    cov: Array,
    width: int,
    active: NDArray[np.bool_],
    step: Array,
    densities: Array,
    row: int,
    h: float,
) -> None:
    """Add to `cov`, flat and of `width` rows, C diag(n) C^T h: noise of a row of `densities` (6
    m,), body axes, over h seconds."""
    for first in (0, 3):
        at = 6 * row + first
        if densities[at] + densities[at + 1] + densities[at + 2] == 0.0:
            continue
        for i in range(3):
            for j in range(3):
                if active[first + i] and active[first + j]:
                    total = 0.0
                    for k in range(3):
                        a, b = step[STEP_DCM + 3 * i + k], step[STEP_DCM + 3 * j + k]
                        total += a * b * densities[at + k]
                    cov[(first + i) * width + first + j] += h * total


@cache
def cross_for(width: int) -> Callable[..., None]:
    """`cross` for covariances of `width` rows."""
    propagate_covariance, square = covariance_for(width), width * width

    @compiled(
        "void(b1, b1, f8, b1, f8[::1], f8[::1], i8, f8[::1], f8[::1], f8[::1], f8[::1],"
        " f8[::1], b1, b1[::1], i8[::1], i8[::1], f8[::1], f8[::1])",
        variant=width,
    )
    def cross(
        ahead: bool,
        keep: bool,
        silence: float,
        rests: bool,
        covs: Array,
        held: Array,
        used: int,
        shares: Array,
        nav: Array,
        sums: Array,
        c: Array,
        turn: Array,
        turning: bool,
        active: NDArray[np.bool_],
        sensor_terms: Indices,
        rate_terms: Indices,
        noise: Array,
        work: Array,
    ) -> None:
        """Propagate the first `used` of the covariances, `covs` flat, over the interval of `sums`
        (25,) to `nav` (10,); write its coefficients `c` (58,).

        They start from `held` if they are `ahead`, and are stored there if they are to be kept;
        otherwise the sums restart. `silence` (s): of the IMU, including the sums, or 0; `turn` (5,)
        if the vehicle `rests`; `turning`: an unknown turn rotates the axes of a tilt.
        """
        whole = used * square
        if ahead:
            for j in range(whole):
                covs[j] = held[j]
        elif keep:
            for j in range(whole):
                held[j] = covs[j]
        h, mean, shaken = sums[SPAN], sums[STEPS:DENSITIES], sums[DENSITIES:]
        coefficients(nav, mean, h, c)
        n = noise.shape[0] // 3
        sensor_slot, sensor_kind = sensor_terms[:12], sensor_terms[12:]
        for k in range(used):
            cov, q = covs[k * square : (k + 1) * square], 1.0 / shares[k]
            known = cov[2 * width + 2]
            north, east = cov[0], cov[width + 1]
            # Half of the noise before, half after, as there.
            shake(cov, width, active, mean, shaken, 0, 0.5 * h * q)
            propagate_covariance(cov, mean, c, h, active, sensor_terms, rate_terms, noise, q, work)
            shake(cov, width, active, mean, shaken, 0, 0.5 * h * q)
            if silence > 0.0:
                widen_for_gap(cov, width, active, nav, silence, h * q)
            if rests:
                rest_axes(cov, width, n, turn, sensor_slot, sensor_kind)
            elif turning:
                grown_north, grown_east = cov[0] - north, cov[width + 1] - east
                turn_tilt(cov, width, known)
                turn_down(cov, width, mean, sensor_slot, sensor_kind, grown_north, grown_east)
        if not keep:
            sums[SPAN] = 0.0

    return cross
