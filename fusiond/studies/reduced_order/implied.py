r"""Noises implied by table 2 of paper 002, which it does not print.

**By hand.** A level axis of the 23 states, seen by velocity: the tilt phi walks by the gyro's white
noise n, a constant bias b of the accelerometer hides behind it, and v is measured with the density
R (Kalman and Bucy's filter, steady state):

    phi' = w,  v' = g phi + b,  y = v + nu
    P_vv = sqrt(2) (g n)^(1/2) R^(3/4),   P_phi = sqrt(2) n^(3/2) R^(1/4) g^(-1/2) + (b / g)^2

Tilt and velocity of an axis give n and R of it. b is printed (20.6 arc seconds), and the two axes
say nothing of one another, but both give the same gyro: 0.104 deg/sqrt(h) (phi N, dV E) and 0.100
(phi E, dV N); R is 0.078 and 0.050 (m/s)/sqrt(Hz), as four satellites may see east and north.

Azimuth, seen by a radar of the density r^2, of a gyro that is n and that the filter takes for n':

    P = n r        of n' = n,             P = n r (x + 1 / x) / 2,   x = n' / n

A constant drift that has no state leaves drift r / n', 3 arc seconds. So the azimuth of the 17, 56
arc seconds where the 23 have 33 by the same radar, says that x is 5.6, or less with a
misalignment: to them the gyro's constants, which they have not either, are noise as the
accelerometers' biases are.

**By the flight.** The transitions and rows are the study's; only what is noise differs, in seven
numbers, found by least squares of the logarithms of eleven of the twelve printed figures, with the
level tilt and the velocity east of the 17 held within a tenth: azimuth and velocity north of the 17
come within a fifth (the flight's satellites and points are ours), the 23 within a sixth.

What no noise gives: the vertical velocity of the 17. A filter that takes an accelerometer without
noise for one of q errs by the root of q sqrt(R) / 2: 0.008 m/s beside level ones of 0.04 to 0.06
would want satellites that see the vertical ten times better than the level.

What cannot be told: which of these noises the authors had. `OTHER`, with rates beside the ranges
and a radar of half again the noise and half the misalignment, makes the 23 states' figures as well.
Of the seven, least squares leaves the rates open altogether (a singular value of 2e-4 beside 0.4 to
1.3): where ranges hold the velocity, rates of any noise do.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.models.blocks import SAR_MISALIGNMENT
from fusiond.models.model import Model
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.studies.covariance_analysis import System, analyse
from fusiond.studies.reduced_order import flight
from fusiond.studies.reduced_order.report import PAPER, sigmas

Array = NDArray[np.float64]

ROOT_HOUR = 60.0
GYRO_DEG_SQRT_H, OTHER_GYRO_DEG_SQRT_H = 0.127, 0.112
"""Gyro noise (deg/sqrt(h)) of `FOUND` and of `OTHER`."""
GYRO_OF_17_DEG_SQRT_H, ACCELEROMETER_OF_17_M_S_SQRT_H = 0.622, 1.96
"""Noises of the filter with 17 states that represent constant drifts and biases."""


class Sensors(NamedTuple):
    """One sigma of ranges (m), rates (m/s), a radar's angles and its misalignment (arc seconds)."""

    range_sd_m: float
    rate_sd_m_s: float
    bearing_sd_arcsec: float
    misalignment_sd_arcsec: float


FOUND = Sensors(0.70, 1.67, 66.7, 30.5)
OTHER = Sensors(0.57, 0.3, 120.0, 16.5)


class LevelAxis(NamedTuple):
    """Gyro noise (deg/sqrt(h)) and velocity noise (m/s/sqrt(Hz)) that a printed axis implies."""

    gyro_deg_sqrt_h: float
    velocity_m_s_sqrt_hz: float


def level_axis(tilt_arcsec: float, velocity_m_s: float) -> LevelAxis:
    """Noises of a level axis by its tilt and its velocity, one sigma each (the module's text)."""
    bias = flight.IMU.accel_bias_initial_mg * 1e-3
    tilt = (tilt_arcsec * flight.ARC_SECOND) ** 2 - bias**2
    product = velocity_m_s * math.sqrt(tilt / 2.0)  # n sqrt(R)
    ratio = velocity_m_s**2 / (STANDARD_GRAVITY_M_S2 * tilt)  # sqrt(R) / n
    return LevelAxis(
        math.degrees(math.sqrt(product / ratio)) * ROOT_HOUR, math.sqrt(product * ratio)
    )


def azimuth_ratio(of_17_arcsec: float, of_23_arcsec: float) -> float:
    """Ratio of the gyro noise in the 17 states' filter to the gyro's own, by azimuths of a radar
    without misalignment."""
    half = (of_17_arcsec / of_23_arcsec) ** 2
    return half + math.sqrt(half**2 - 1.0)


def implied_sigmas(
    models: dict[str, Model], systems: dict[str, list[System]], kept: NDArray[np.int64]
) -> dict[str, Any]:
    """One sigma at the end of the flight with the implied noises, of 23 and of 17 states, and of 23
    with the other sensors; `kept` (m,) as of `analyse`."""
    full, reduced = models["23"], models["17"]
    of_17 = {
        "attitude": (math.radians(GYRO_OF_17_DEG_SQRT_H) / ROOT_HOUR) ** 2,
        "velocity": (ACCELEROMETER_OF_17_M_S_SQRT_H / ROOT_HOUR) ** 2,
    }
    out: dict[str, Any] = {
        "gyro_noise_deg_sqrt_h": GYRO_DEG_SQRT_H,
        "other_gyro_noise_deg_sqrt_h": OTHER_GYRO_DEG_SQRT_H,
        "gyro_noise_of_17_deg_sqrt_h": GYRO_OF_17_DEG_SQRT_H,
        "accelerometer_noise_of_17_m_s_sqrt_h": ACCELEROMETER_OF_17_M_S_SQRT_H,
        "sensors": FOUND._asdict(),
        "other_sensors": OTHER._asdict(),
        "by_hand": _by_hand(),
        "models": {},
    }
    for name, of, sensors, gyro_deg in (
        ("23", full, FOUND, GYRO_DEG_SQRT_H),
        ("17", reduced, FOUND, GYRO_DEG_SQRT_H),
        ("23_other", full, OTHER, OTHER_GYRO_DEG_SQRT_H),
    ):
        gyro = (math.radians(gyro_deg) / ROOT_HOUR) ** 2
        truth = list(_with(systems["23"], full, {"attitude": gyro}, sensors))
        is_full = of is full
        believed = truth if is_full else list(_with(systems["17"], reduced, of_17, sensors))
        steps, slots = zip(truth, believed, strict=True), np.arange(full.size) if is_full else kept
        initial = _initial(full, sensors), _initial(of, sensors)
        *_, last = analyse(steps, slots, *initial, np.arange(9))
        out["models"][name] = sigmas(last.true)
    return out


def _by_hand() -> dict[str, Any]:
    printed = PAPER["models"]["23"]
    east, north, up = printed["attitude_sigma_arcsec"]
    v_east, v_north, _ = printed["velocity_sigma_m_s"]
    of_17 = PAPER["models"]["17"]["attitude_sigma_arcsec"][2]
    return {
        "phi_n_dv_e": level_axis(north, v_east)._asdict(),
        "phi_e_dv_n": level_axis(east, v_north)._asdict(),
        "azimuth_ratio": azimuth_ratio(of_17, up),
    }


def _initial(of: Model, sensors: Sensors) -> Array:
    sd = flight.initial_sd(of)
    sd[of.slots_of(SAR_MISALIGNMENT)] = sensors.misalignment_sd_arcsec * flight.ARC_SECOND
    return np.asarray(np.diag(sd**2))


def _with(
    systems: list[System], of: Model, white: dict[str, float], sensors: Sensors
) -> Iterator[System]:
    """Flight with densities (unit^2 / s) of some blocks and other sensors; level, so that noise of
    body axes is that of north, east, down."""
    own = {block.name: block.white for block in of.blocks}
    more = np.zeros(of.size)
    for name, density in white.items():
        more[of.slots_of(name)] = density - own[name]
    for phi, q, h, r in systems:
        satellites = (len(r) - 2) // 2
        variance = np.repeat([sensors.range_sd_m**2, sensors.rate_sd_m_s**2], satellites)
        bearing = np.full(2, (sensors.bearing_sd_arcsec * flight.ARC_SECOND) ** 2)
        yield System(phi, q + np.diag(more), h, np.concatenate([variance, bearing]))
