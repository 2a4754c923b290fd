"""Corrections of the tilt: no alarm while they fit P, an alarm when the axes tilt by themselves."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.integrity.tilt import Tilting, remember, too_far
from fusiond.navigation.rotation import quaternion_from_rpy, rotation_vector_to_quaternion
from fusiond.navigation.strapdown import Q0

Array = NDArray[np.float64]

S = 1_000_000_000
EVERY_S = 0.2
WALK_RAD, MEASURED_RAD = 2e-5, 1e-3
"""Of the tilt in an interval, and of what measures it, one sigma."""


def multiplied(a: Array, b: Array) -> Array:
    """The quaternion of first `b`, then `a`."""
    w, v, x, u = a[0], a[1:], b[0], b[1:]
    return np.concatenate(([w * x - v @ u], w * u + x * v + np.cross(v, u)))


class Level:
    """A filter of the tilt alone, which is measured; `rate` (rad/s) is what it does not know."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.p = np.eye(2) * MEASURED_RAD**2
        self.error = MEASURED_RAD * self.rng.standard_normal(2)
        self.q = quaternion_from_rpy(0.05, -0.1, 2.0)
        self.t_ns = 0
        self.tilting = Tilting()

    @property
    def nav(self) -> Array:
        """Navigation state (10,), of which the attitude alone counts."""
        return np.concatenate((np.zeros(Q0), self.q))

    def run(self, seconds: float, rate: tuple[float, float] = (0.0, 0.0)) -> float | None:
        """Seconds until the corrections go too far; None if they do not."""
        for k in range(round(seconds / EVERY_S)):
            self.t_ns += round(EVERY_S * S)
            self.error += WALK_RAD * self.rng.standard_normal(2) + EVERY_S * np.array(rate)
            self.p = self.p + np.eye(2) * WALK_RAD**2
            remember(self.nav, self.p, self.tilting.before)
            gain = self.p @ np.linalg.inv(self.p + np.eye(2) * MEASURED_RAD**2)
            d = -gain @ (self.error + MEASURED_RAD * self.rng.standard_normal(2))
            self.error += d
            turn = np.array(rotation_vector_to_quaternion(float(d[0]), float(d[1]), 0.0))
            self.q = multiplied(turn, self.q)
            self.p = (np.eye(2) - gain) @ self.p
            sums, before = self.tilting.sums, self.tilting.before
            if too_far(sums, self.t_ns, before, self.nav, self.p, 0.0):
                return (k + 1) * EVERY_S
        return None


def test_corrections_that_fit_their_covariance_raise_no_alarm_in_half_an_hour() -> None:
    level = Level(5)
    assert level.run(1800.0) is None


def test_axes_that_tilt_by_themselves_are_noticed() -> None:
    """0.02 and 0.05 deg/s: 0.1 to 0.3 deg by then, where P says 0.008."""
    for seed in range(5):
        slow, fast = Level(seed), Level(seed)
        assert slow.run(60.0) is fast.run(60.0) is None
        after_s = slow.run(60.0, (math.radians(0.02), 0.0))
        assert after_s is not None
        sooner_s = fast.run(60.0, (0.0, -math.radians(0.05)))
        assert sooner_s is not None
        assert sooner_s <= after_s <= 15.0
        assert sooner_s <= 6.0


def test_a_heading_that_is_corrected_tilts_nothing() -> None:
    """P's axes turn with it by 2 deg an update; of the two, one is known ten times better."""
    rng, tilting, q = np.random.default_rng(7), Tilting(), quaternion_from_rpy(0.0, 0.0, 2.0)
    p = np.diag([1e-2, 1e-3]) ** 2
    for k in range(300):
        nav = np.concatenate((np.zeros(Q0), q))
        remember(nav, p, tilting.before)
        share = 0.01
        d = np.linalg.cholesky(share * p) @ rng.standard_normal(2)
        psi = math.radians(2.0) * rng.standard_normal()
        turn = np.array(rotation_vector_to_quaternion(float(d[0]), float(d[1]), 0.0))
        about = np.array(rotation_vector_to_quaternion(0.0, 0.0, psi))
        q = multiplied(about, multiplied(turn, np.array(q)))
        c, s = math.cos(psi), math.sin(psi)
        axes = np.array([[c, -s], [s, c]])
        p = axes @ ((1.0 - share) * p) @ axes.T
        nav = np.concatenate((np.zeros(Q0), q))
        assert not too_far(tilting.sums, k * S // 5, tilting.before, nav, p, psi)
        p = p / (1.0 - share)
