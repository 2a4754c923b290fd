"""Experiment 4 of paper 004: an active and a passive receiver on one platform, fused live.

The active receiver is BeiDou RDSS: a horizontal fix every 1.5 s that arrives 1.5 s after its
instant, by the centre's height (10 m). The passive one is a GNSS receiver of 10 m, once a second,
0.1 s late. The paper prints no figures of either. Fixes pass the daemon's intake and timeline in
order of arrival, with a rewind for each late one. A centralised filter and one with each receiver
alone run beside the federated filter.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import DelayedFix, Measurement, MonotonicStamp, PositionFix
from fusiond.aiding.base import NotApplicable
from fusiond.aiding.rdss_fix_covariance import RdssGeometry, with_floor
from fusiond.configuration.aiding import AnyAiding, GnssAiding, RdssAiding
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.base import Estimator
from fusiond.estimators.federated.options import FederatedOptions
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.catalogue import make_model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.assembly import federated
from fusiond.navigator.intake import Intake
from fusiond.navigator.timeline import Timeline
from fusiond.simulation.imu_truth import metres_to_geodetic
from fusiond.simulation.sensor_errors import imu_output
from fusiond.studies.daemon_fed_filter import CHECKPOINT_S, HISTORY_S
from fusiond.studies.federated.runs import DURATION_S, ORIGIN_DEG_M, STUDY_IMU, initial_sd, truth
from fusiond.studies.navigation_error import nav_error, true_nav, with_error

Array = NDArray[np.float64]

ACTIVE, PASSIVE = "rdss", "gnss"
CLASS_M, HEIGHT_SD_M = 20, 10.0
ACTIVE_EVERY_S, ACTIVE_DELAY_S = 1.5, 1.5
PASSIVE_SD_M = (10.0, 10.0, 15.0)
PASSIVE_DELAY_S = 0.1
COUNTED_FROM_S = 30.0
FILTERS: dict[str, tuple[str, ...]] = {
    "federated": (ACTIVE, PASSIVE),
    "centralised": (ACTIVE, PASSIVE),
    "active_alone": (ACTIVE,),
    "passive_alone": (PASSIVE,),
}
AIDING: dict[str, AnyAiding] = {
    ACTIVE: RdssAiding(fix_height_sd_m=HEIGHT_SD_M, bias_sd_m=0.0),
    PASSIVE: GnssAiding(),
}


@lru_cache(maxsize=1)
def active_root() -> Array:
    """Cholesky factor (2, 2) of the intake's covariance of an RDSS fix here."""
    o = RdssAiding()
    lat, lon, height = ORIGIN_DEG_M
    found = RdssGeometry(o.satellites_deg).covariance(
        lat * DEG, lon * DEG, height, o.range_sd_m, o.height_sd_m
    )
    assert not isinstance(found, NotApplicable)
    return np.asarray(np.linalg.cholesky(with_floor(found.total, CLASS_M)), dtype=np.float64)


def arrivals(rng: np.random.Generator) -> tuple[list[Measurement], dict[str, Array]]:
    """Fixes in order of arrival, and the horizontal errors (n, 2) of each receiver."""
    found: list[Measurement] = []
    errors: dict[str, Array] = {}
    for source, every_s in ((ACTIVE, ACTIVE_EVERY_S), (PASSIVE, 1.0)):
        t_s = np.arange(every_s, DURATION_S - 2.0, every_s)
        error = rng.standard_normal((len(t_s), 3))
        if source == ACTIVE:
            error[:, :2] = error[:, :2] @ active_root().T
            error[:, 2] *= HEIGHT_SD_M
        else:
            error *= PASSIVE_SD_M
        errors[source] = error[:, :2]
        at = truth().at(t_s).position
        at = at + metres_to_geodetic(at[:, 0], at[:, 2], error)
        for t, p in zip(t_s, at, strict=True):
            stamp = MonotonicStamp(round(t * 1e9))
            lat, lon, height = (float(x) for x in p)
            if source == ACTIVE:
                seen = stamp.t_ns + round(ACTIVE_DELAY_S * 1e9)
                found.append(DelayedFix(source, seen, stamp, lat, lon, height, CLASS_M))
            else:
                seen = stamp.t_ns + round(PASSIVE_DELAY_S * 1e9)
                found.append(
                    PositionFix(source, seen, stamp, lat, lon, height, sd_ned_m=PASSIVE_SD_M)
                )
    return sorted(found, key=lambda m: m.t_seen_ns), errors


def simulate(seed: int, number: int) -> dict[str, Array]:
    """Run `number`: horizontal errors (m, 2) of each filter once a second, and of the fixes."""
    rng = np.random.default_rng([seed, 4, number])
    out = imu_output(STUDY_IMU, truth().gyro, truth().accel, rng)
    samples = np.hstack([out.gyro, out.accel])
    fixes, errors = arrivals(rng)
    model = make_model("ins15", imu_noise(STUDY_IMU))
    sd = initial_sd(model)
    start = with_error(true_nav(truth(), np.zeros(1))[0], rng.standard_normal(9) * sd[:9])
    found = {f"{source}_fixes": e for source, e in errors.items()}
    for name, sources in FILTERS.items():
        estimator: Estimator = (
            federated(model, STUDY_IMU.gap_s, sources, FederatedOptions())
            if name == "federated"
            else KalmanEstimator(model, STUDY_IMU.gap_s)
        )
        estimator.initialise(0, 0, start, np.zeros(model.size), np.diag(sd**2))
        found[name] = _run(estimator, samples, [m for m in fixes if m.source in sources])
    return found


def _run(estimator: Estimator, samples: Array, fixes: list[Measurement]) -> Array:
    rate = STUDY_IMU.rate_hz
    intake = Intake(AIDING)
    imu = ImuBuffer(rate, HISTORY_S, np.eye(3), 0.0, STUDY_IMU.gap_s)
    timeline = Timeline(estimator, imu, HISTORY_S, CHECKPOINT_S)
    timeline.start()
    instants = np.arange(0.5, DURATION_S, 0.5)
    true = true_nav(truth(), instants)
    errors = []
    given = following = 0
    for i, t in enumerate(instants):
        end = round(t * rate)
        times = np.arange(given + 1, end + 1, dtype=np.int64) * round(1e9 / rate)
        imu.append(times, samples[given:end])
        given = end
        while following < len(fixes) and fixes[following].t_seen_ns <= round(t * 1e9):
            m = fixes[following]
            assert isinstance(m, PositionFix | DelayedFix)
            assert isinstance(m.stamp, MonotonicStamp)
            measurements = intake.measurements_of(m, m.stamp.t_ns, 0.0, m.t_seen_ns)
            assert not isinstance(measurements, str)
            for measurement in measurements:
                timeline.insert(measurement)
            following += 1
        timeline.advance()
        if t >= COUNTED_FROM_S:
            errors.append(nav_error(estimator.nav, true[i])[6:8])
    return np.array(errors)


def experiment_4(found: list[dict[str, Array]]) -> dict[str, Any]:
    """Horizontal RMS (m) over all runs, by filter and of the fixes."""
    return {
        f"{name}_rms_m": float(
            np.sqrt(np.mean([np.mean(np.sum(run[name] ** 2, axis=1)) for run in found]))
        )
        for name in found[0]
    }
