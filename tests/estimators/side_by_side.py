"""An extended and an unscented filter side by side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.base import Estimator
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.unscented.filter import UnscentedEstimator
from fusiond.models.catalogue import make_model
from tests import runs
from tests.estimators.covariances import random_covariance

Array = NDArray[np.float64]

IMU = Imu(rate_hz=50.0)
GATE = 1.0 - 1e-9
NO_LEVER = (0.0, 0.0, 0.0)
LEVER = (0.4, -0.3, -1.2)
MODELS = ("ins15", "ins21", "ins23", "planar15")


def pair_of(
    name: str, p_scale: float = 1.0, propagation: bool = False, seed: int = 1
) -> tuple[KalmanEstimator, UnscentedEstimator]:
    """An extended and an unscented filter in the same state, with a full covariance."""
    model = make_model(name, imu_noise(IMU))
    rng = np.random.default_rng(seed)
    p = p_scale**2 * random_covariance(rng, model)
    nav = runs.level_nav((0.1, -0.05, 0.8), (12.0, -7.0, 0.0 if model.hold_height else 0.8))
    xi = np.zeros(model.size)
    xi[9:] = 0.3 * model.initial[9:] * rng.standard_normal(model.size - 9)
    pair = (
        KalmanEstimator(model, IMU.gap_s),
        UnscentedEstimator(model, IMU.gap_s, propagation=propagation),
    )
    for estimator in pair:
        estimator.initialise(0, 0, nav, xi, p)
    return pair


def compare(a: Estimator, b: Estimator, sigmas: float, relative: float) -> None:
    """Means to `sigmas` one sigma, covariances to `relative` of the sigmas' product."""
    sd = np.sqrt(np.diag(a.covariance))
    sd[sd == 0.0] = 1.0
    off = np.r_[runs.nav_error(a.nav, b.nav), a.xi[9:] - b.xi[9:]] / sd
    assert np.abs(off).max() < sigmas, off
    ratio = (a.covariance - b.covariance) / np.outer(sd, sd)
    assert np.abs(ratio).max() < relative, ratio


def linear_measurements(height: bool) -> list[Linearised]:
    lat, lon, up = runs.ORIGIN
    sd, v = (1.5, 2.0, 3.0), (12.1, -7.2, 0.9)
    place = (lat + 2e-7, lon - 1e-7, up + 1.0 if height else None)
    return [
        PositionMeasurement("gnss", 0, GATE, *place, sd, NO_LEVER),
        VelocityMeasurement("velocity", 0, GATE, v, (0.1, 0.1, 0.2), NO_LEVER),
    ]
