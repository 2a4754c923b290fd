"""Misalignment is estimated honestly: NEES of attitude and of both sensors' small angles.

GNSS, star tracker and SAR on the town drive, each sensor mounted 0.05 deg askew (one sigma of each
angle), drawn anew in each run. Attitude and the two misalignments are tied together by their sums,
so their joint NEES is what an overconfident filter fails first.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.aiding.attitude import STAR_BLOCK, AttitudeMeasurement
from fusiond.aiding.base import Linearised
from fusiond.aiding.landmark_bearing import SAR_BLOCK, BearingMeasurement
from fusiond.configuration.si_units import ARCSEC, imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.blocks import misalignment
from fusiond.models.catalogue import make_model
from fusiond.simulation.star_tracker_radar import (
    SarOptions,
    SarRadar,
    StarTracker,
    StarTrackerOptions,
)
from tests import runs
from tests.estimators.monte_carlo import (
    FIRST_FIX_S,
    LEVER,
    MATCHED,
    RATE_HZ,
    drawn_measurements,
    interval,
)

RUNS, SECONDS, SD = 30, 150.0, 180.0 * ARCSEC
GATE = 1.0 - 1e-9
# Within 4 to 15 km of the drive, on all sides.
POINTS = {
    "1": (30.53, 114.34, 300.0),
    "2": (30.50, 114.20, 700.0),
    "3": (30.40, 114.33, 150.0),
    "4": (30.62, 114.27, 90.0),
}


@pytest.mark.parametrize("tau_s", [None, 300.0])
def test_misalignment_is_estimated_honestly(tau_s: float | None) -> None:
    imu = MATCHED["ins15"]
    truth = runs.town_truth(SECONDS, RATE_HZ)
    times = runs.sample_times(truth)
    tau = math.inf if tau_s is None else tau_s
    blocks = (misalignment(STAR_BLOCK, SD, tau), misalignment(SAR_BLOCK, SD, tau))
    model = make_model("ins15", imu_noise(imu), *blocks)
    estimator = KalmanEstimator(model, imu.gap_s)
    slots = [*model.slots_of(STAR_BLOCK), *model.slots_of(SAR_BLOCK)]
    sd = runs.initial_sd(model, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    start, end = runs.true_nav(truth, np.array([0.0, SECONDS]))
    fixes_s = np.arange(FIRST_FIX_S, SECONDS, 1.0)
    star_options = StarTrackerOptions(
        misalignment_sd_arcsec=180.0, misalignment_correlation_s=tau_s
    )
    sar_options = SarOptions(
        POINTS,
        misalignment_sd_arcsec=180.0,
        misalignment_correlation_s=tau_s,
        lever_arm_m=LEVER,
    )
    groups = {
        "attitude": [0, 1, 2],
        "star": slots[:3],
        "sar": slots[3:],
        "all": [0, 1, 2, *slots],
    }
    nees = dict.fromkeys(groups, 0.0)
    nis: dict[str, tuple[float, int]] = {}
    errors, sigmas, seen = [], [], 0
    for k in range(RUNS):
        rng = np.random.default_rng([77, k])
        star, sar = StarTracker(truth, star_options, rng), SarRadar(truth, sar_options, rng)
        measurements: list[Linearised] = [
            a for fix in drawn_measurements("ins15", truth, fixes_s, rng) for a in fix
        ]
        for t, rpy in zip(star.t_s, star.rpy, strict=True):
            angles = (float(rpy[0]), float(rpy[1]), float(rpy[2]))
            sd_star = (float(star.sd_rad[0]),) * 3
            measurements.append(
                AttitudeMeasurement("star", round(t * 1e9), GATE, angles, sd_star, block=STAR_BLOCK)
            )
        for t, (azimuth, elevation), name in zip(sar.t_s, sar.angles, sar.target, strict=True):
            lat, lon, height = POINTS[name]
            measurements.append(
                BearingMeasurement(
                    "sar",
                    round(t * 1e9),
                    GATE,
                    float(azimuth),
                    float(elevation),
                    (float(sar.sd_rad[0]), float(sar.sd_rad[1])),
                    (math.radians(lat), math.radians(lon), height),
                    LEVER,
                    1000.0,
                    block=SAR_BLOCK,
                )
            )
        seen += len(sar.t_s)
        buffer = runs.filled_buffer(imu, times, runs.imu_run(imu, truth, 500 + k).samples)
        error = rng.standard_normal(model.size) * sd
        estimator.initialise(
            0, 0, runs.with_error(start, error[:9]), np.zeros(model.size), np.diag(sd**2)
        )
        for measurement in sorted(measurements, key=lambda a: a.t_ns):
            estimator.propagate(buffer, measurement.t_ns)
            outcome = estimator.update(measurement)
            assert outcome.name == "fused", (measurement, outcome)
            total, degrees = nis.get(measurement.source, (0.0, 0))
            nis[measurement.source] = total + outcome.nis, degrees + outcome.degrees
        estimator.propagate(buffer, round(SECONDS * 1e9))
        x = np.zeros(model.size)
        x[:9] = runs.nav_error(estimator.nav, end)
        x[slots[:3]] = star.misalignment[-1] - estimator.xi[slots[:3]]
        x[slots[3:]] = sar.misalignment[-1] - estimator.xi[slots[3:]]
        for group, rows in groups.items():
            p = estimator.covariance[np.ix_(rows, rows)]
            nees[group] += float(x[rows] @ np.linalg.solve(p, x[rows]))
        errors.append(x[slots])
        sigmas.append(np.sqrt(np.diag(estimator.covariance))[slots])
    assert seen > 0.9 * RUNS * (SECONDS - 2.0)
    # 99.9 % that all of them hold at once (Bonferroni).
    probability = 1.0 - 0.001 / (len(nees) + len(nis))
    rms = np.sqrt(np.mean(np.square(errors), axis=0)) / ARCSEC
    print(f"rms {np.round(rms, 1)} sigma {np.round(np.mean(sigmas, axis=0) / ARCSEC, 1)} arcsec")
    for group, total in nees.items():
        low, high = interval(RUNS * len(groups[group]), probability)
        print(f"NEES {group}: {total / RUNS:.2f} [{low / RUNS:.2f}, {high / RUNS:.2f}]")
        assert low <= total <= high, group
    for source, (total, degrees) in nis.items():
        low, high = interval(degrees, probability)
        print(f"NIS {source}: {total / degrees:.4f} [{low / degrees:.4f}, {high / degrees:.4f}]")
        assert low <= total <= high, source
    # What is estimated is better known than before.
    assert (np.mean(sigmas, axis=0) < 0.8 * SD).all()
