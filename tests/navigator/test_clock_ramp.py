"""A clock whose drift runs on, and satellites whose orbits drift: what carriers make of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.blocks import CLOCK_RAMP
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigator.intake import Intake
from fusiond.studies.bds_tight import runs
from fusiond.studies.daemon_fed_filter import DaemonFedFilter, drive_samples, drive_truth
from fusiond.studies.navigation_error import nav_error, true_nav, with_error

Array = NDArray[np.float64]

RAMP_M_S2 = -0.17


def driven(
    ramp_m_s2: float, late_s: Callable[[float], float]
) -> tuple[Model, KalmanEstimator, Array, Array]:
    """A minute of open sky whose epochs are taken for `late_s` later than they are; the model, the
    filter at its end, errors (60, 9) of its state after each epoch, and their sigma."""
    simulated, _ = runs.observe("open", 45, 1)
    t_s = runs.epochs()[:60]
    simulated.clock_m[:60] += 0.5 * ramp_m_s2 * t_s * t_s
    simulated.clock_drift_m_s[:60] += ramp_m_s2 * t_s
    intake = Intake({"raw": runs.RAW})
    model = make_model("ins15", imu_noise(runs.IMU), *intake.extra_blocks())
    rng = np.random.default_rng([45, 1])
    level, height, velocity, tilt, heading = runs.START_SD
    sd = model.initial.copy()
    sd[:9] = [tilt * DEG, tilt * DEG, heading * DEG, *[velocity] * 3, *[level] * 2, height]
    nav = true_nav(drive_truth(), np.r_[0.0, t_s])
    started = with_error(nav[0], rng.standard_normal(9) * sd[:9])
    samples = drive_samples(runs.IMU, rng)
    live = DaemonFedFilter(
        KalmanEstimator(model, runs.IMU.gap_s), runs.IMU.gap_s, samples, started, sd
    )
    raw = intake.receivers["raw"]
    for message in runs.broadcast(simulated):
        raw.learn(message)
    e, errors, sigmas = live.estimator, [], []
    for k, t in enumerate(t_s):
        seen_s = t + late_s(t)
        live.advance(t)
        live.advance(t, [raw.measurement(simulated.epoch(k), round(seen_s * 1e9))])
        # What is taken for later waits for the samples until then.
        live.advance(t + 0.1)
        errors.append(nav_error(e.nav, true_nav(drive_truth(), np.array([t + 0.1]))[0]))
        sigmas.append(e.sigmas())
    return model, e, np.array(errors), np.array(sigmas)


def test_a_clock_that_warms_is_followed() -> None:
    """Its drift by 0.17 m/s each second, as of a receiver on a walk: a minute tells it to 0.05."""
    model, e, errors, _ = driven(RAMP_M_S2, lambda t: 0.0)
    (slot,) = model.slots_of(CLOCK_RAMP)
    found, sigma = float(e.xi[slot]), float(np.sqrt(e.covariance[slot, slot]))
    assert sigma < 0.06
    assert found == pytest.approx(RAMP_M_S2, abs=3.0 * sigma)
    assert np.abs(errors[-1, 3:6]).max() < 0.1


def test_carriers_go_by_the_receivers_clock() -> None:
    """Its epochs had all come 6 ms late, and one comes at once: the instants of those after it are
    6 ms earlier, and none of the vehicle's way is in that."""
    _, _, errors, sigmas = driven(0.0, lambda t: 0.006 if t < 45.0 else 0.0)
    assert np.abs(errors[44:, 3:5] / sigmas[44:, 3:5]).max() < 4.0


def test_four_satellites_of_a_poor_geometry_are_not_believed() -> None:
    """DOP 40, all orbits drift by 0.7 mm/s one way: the place is carried along by 30 mm/s for 200
    s, to 5 m. With what they drift by at each anchor alone the mean NEES of three was 13.5, sigma
    1.2 m; a mean over 200 s, which is one draw, is above 7.8 once in twenty."""
    rng = np.random.default_rng([0, 2])
    samples, unit = drive_samples(runs.IMU, rng), rng.standard_normal(9)
    simulated, observed = runs.observe("canyon4", 0, 2)
    nothing = [None] * len(observed)
    row = runs._FILTERS["tight_ekf"]
    trace = runs._filter_trace(row, simulated, observed, nothing, samples, unit)
    stretch = runs.in_stretch(runs.epochs())
    assert trace.nees[stretch].mean() < 7.8
    assert np.abs(trace.error[stretch]).max() < 6.0
