"""The estimator's state as a solution, at its own instant or a little later."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.base import Estimator
from fusiond.estimators.propagation import compensate
from fusiond.estimators.reading import in_fix_time
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_from_quaternion, rpy_from_dcm
from fusiond.navigation.solution import Bound, Mode, Solution
from fusiond.navigation.strapdown import NAV_SIZE, STEP_SIZE, strapdown_step

Array = NDArray[np.float64]


def solution_of(
    estimator: Estimator,
    imu: ImuBuffer,
    t_ns: int,
    most_ns: int,
    mode: Mode,
    reason: str,
    bound: Bound,
) -> Solution:
    """The solution at `t_ns`; where that is later than the estimator's instant, carried ahead by
    holding the rates of the newest sample, for `most_ns` at most."""
    nav = estimator.nav
    ahead_ns = min(t_ns - estimator.t_ns, most_ns)
    if ahead_ns > 0 and imu.end:
        nav = _carried(estimator, imu, ahead_ns * 1e-9)
    published = np.empty(NAV_SIZE)
    in_fix_time(nav, estimator.xi, estimator.step, estimator.published.time_slot, published)
    nav = published
    sigmas = estimator.sigmas()
    sigmas[~estimator.model.stated] = math.nan
    sd = sigmas.tolist()
    values = nav.tolist()
    bias = estimator.sensor_errors.tolist()
    return Solution(
        t_ns,
        mode,
        reason,
        values[0],
        (values[1] + math.pi) % (2.0 * math.pi) - math.pi,
        values[2],
        (values[3], values[4], values[5]),
        rpy_from_dcm(dcm_from_quaternion(nav[6:])),
        (sd[0], sd[1], sd[2]),
        (sd[3], sd[4], sd[5]),
        (sd[6], sd[7], sd[8]),
        (bias[0], bias[1], bias[2]),
        (bias[3], bias[4], bias[5]),
        bound,
    )


def publish_by_own_clock(estimator: Estimator, sd_s: float) -> None:
    """A receiver's clock has shown to be none to publish by: from the next start on it is the
    filter's own, the IMU's.

    That is known as well as what lies between it and the clock of a receiver that is on time: what
    the model takes for granted of that before anything shows it, or `sd_s`, one sigma of how late
    the fixes are, where it has no offset in time.
    """
    slot = estimator.model.time_slot
    clock_sd_s = float(estimator.model.initial[slot]) if slot >= 0 else sd_s
    estimator.publish_by(estimator.published._replace(time_slot=-1, clock_sd_s=clock_sd_s))


def _carried(estimator: Estimator, imu: ImuBuffer, ahead_s: float) -> Array:
    """The navigation state (10,) after `ahead_s` with the newest sample's rates."""
    nav = estimator.nav.copy()
    rate, force, zero = np.zeros(3), np.zeros(3), np.zeros(3)
    compensate(imu.samples, imu.end - 1, estimator.sensor_errors, rate, force)
    hold = estimator.model.hold_height
    strapdown_step(nav, rate, force, zero, zero, ahead_s, hold, np.zeros(STEP_SIZE))
    return nav
