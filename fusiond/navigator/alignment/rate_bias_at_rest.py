"""Velocity and rate bias of a vehicle at rest."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.models.blocks import ImuNoise
from fusiond.navigation.earth import EARTH_RATE_RAD_S
from fusiond.navigator.alignment.evidence import Standstill

Array = NDArray[np.float64]

# One sigma of velocity (m/s) of a vehicle that stands.
REST_VELOCITY_SD = np.full(3, 0.1)


def rest_bias(
    noise: ImuNoise, standstill: Standstill, dcm: Array, lat: float, sd_yaw: float = 0.0
) -> tuple[Array, float]:
    """Rate bias (3,) at rest and its sigma.

    A heading error y of one sigma s subtracts a wrong part of the Earth's level rate w, w (cos y -
    1, sin y). The start correlates w y; the rest, half of it an axis, is

        E (sin y - y)^2 + E (1 - cos y)^2 = s^2 + 2 - 2 (1 + s^2) exp(-s^2 / 2)
    """
    earth = EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    rest = sd_yaw**2 + 2.0 - 2.0 * (1.0 + sd_yaw**2) * math.exp(-0.5 * sd_yaw**2)
    wrong = float(earth[0]) * math.sqrt(0.5 * rest)
    white = noise.rate_noise / math.sqrt(standstill.seconds)
    return standstill.mean_rate - dcm.T @ earth, math.hypot(white, wrong)
