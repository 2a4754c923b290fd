r"""Constant-velocity model with white acceleration noise, for a vehicle without an inertial unit.

    dr' = dv,   dv' = w,   w white with the density q = 2 s^2 tau

the limit, over times long against tau, of accelerations of sigma s as a first-order Markov process.
Six states, north-east-down, and the blocks of the measurements; no attitude. It runs in the kernels
of inertial navigation, on samples of a level vehicle that faces north under gravity alone
(fusiond.navigator.without_imu).

Source: Bar-Shalom, Li, Kirubarajan (2001), section 6.2.2 (white noise acceleration model); paper
004, experiments 3 and 4.
"""

from __future__ import annotations

from collections.abc import Sequence

from fusiond.models.blocks import Block
from fusiond.models.model import Model

NAME = "constant_velocity"


def constant_velocity(manoeuvre: tuple[float, float, float], extra: Sequence[Block] = ()) -> Model:
    """Model with acceleration sigmas (m/s^2), horizontal and vertical, of a correlation time (s),
    and further blocks of its measurements."""
    level, vertical, lasts_s = manoeuvre
    return Model(
        NAME,
        (
            Block("velocity", "m/s", ("n", "e"), (3, 4), white=2.0 * level**2 * lasts_s),
            Block("velocity_down", "m/s", ("d",), (5,), white=2.0 * vertical**2 * lasts_s),
            Block("position", "m", ("n", "e", "d"), (6, 7, 8)),
            *extra,
        ),
    )
