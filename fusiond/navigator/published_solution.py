"""The estimator's state as a solution, at its own instant or a little later."""

from __future__ import annotations

import math

import numpy as np

from fusiond.estimators.base import Estimator
from fusiond.estimators.propagation import published_ahead
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.solution import HEIGHT_KNOWN_SD_M, HELD_UNKNOWN_M, Bound, Mode, Solution
from fusiond.navigation.strapdown import NAV_SIZE

_SIZE = NAV_SIZE + 3


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
    ahead_ns = min(t_ns - estimator.t_ns, most_ns)
    ahead_s = ahead_ns * 1e-9 if ahead_ns > 0 and imu.end else 0.0
    e, model, errors, out = estimator, estimator.model, estimator.sensor_errors, np.empty(_SIZE)
    newest, time_slot = imu.end - 1, e.published.time_slot
    published_ahead(
        *(e.nav, e.xi, e.step, imu.samples, newest),
        *(errors, ahead_s, model.hold_height, time_slot, out),
    )
    lat, lon, height, v_n, v_e, v_d, _, _, _, _, roll, pitch, yaw = out.tolist()
    sd, bias = e.sigmas().tolist(), errors.tolist()
    for k in model.unstated:
        sd[k] = math.nan
    if sd[2] > HEIGHT_KNOWN_SD_M or (model.hold_height and abs(height) < HELD_UNKNOWN_M):
        height = sd[2] = math.nan
    return Solution(
        t_ns,
        mode,
        reason,
        lat,
        (lon + math.pi) % (2.0 * math.pi) - math.pi,
        height,
        (v_n, v_e, v_d),
        (roll, pitch, yaw),
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
