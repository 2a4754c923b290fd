"""Run of the filter on a drawn car, and the NEES of its estimates."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.crosstalk_noise import Crosstalk
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.intake import Intake
from fusiond.navigator.motion_constraints import vehicle_blocks
from fusiond.simulation.trajectories import Path, Profile, drive
from fusiond.studies.navigation_error import nav_error, with_error
from fusiond.studies.vehicle_parameters.car import RATE_HZ, Car, draw_car

Array = NDArray[np.float64]

START_SD = np.array([*np.radians([0.3, 0.3, 1.0]), 0.1, 0.1, 0.1, 0.5, 0.5, 1.0])
"""One sigma of attitude, velocity and position at the start."""
SHOWN_S, HIDDEN_S = 300.0, 60.0
CRUISE_M_S = 15.0
NAVIGATION = ("attitude", "velocity", "position")


def observable_drive(seconds: float = SHOWN_S) -> Path:
    """Drive that makes all parameters observable: bends to both sides, stops, a hill."""
    return drive(seconds, 10.0)


def straight_drive(seconds: float = HIDDEN_S) -> Path:
    """Drive straight on at one speed."""
    constant = Profile([0.0], [0.0])
    return Path(Profile([0.0], [CRUISE_M_S]), constant, constant)


PATHS = {"shown": (observable_drive, SHOWN_S), "hidden": (straight_drive, HIDDEN_S)}


def model_of(config: Config) -> Model:
    """Error state with the blocks of the vehicle and of its measurements."""
    blocks = vehicle_blocks(config.constraints.non_holonomic)
    blocks += Intake(config.aiding).extra_blocks()
    return make_model(config.estimator.model, imu_noise(config.imu), *blocks)


@dataclass(frozen=True, slots=True)
class Run:
    """Result at the end: by block its error (k,), one sigma and prior (k,), and the joint NEES;
    outcomes of the measurements."""

    errors: dict[str, Array]
    sigmas: dict[str, Array]
    priors: dict[str, Array]
    nees: dict[str, float]
    outcomes: Counter[str]


def run_once(config: Config, path: str, seed: int, number: int, known: bool = True) -> Run:
    """Draw car `number` of a seed and drive it, from an error of `START_SD` on; `known`: the filter
    has the noise of non-orthogonal axes."""
    # A seed's thousand cars, then others: no two seeds share any.
    thousand, left = divmod(number, 1000)
    rng = np.random.default_rng([1000 * seed + left, sorted(PATHS).index(path), thousand])
    make, seconds = PATHS[path]
    model = model_of(config)
    car = draw_car(config, make(seconds), seconds, rng)
    sd = model.initial.copy()
    sd[:9] = START_SD
    estimator = KalmanEstimator(model, config.imu.gap_s)
    start = with_error(car.nav(0.0), rng.standard_normal(9) * START_SD)
    estimator.initialise(0, 0, start, np.zeros(model.size), np.diag(sd**2))
    outcomes = _drive(config, car, estimator, seconds, known)
    errors, sigmas, priors, nees = {}, {}, {}, {}
    of_nav = nav_error(estimator.nav, car.nav(seconds))
    p, xi = estimator.covariance.copy(), estimator.xi
    if known:  # of the housing, as published: the filter's own is that of the axes of its gyros
        p[range(3), range(3)] += (config.imu.misalignment_deg * DEG) ** 2
    for name in (*NAVIGATION, *car.true):
        slots = model.slots_of(name)
        error = of_nav[slots] if name in NAVIGATION else car.true[name] - xi[slots]
        block = p[np.ix_(slots, slots)]
        errors[name], sigmas[name], priors[name] = error, np.sqrt(np.diag(block)), sd[slots]
        nees[name] = float(error @ np.linalg.solve(block, error))
    return Run(errors, sigmas, priors, nees, outcomes)


def _drive(
    config: Config, car: Car, estimator: KalmanEstimator, seconds: float, known: bool
) -> Counter[str]:
    times = np.rint(np.arange(1, len(car.samples) + 1) * 1e9 / RATE_HZ).astype(np.int64)
    misalignment = config.imu.misalignment_deg * DEG
    crosstalk = Crosstalk(1.0 / RATE_HZ, misalignment) if misalignment and known else None
    buffer = ImuBuffer(
        RATE_HZ, seconds + 1.0, np.eye(3), 0.0, config.imu.gap_s, crosstalk=crosstalk
    )
    buffer.append(times, car.samples)
    outcomes = Counter[str]()
    for measurement in car.measurements:
        estimator.propagate(buffer, measurement.t_ns)
        outcomes[f"{measurement.source} {estimator.update(measurement).name}"] += 1
    estimator.propagate(buffer, math.floor(seconds * 1e9))
    return outcomes
