r"""Horizontal position of a BeiDou RDSS terminal's antenna: delayed, with correlated errors.

    z = [ (phi^ - phi) (R_M + h), (lambda^ - lambda) (R_N + h) cos phi ] + C l - b
      = dr + (C l) x phi - b + v,   cov(v) = R (2, 2)

b is an error that successive fixes share (height model, delays): a first-order Gauss-Markov pair of
the error state if the model has the block `BIAS_BLOCK`, else zero. R has a correlation between
north and east, so the rows are whitened by its Cholesky factor. A timing error s_t adds v v^T s_t^2
to R.

Strategies for a delayed fix:

`rewind`                 at its own instant; everything after it runs again.
`optimal_prediction`     at its own instant, but not fed back there: the error estimate x(k|k) and P
                         are predicted to the instant of arrival, and x(k+1|k) is fed back
                         (paper 000, section 1.1). `HeldFeedback` marks that instant.
`position_compensation`  at its arrival, moved forward by the computed velocity times the delay;
                         what that leaves is the coloured noise b (paper 000, reference 2).
`none`                   at its arrival, as if it were true then.

Source: paper 000, eq. 2 to 4.
"""

from __future__ import annotations

import math
from dataclasses import replace
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np

from drivers.immutable import immutable
from fusiond.aiding.base import (
    AidingMeasurement,
    Feedback,
    Innovation,
    NotApplicable,
    State,
    Vector3,
    level_arm_m,
)
from fusiond.aiding.heading_history import HeadingHistory
from fusiond.aiding.initialisation_candidates import PositionCandidate
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.rotation import skew
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, VN

BIAS_BLOCK = "rdss_bias"


@immutable()
class RdssPositionMeasurement(AidingMeasurement):
    """Fix (rad, rad) with `covariance` (nn, ne, ee) in m^2.

    `moved_s`: time by which the fix is moved with the computed velocity (position compensation).
    `holds`: the estimate is not fed back until a `HeldFeedback` comes (optimal prediction).
    """

    locates: ClassVar[bool] = True
    shown: ClassVar[attrgetter[Any] | None] = attrgetter("lat_rad", "lon_rad")
    delayed: ClassVar[bool] = True
    waits: ClassVar[bool] = True

    lat_rad: float
    lon_rad: float
    covariance: Vector3
    lever: Vector3
    sd_time_s: float = 0.0
    moved_s: float = 0.0
    holds: bool = False

    @property
    def shares(self) -> tuple[str, ...]:
        return (BIAS_BLOCK,)

    @property
    def feedback(self) -> Feedback:
        return "hold" if self.holds else "at_once"

    def without_attitude(self, way: HeadingHistory) -> RdssPositionMeasurement:
        (nn, ne, ee), arm = self.covariance, level_arm_m(self.lever)
        wider = nn + arm * arm, ne, ee + arm * arm
        return replace(self, covariance=wider, lever=(0.0, 0.0, self.lever[2]))

    def innovation(self, state: State) -> Innovation | NotApplicable:
        nav = state.nav
        lever = state.dcm @ np.array(self.lever)
        v = nav[VN : VN + 2]
        east = nav[LON] - self.lon_rad
        east -= 2.0 * math.pi * round(east / (2.0 * math.pi))
        z = lever[:2] - v * self.moved_s
        z[0] += (nav[LAT] - self.lat_rad) * (meridian_radius(nav[LAT]) + nav[HEIGHT])
        z[1] += east * (transverse_radius(nav[LAT]) + nav[HEIGHT]) * math.cos(nav[LAT])
        h = np.zeros((2, state.model.size))
        h[0, 6] = h[1, 7] = 1.0
        h[:, 0:3] = skew(lever)[:2]
        h[0, 3] = h[1, 4] = -self.moved_s
        for row, slot in enumerate(state.model.slots_of(BIAS_BLOCK)):
            h[row, slot] = -1.0
            z[row] += state.xi[slot]
        # By the factor of R, [sd_n 0; k sd_e].
        (nn, ne, ee), (v_n, v_e) = self.covariance, (self.sd_time_s * v).tolist()
        sd_n = math.sqrt(nn + v_n * v_n)
        k = (ne + v_n * v_e) / sd_n
        sd_e = math.sqrt(ee + v_e * v_e - k * k)
        for rows in (z, h):
            rows[0] /= sd_n
            rows[1] -= k * rows[0]
            rows[1] /= sd_e
        return Innovation(z, h, np.ones(2))

    def candidates(self) -> tuple[PositionCandidate, ...]:
        """Fix without its height, which is a measurement of its own where believed."""
        sd_n, sd_e = math.sqrt(self.covariance[0]), math.sqrt(self.covariance[2])
        place = self.lat_rad, self.lon_rad, None
        return (PositionCandidate(self.t_ns, *place, (sd_n, sd_e, sd_n), self.lever),)


@immutable()
class HeldFeedback(AidingMeasurement):
    """Instant at which a held estimate is fed back."""

    waits: ClassVar[bool] = True

    @property
    def feedback(self) -> Feedback:
        return "release"

    def without_attitude(self, way: HeadingHistory) -> HeldFeedback:
        return self

    def innovation(self, state: State) -> Innovation | NotApplicable:
        return NotApplicable("fed_back")
