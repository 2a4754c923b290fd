r"""Single-axis INS error filter aided by positions: the smallest one with INS drift.

    p' = v,   v' = a + w_v,   a' = w_a,   z = p + e,   var e = R

p (m), v (m/s) position and velocity error, a (m/s2) gravity through the tilt; w_v velocity random
walk, w_a = g times angle random walk. North and east are alike and independent. The gain is the
steady one. A fault changes the truth, never the filter; a delay off by tau adds tau times the
vehicle's velocity to z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AidedAxis:
    """A level INS axis aided by positions of `sigma_m` every `period_s`."""

    name: str
    period_s: float
    sigma_m: float
    velocity_walk: float = 0.1 / 60.0
    """m/s per sqrt(s)."""
    angle_walk: float = math.radians(0.3) / 60.0
    """rad per sqrt(s)."""


@dataclass(frozen=True, slots=True)
class Fault:
    """Difference of the truth from the filter's assumptions."""

    name: str
    q: float = 1.0
    r: float = 1.0
    correlation: float = 0.0
    """Correlation of successive measurement errors, a first-order Gauss-Markov sequence."""
    delay_s: float = 0.0


def _discrete(source: AidedAxis) -> tuple[Array, Array]:
    """Transition and process noise (3, 3) of one axis over one period."""
    t, v, a = (
        source.period_s,
        source.velocity_walk**2,
        (STANDARD_GRAVITY_M_S2 * source.angle_walk) ** 2,
    )
    phi = np.array([[1.0, t, t * t / 2.0], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
    walk = np.array([[t**3 / 3.0, t**2 / 2.0, 0.0], [t**2 / 2.0, t, 0.0], [0.0, 0.0, 0.0]])
    tilt = np.array(
        [
            [t**5 / 20.0, t**4 / 8.0, t**3 / 6.0],
            [t**4 / 8.0, t**3 / 3.0, t**2 / 2.0],
            [t**3 / 6.0, t**2 / 2.0, t],
        ]
    )
    return phi, v * walk + a * tilt


def town_drive(t_s: Array) -> Array:
    """Velocity north and east (..., 2) in m/s at times (...): 15 m/s through a town, a turn of
    90 deg every 45 s, a stop of 20 s every 200 s.
    """
    fine = np.arange(0.0, float(t_s.max()) + 0.1, 0.1)
    speed = np.interp(fine % 200.0, [0.0, 20.0, 27.5, 192.5, 200.0], [0.0, 0.0, 15.0, 15.0, 0.0])
    turning = (fine % 45.0 < 6.0) & (speed > 0.0)
    heading = np.cumsum(turning) * 0.1 * math.pi / 12.0
    velocity = np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=-1)
    return np.asarray(velocity[np.rint(t_s * 10.0).astype(int)])


def innovations(
    source: AidedAxis, fault: Fault, runs: int, epochs: int, onset: int, rng: np.random.Generator
) -> Array:
    """Whitened innovations (runs, epochs, 2) of the settled filter; the fault holds from
    `onset`."""
    phi, q = _discrete(source)
    r = source.sigma_m**2
    cov = solve_discrete_are(phi.T, np.eye(3)[:, :1], q, [[r]])
    s = float(cov[0, 0]) + r
    gain = cov[:, 0] / s
    root_q = np.linalg.cholesky(q).T
    t = rng.uniform(0.0, 400.0, (runs, 1)) + np.arange(epochs) * source.period_s
    shift = fault.delay_s * town_drive(t)
    x = rng.standard_normal((runs, 2, 3)) @ np.linalg.cholesky(cov).T
    noise = rng.standard_normal((runs, 2))
    nu = np.empty((runs, epochs, 2))
    for k in range(epochs):
        on = k >= onset
        z = x[..., 0] + noise * (source.sigma_m * math.sqrt(fault.r if on else 1.0))
        if on:
            z = z + shift[:, k]
        nu[:, k] = z / math.sqrt(s)
        x = (x - z[..., None] * gain) @ phi.T
        x += rng.standard_normal((runs, 2, 3)) @ root_q * math.sqrt(fault.q if on else 1.0)
        c = fault.correlation if on else 0.0
        noise = c * noise + math.sqrt(1.0 - c * c) * rng.standard_normal((runs, 2))
    return nu
