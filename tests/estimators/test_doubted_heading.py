"""A heading that has become uncertain under way: what the first fixes after that make of it."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.invariant import InvariantFilter
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.catalogue import make_model
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, follow
from tests.runs import (
    ORIGIN,
    Array,
    filled_buffer,
    imu_run,
    initial_sd,
    metres_per_unit,
    nav_error,
    sample_times,
    true_nav,
    with_error,
)

RUNS = 8
IMU = Imu(rate_hz=50.0)
BEND_S, FIXES_S, END_S = 8.0, 18.0, 20.0
HEADING_SD_RAD = math.radians(12.0)
GATE, LEVER = 1.0 - 1e-9, (0.0, 0.0, 0.0)
FIX_SD_M, VELOCITY_SD_M_S = 0.8, 0.05


@lru_cache(maxsize=1)
def truth() -> Truth:
    """20 m/s, and half a turn in 15 s."""
    legs = [Leg(BEND_S, speed_m_s=20.0), Leg(15, turn_deg=180.0), Leg(5)]
    return Truth(follow(legs, END_S, course_deg=40.0), ORIGIN, IMU.rate_hz, END_S)


def nees_of_tilt_and_force(kind: type[KalmanEstimator], seed: int) -> float:
    """Of roll, pitch and the biases of the level accelerometers, after two seconds of fixes: ten
    seconds of the bend were driven with a heading of 12 deg."""
    model = make_model("ins15", imu_noise(IMU))
    run = imu_run(IMU, truth(), seed)
    times = sample_times(truth())
    buffer = filled_buffer(IMU, times, run.samples)
    rng = np.random.default_rng(1000 + seed)
    sd = initial_sd(model, np.radians([0.1, 0.1, 12.0]), 0.05, 0.5)
    sd[9:12], sd[12:15] = math.radians(0.01), 0.05
    first = int(np.searchsorted(times, round(BEND_S * 1e9), side="right"))
    start = true_nav(truth(), np.array([times[first - 1] * 1e-9]))[0]
    draw = sd[:9] * rng.standard_normal(9)
    # So that each run has a heading to be corrected.
    draw[2] = math.copysign(HEADING_SD_RAD, draw[2])
    xi = np.zeros(model.size)
    xi[9:15] = run.biases[first] + sd[9:15] * rng.standard_normal(6)
    estimator = kind(model, IMU.gap_s)
    nav = with_error(start, draw)
    estimator.initialise(int(times[first - 1]), first, nav, xi, np.diag(sd**2))
    if isinstance(estimator, InvariantFilter):
        estimator.turns = True  # as after a start with a heading of 12 deg
    for t_s in (BEND_S + 0.02, *np.arange(FIXES_S, END_S, 0.2)):
        t_ns = round(float(t_s) * 1e9)
        estimator.propagate(buffer, t_ns)
        true = true_nav(truth(), np.array([estimator.t_ns * 1e-9]))[0]
        to_m = metres_per_unit(float(true[0]), float(true[2]))
        place = true[:3] + FIX_SD_M * rng.standard_normal(3) / to_m
        v = true[3:6] + VELOCITY_SD_M_S * rng.standard_normal(3)
        lat, lon, height = place.tolist()
        fix = PositionMeasurement("gnss", t_ns, GATE, lat, lon, height, (FIX_SD_M,) * 3, LEVER)
        north, east, down = v.tolist()
        speed = VelocityMeasurement(
            "v", t_ns, GATE, (north, east, down), (VELOCITY_SD_M_S,) * 3, LEVER
        )
        assert estimator.update(fix).name == "fused"
        assert estimator.update(speed).name == "fused"
    last = int(np.searchsorted(times, estimator.t_ns, side="right")) - 1
    error: Array = np.concatenate(
        [nav_error(estimator.nav, true)[:2], (run.biases[last] - estimator.xi[9:15])[3:5]]
    )
    slots = [0, 1, 12, 13]
    return float(error @ np.linalg.solve(estimator.covariance[np.ix_(slots, slots)], error))


def test_a_large_heading_error_is_not_taken_for_sensor_errors() -> None:
    """20 runs: 47 of 4 in the coordinates of large headings, 110 in plain ones. Neither is honest,
    with a heading that is off by 12 deg in each of them."""
    plain, turned = (
        np.mean([nees_of_tilt_and_force(kind, seed) for seed in range(RUNS)])
        for kind in (KalmanEstimator, InvariantFilter)
    )
    assert turned < 0.6 * plain
