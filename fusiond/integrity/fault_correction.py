r"""Corrections of a filter's state for the effect of identified faults.

Hypotheses f that cannot be distinguished are combined by the moments of their mixture with weights
w_f,

    mean = sum w_f V_f b_f,   spread = sum w_f (V_f M_f V_f^T + (V_f b_f - mean)(...)^T)

plus a second-order term for the nonlinear part: an attitude error phi has turned the velocity, and
the path, by phi / 2 on average. For a gyro fault of twenty seconds in an outage that is a metre a
second. Along phi its own estimate is of that order: phi^2 / 2, 8 deg of a unit that turns by 30.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.initialisation_candidates import PositionCandidate
from fusiond.estimators.base import Estimator
from fusiond.estimators.fault_bank_interface import Estimated
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.strapdown import HEIGHT, LAT, LON

Array = NDArray[np.float64]

PLACE_ROW = 6
"""First row of the position in the error state."""


class Correction(NamedTuple):
    """Correction of the error state, mean (n,), and its covariance (n, n)."""

    mean: Array
    spread: Array


def mixed(taken: Sequence[Estimated]) -> Correction:
    """Correction of hypotheses weighted by their fit."""
    fits = np.array([each.log_likelihood for each in taken])
    weights = np.exp(fits - fits.max())
    weights /= weights.sum()
    mean, spread = np.zeros_like(taken[0].mean), np.zeros_like(taken[0].spread)
    for w, each in zip(weights, taken, strict=True):
        mean += w * each.mean
    for w, each in zip(weights, taken, strict=True):
        apart = each.mean - mean
        spread += w * (each.spread + np.outer(apart, apart))
    return Correction(mean, spread + _bent(mean))


def _bent(mean: Array) -> Array:
    """Covariance (n, n) of the nonlinear part of a correction, which V b lacks."""
    half, left = 0.5 * float(np.linalg.norm(mean[:3])), np.zeros(len(mean))
    for first in (PLACE_ROW - 3, PLACE_ROW):
        left[first : first + 3] = half * np.linalg.norm(mean[first : first + 3])
    bent = np.diag(left**2)
    bent[:3, :3] += half * half * np.outer(mean[:3], mean[:3])
    return bent


def somewhere_else(measurement: AidingMeasurement, estimator: Estimator) -> Correction:
    """Covariance of the filter's position widened by its distance from a measured position."""
    spread = np.zeros((estimator.model.size, estimator.model.size))
    nav = estimator.nav
    lat, lon, height = nav.item(LAT), nav.item(LON), nav.item(HEIGHT)
    for candidate in measurement.candidates():
        if isinstance(candidate, PositionCandidate):
            north = (candidate.lat_rad - lat) * meridian_radius(lat)
            east = (candidate.lon_rad - lon) * transverse_radius(lat) * math.cos(lat)
            down = 0.0 if candidate.height_m is None else height - candidate.height_m
            for row, apart in enumerate((north, east, down)):
                spread[PLACE_ROW + row, PLACE_ROW + row] = apart * apart
    return Correction(np.zeros(len(spread)), spread)
