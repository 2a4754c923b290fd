"""Initialisation candidates of measurements: position, velocity, speed, heading, height.

Input of the alignment (fusiond.navigator.alignment). `sd`: one sigma; `lever` (3,): from the IMU to
the measured point, body axes, m. `bias`, `time` and `rest` name the blocks of errors that all
measurements of the device share; row i of `bias_share`: displacement along axis i by each state of
`bias`; `markov_m`: metres of `markov` north and east.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

Vector3 = tuple[float, float, float]
Matrix3 = Sequence[Sequence[float]]
UNIT: Matrix3 = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
# Sigma (m/s) and time (s) of a speed that does not drift.
STEADY = (0.0, 1.0)


class PositionCandidate(NamedTuple):
    """Geodetic position (rad, rad, m above the ellipsoid), `sd` (m) north, east, down; None for an
    unknown height."""

    t_ns: int
    lat_rad: float
    lon_rad: float
    height_m: float | None
    sd: Vector3
    lever: Vector3
    bias: tuple[str, ...] = ()
    time: str = ""
    rest: str = ""
    bias_share: Matrix3 = UNIT
    markov: str = ""
    markov_m: float = 0.0


class VelocityCandidate(NamedTuple):
    """Velocity (m/s) with `sd`: north, east, and down where it was measured."""

    t_ns: int
    v_ned: tuple[float, ...]
    sd: tuple[float, ...]
    lever: Vector3 = (0.0, 0.0, 0.0)
    time: str = ""
    rest: str = ""


class SpeedCandidate(NamedTuple):
    """Speed (m/s) along the forward axis, or its magnitude, from a wheel. `rounding_sd_m_s` is the
    part of `sd_m_s` that is constant at a constant speed and does not average out. It also drifts,
    as a first-order process of that sigma (m/s) and time constant (s)."""

    t_ns: int
    speed_m_s: float
    sd_m_s: float
    rounding_sd_m_s: float = 0.0
    drifts: tuple[float, float] = STEADY


class HeadingCandidate(NamedTuple):
    """True heading (rad) of the body's forward axis; `how` names its origin.

    `own_sd_rad` is the independent part of sigma; `shared` the rest: blocks of the model with the
    change of heading by each of their states."""

    t_ns: int
    yaw_rad: float
    sd_rad: float
    how: str = "dual antenna"
    own_sd_rad: float = math.nan
    shared: tuple[tuple[str, tuple[float, ...]], ...] = ()


class HeightCandidate(NamedTuple):
    """Ellipsoidal height (m), for a position of the same measurement without one."""

    height_m: float
    sd_m: float


Candidate = (
    PositionCandidate | VelocityCandidate | SpeedCandidate | HeadingCandidate | HeightCandidate
)
