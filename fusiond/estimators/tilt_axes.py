r"""The axes in which a tilt is known, when an update turns the heading.

Straight on at one speed, tilt and accelerometer bias are known by their sum alone, which moves the
vehicle: of a computed attitude C with a tilt t (rad, north and east) and a bias error b

    C b - g z x t = 0   to some 1e-3 m/s^2,   g t and b each to 0.1               z down

An update that turns C by psi about the vertical and leaves P's t in its axes says next

    R(psi) C b - g z x t = 0

as well, and both at once are true of b = 0 alone: each of the headings that a vehicle of poorly
known heading is taken to have tells some more of b, of which nothing was measured. On a straight,
with the heading known to 3 deg, tilt had shrunk to half its sigma after a minute and was 7.8 sigma
off. What an angle known to s_a makes of a bias known to s_b is another acceleration by s_a s_b, and
that counts once the sum is known as well: after a doubt of the motion, which leaves 0.5 m/s^2 in
each bias, a heading known to a degree is as poor as one of 5 deg is at a start. The error is one in
the axes that turn with the heading,

    C = R(psi) exp(t x) C^        (as in fusiond.estimators.invariant)

and its transform, once psi is taken out, is t <- R(psi) t, after which the first sum is the only
one. So with the down axis, which knows (C b)_D: a tilt that is corrected by dt puts dt b_x of
another bias there, and what is left of b_z is taken for what is left of (C b)_D,

    b_z <- ((C b)_D - C+_Dx b_x - C+_Dy b_y) / C+_Dz        C+ after the update

Both are of the second order, psi b and dt b.

Source: Solà, Quaternion kinematics for the error-state Kalman filter (2017), section 6.3, for the
transform of a covariance on reset; Huang, Mourikis, Roumeliotis, IJRR 29 (2010), 502, for what a
filter learns from linearising about headings that differ.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised
from fusiond.estimators.base import Outcome
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.model import Model
from fusiond.navigation.error_model import FORCE_ERROR, PHI
from fusiond.navigation.rotation import dcm_from_quaternion
from fusiond.navigation.strapdown import Q0

Array = NDArray[np.float64]

# Below this (m/s^2) of s_a s_b it is left: a receiver's velocities of 5 cm/s, two a second, show no
# slope of less within half a minute, and no update of a vehicle that knows its heading pays for it.
SLIGHT_M_S2 = 1e-3
# Cosine of the tilt beyond which no accelerometer is the vertical one.
UPRIGHT = 0.5


def heading_turn(before: Array, after: Array) -> float:
    """By how much (rad) about the vertical an attitude q_nb (4,) was turned to another."""
    w, x, y, z = before.tolist()
    to_w, to_x, to_y, to_z = after.tolist()
    along = w * to_w + x * to_x + y * to_y + z * to_z
    about = w * to_z - z * to_w + x * to_y - y * to_x
    return math.remainder(2.0 * math.atan2(about, along), 2.0 * math.pi)


def felt_kept(model: Model, before: Array, after: Array) -> Array:
    """T (n, n): as well as tilt and force biases together were known of the attitude q_nb (4,)
    `before`, they are of the one `after` with T P T^T."""
    psi = heading_turn(before, after)
    c, s = math.cos(psi), math.sin(psi)
    t = np.eye(model.size)
    t[PHI : PHI + 2, PHI : PHI + 2] = [[c, -s], [s, c]]
    down, new = dcm_from_quaternion(before)[2], dcm_from_quaternion(after)[2]
    vertical = model.parameters(FORCE_ERROR + 2)
    if vertical and abs(new[2]) >= UPRIGHT:
        share = (down - new) / new[2]
        for axis in range(3):
            t[vertical[0], model.parameters(FORCE_ERROR + axis)] += share[axis]
    return t


class TiltAxesFilter(KalmanEstimator):
    """The centralised filter, in whose P the axes of a tilt turn with a poorly known heading."""

    def __init__(self, model: Model, gap_s: float, shares: tuple[float, ...] = (1.0,)) -> None:
        super().__init__(model, gap_s, shares)
        self.turned = 0.0
        """By how much (rad) the last update turned the axes in which P has the tilt."""
        self._felt_by = [slot for axis in range(3) for slot in model.parameters(FORCE_ERROR + axis)]

    def update(self, aid: Linearised) -> Outcome:
        """Fold one aid in, or name why not."""
        self.turned = 0.0
        if self._holding or not self._poor:
            return self._fold_in(aid)
        before = self.nav[Q0:].copy()
        outcome = self._fold_in(aid)
        if outcome.name == "fused":
            self.turned = heading_turn(before, self.nav[Q0:])
            self._carry_over(felt_kept(self.model, before, self.nav[Q0:]))
        return outcome

    def release(self) -> None:
        """Feed back what was carried."""
        before, poor = self.nav[Q0:].copy(), self._poor
        super().release()
        if poor:
            self._carry_over(felt_kept(self.model, before, self.nav[Q0:]))

    @property
    def _poor(self) -> bool:
        """Whether an angle that is corrected makes much of what the biases may be."""
        variance = self._covs[0].diagonal().tolist()
        biases = [variance[slot] for slot in self._felt_by]
        return bool(biases) and max(variance[PHI : PHI + 3]) * max(biases) > SLIGHT_M_S2**2

    def _fold_in(self, aid: Linearised) -> Outcome:
        return super().update(aid)

    def _carry_over(self, t: Array) -> None:
        """An error e (n,) is T e from now on, T (n, n)."""
        self.covariance[:] = t @ self.covariance @ t.T
