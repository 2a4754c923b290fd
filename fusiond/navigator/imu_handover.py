"""State and published solution of the filter at a change of the inertial unit."""

from __future__ import annotations

import math

import numpy as np

from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG
from fusiond.estimators.base import Estimator
from fusiond.models.vehicle_parameter_blocks import MOUNTING
from fusiond.navigation.error_model import COLUMN_END, PHI, RATE_ERROR
from fusiond.navigator.timeline import Timeline


def publish_by_axes(estimator: Estimator, imu: Imu, spare: bool = False) -> None:
    """Publish in the first unit's nominal axes, by which other equipment is mounted. The gyros of
    either unit measure in their own, misaligned axes."""
    mounting_deg = imu.spare.mounting_sd_deg if spare and imu.spare is not None else 0.0
    sd_rad = math.hypot(imu.misalignment_deg, mounting_deg) * DEG
    estimator.publish_by(estimator.published._replace(axes_sd_rad=sd_rad))


def published_of_spare(estimator: Estimator, imu: Imu) -> bool:
    """True if the published sigma is the spare's, limited by its mounting."""
    return estimator.published.axes_sd_rad > imu.misalignment_deg * DEG


def hand_over(estimator: Estimator, timeline: Timeline, imu: Imu) -> None:
    """Continue the filter with the spare of `imu`.

    Biases, scale factors and mounting restart from their priors, 0 and uncorrelated: they belonged
    to the first unit. The body axes are now the new unit's: the attitude's variance grows by that
    of its mounting. The timeline restarts here: samples of two units are not one sequence, and a
    fix of an earlier instant is too old.
    """
    assert imu.spare is not None
    model, p = estimator.model, estimator.covariance.copy()
    slots = [s for column in range(RATE_ERROR, COLUMN_END) for s in model.parameters(column)]
    slots += model.slots_of(MOUNTING)
    xi = estimator.xi.copy()
    xi[slots] = 0.0
    p[slots, :] = 0.0
    p[:, slots] = 0.0
    p[slots, slots] = np.square(model.initial[slots])
    attitude = np.arange(PHI, PHI + 3)
    p[attitude, attitude] += (imu.spare.mounting_sd_deg * DEG) ** 2
    estimator.initialise(estimator.t_ns, estimator.sample, estimator.nav.copy(), xi, p)
    timeline.start()
