"""Solution from the estimator's state, at its own instant or later.

Once the inertial unit is silent for longer than a solution is carried ahead by its last sample
nobody knows what the vehicle does. For each second of that, one sigma is that what it did last goes
on or ends, and that it brakes or turns by a, of which five are the hardest that vehicles of its
class do (fusiond.configuration.plausibility):

    velocity  |a_last| + a      position  |v| + velocity t / 2      yaw  |w_last| + a / |v|

and a road is banked for its bends, by (|a_last| + a) / g at most, as soon as one lasts.

A heading that was claimed and that nothing has shown yet may be the other way round: half a turn is
five sigma, and less once positions have confirmed the way from the start
(fusiond.navigator.alignment.start_check). What it does to the velocity is as much of the speed, and
to the position of the way since the last position. Of an inertial unit whose bias is n sigma of its
data sheet, which its rates have not shown to be the unit's own yet
(fusiond.navigator.imu_unit_check), an attitude is known n times as poorly.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.aiding.base import Vector3
from fusiond.configuration.plausibility import Plausibility
from fusiond.estimators.base import Estimator
from fusiond.estimators.propagation import published_ahead
from fusiond.navigation.earth import (
    STANDARD_GRAVITY_M_S2,
)
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.solution import HEIGHT_KNOWN_SD_M, HELD_UNKNOWN_M, Bound, Mode, Solution
from fusiond.navigation.strapdown import NAV_SIZE, STEP_SMOOTH_N, STEP_SMOOTH_RATE_B
from fusiond.navigator.alignment.start_check import Unshown

_SIZE = NAV_SIZE + 3
SLOW_M_S = 5.0
"""Speed below which a car's turn rate is limited by its steering: 1.6 m/s^2 are 18 deg/s."""
MOST_SIGMAS = 5.0
"""Sigmas of the hardest manoeuvre: an error beyond them is a lie."""


def solution_of(
    estimator: Estimator,
    imu: ImuBuffer,
    t_ns: int,
    most_ns: int,
    mode: Mode,
    reason: str,
    bound: Bound,
    limits: Plausibility,
    unshown: Unshown | None = None,
    worse: float = 1.0,
) -> Solution:
    """The solution at `t_ns`; where that is later than the estimator's instant, carried ahead by
    holding the rates of the newest sample, for `most_ns` at most. `limits` of the vehicle's class;
    `unshown`: what a claimed heading leaves open that nothing has shown; `worse`: how many times
    worse than its data sheet the inertial unit shows to be."""
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
    silent_s = (t_ns - e.t_ns) * 1e-9 - ahead_s
    if silent_s > 0.0:
        _widen_by_silence(sd, (v_n, v_e, v_d), e, silent_s, limits)
    if worse > 1.0:
        sd[6:9] = [min(worse * each, math.pi) for each in sd[6:9]]
    if unshown is not None:
        _widen_by_claim(sd, (lat, lon), (v_n, v_e), unshown)
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


def _widen_by_silence(
    sd: list[float], v: Vector3, e: Estimator, s: float, limits: Plausibility
) -> None:
    """Add the possible motion of `s` seconds to sigma (9,)."""
    step, (north, east, down), (_, vertical, lasts_s) = e.step, v, limits.manoeuvre
    level = limits.hardest_m_s2 / MOST_SIGMAS
    pull = math.hypot(step.item(STEP_SMOOTH_N), step.item(STEP_SMOOTH_N + 1)) + level
    banked = min(s / lasts_s, 1.0) * pull / STANDARD_GRAVITY_M_S2
    turned = abs(step.item(STEP_SMOOTH_RATE_B + 2)) + level / max(math.hypot(north, east), SLOW_M_S)
    for row, (speed, a) in enumerate(((north, pull), (east, pull), (down, vertical))):
        sd[row] = math.hypot(sd[row], (abs(speed) + 0.5 * a * s) * s)
        sd[3 + row] = math.hypot(sd[3 + row], a * s)
    for row, angle in enumerate((banked, banked, turned * s)):
        sd[6 + row] = min(math.hypot(sd[6 + row], angle), math.pi)


def _widen_by_claim(
    sd: list[float], place: tuple[float, float], v: tuple[float, float], unshown: Unshown
) -> None:
    """Add to sigma (9,) what a claimed heading leaves open, of a vehicle at `place` (rad) with
    velocity `v`, north and east."""
    doubt = unshown.sd_rad
    for row, more in enumerate((unshown.way_m(*place), math.hypot(*v))):
        for axis in (3 * row, 3 * row + 1):
            sd[axis] = math.hypot(sd[axis], doubt * more)
    sd[8] = math.hypot(sd[8], doubt)


def publish_by_own_clock(estimator: Estimator, sd_s: float) -> None:
    """Publish by the filter's own clock, the IMU's, from the next start on, since the receiver's
    clock is unusable.

    That is known as well as what lies between it and the clock of a receiver that is on time: what
    the model takes for granted of that before anything shows it, or `sd_s`, one sigma of how late
    the fixes are, where it has no offset in time.
    """
    slot = estimator.model.time_slot
    clock_sd_s = float(estimator.model.initial[slot]) if slot >= 0 else sd_s
    estimator.publish_by(estimator.published._replace(time_slot=-1, clock_sd_s=clock_sd_s))
