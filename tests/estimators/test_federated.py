"""The federated filter: equal to the centralised one where it must be, sound, the same after
rewinds."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.rdss_position import HeldFeedback, RdssPositionMeasurement
from fusiond.aiding.standstill import ZeroAngularRateUpdate
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.estimators.base import Estimator, Outcome
from fusiond.estimators.federated.filter import FederatedFilter
from fusiond.estimators.federated.no_reset import NoResetFilter
from fusiond.estimators.federated.options import FederatedOptions, Mode, local_of
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_from_quaternion
from fusiond.navigator.assembly import federated
from fusiond.navigator.timeline import Timeline
from fusiond.studies.federated import runs as study
from tests import runs

Array = NDArray[np.float64]

IMU = Imu(rate_hz=50.0)
SECONDS = 40.0
MODES: tuple[Mode, ...] = ("no_reset", "fusion_reset", "zero_reset", "rescale")
NAMES = ("gnss", "rdss", "compass")
ZERO = (0.0, 0.0, 0.0)


class Drive:
    """Two position sources, one with velocity, a late source, and a measurement common to all."""

    def __init__(self) -> None:
        truth = runs.town_truth(SECONDS, IMU.rate_hz)
        self.times = runs.sample_times(truth)
        self.samples = runs.imu_run(IMU, truth, 7).samples
        rng = np.random.default_rng(3)
        self.sd = np.radians([0.3, 0.3, 2.0])
        self.nav = runs.true_nav(truth, np.zeros(1))[0]
        self.measurements: list[Linearised] = []
        for t in np.arange(0.507, SECONDS - 2.0, 0.9):
            nav = runs.true_nav(truth, np.array([t]))[0]
            error = rng.standard_normal(9) * ([0.0] * 3 + [0.1] * 3 + [1.5] * 3)
            lat, lon, height, n, e, d = (float(x) for x in runs.with_error(nav, error)[:6])
            t_ns = round(t * 1e9)
            sd, gate = (1.5, 1.5, 1.5), 1.0 - 1e-12
            self.measurements += [
                PositionMeasurement("gnss", t_ns, gate, lat, lon, height, sd, (0.4, -0.3, -1.2)),
                VelocityMeasurement("gnss_velocity", t_ns - 100_000_000, gate, (n, e, d), sd, ZERO),
                RdssPositionMeasurement(
                    "rdss", t_ns + 3, gate, lat, lon, (400.0, 50.0, 300.0), ZERO, holds=True
                ),
                HeldFeedback("rdss_feedback", t_ns + 700_000_000, gate),
            ]
        rate = (0.0, 0.0, 0.0)
        self.measurements.append(
            ZeroAngularRateUpdate("zero_rate", 300_000_000, 0.9999, rate, 0.1, runs.rest())
        )
        self.measurements.sort(key=lambda a: (a.t_ns, a.source))

    def start(self, estimator: Estimator) -> Estimator:
        sd = runs.initial_sd(estimator.model, self.sd, 0.2, 3.0)
        size = estimator.model.size
        estimator.initialise(0, 0, self.nav, np.zeros(size), np.diag(sd**2))
        return estimator

    def run(self, estimator: Estimator, count: int | None = None) -> list[Outcome]:
        """Apply the measurements in order of validity."""
        self.start(estimator)
        buffer = runs.filled_buffer(IMU, self.times, self.samples)
        outcomes = []
        for measurement in self.measurements[:count]:
            estimator.propagate(buffer, measurement.t_ns)
            if isinstance(measurement, HeldFeedback):
                estimator.release()
            elif isinstance(measurement, RdssPositionMeasurement):
                estimator.hold()
            outcomes.append(estimator.update(measurement))
        if count is None:
            estimator.propagate(buffer, buffer.latest_ns)
        return outcomes


@lru_cache(maxsize=1)
def drive() -> Drive:
    return Drive()


def make(mode: Mode, names: tuple[str, ...] = NAMES, **options: Any) -> FederatedFilter:
    model, _ = runs.make_estimator("ins21", IMU)
    return federated(model, IMU.gap_s, names, FederatedOptions(mode=mode, **options))


@lru_cache(maxsize=1)
def centralised() -> tuple[KalmanEstimator, list[Outcome]]:
    _, estimator = runs.make_estimator("ins21", IMU)
    return estimator, drive().run(estimator)


def distance(estimator: Estimator, other: Estimator) -> tuple[float, float]:
    """How far two solutions are apart, in sigmas of the navigation errors, and their sigmas, as a
    ratio minus 1."""
    sigma = np.sqrt(np.diag(other.covariance)[:9])
    apart = runs.nav_error(estimator.nav, other.nav) / sigma
    ratio = np.sqrt(np.diag(estimator.covariance)[:9]) / sigma - 1.0
    return float(np.abs(apart).max()), float(np.abs(ratio).max())


# --------------------------------------------------------------------------- equality


@pytest.mark.parametrize(
    ("mode", "options", "within"),
    [
        ("fusion_reset", {}, 1e-8),
        ("fusion_reset", {"shares": (5.0, 2.0, 1.0)}, 1e-8),
        ("fusion_reset", {"adaptive": True}, 1e-8),
        ("zero_reset", {}, 1e-12),
    ],
)
def test_with_a_reset_it_is_the_centralised_filter(
    mode: Mode, options: dict[str, Any], within: float
) -> None:
    """To rounding: also while the feedback of a late fix is held, also through common
    measurements."""
    estimator = make(mode, **options)
    outcomes = drive().run(estimator)
    best, expected = centralised()
    assert [o.name for o in outcomes] == [o.name for o in expected]
    assert sum(o.name == "fused" for o in outcomes) > 100
    apart, ratio = distance(estimator, best)
    assert apart < within
    assert ratio < within
    assert [o.nis for o in outcomes] == pytest.approx([o.nis for o in expected], nan_ok=True)


@pytest.mark.parametrize("mode", MODES)
def test_one_local_filter_is_the_centralised_filter(mode: Mode) -> None:
    """Everything else is common to all then."""
    estimator = make(mode, ("gnss",))
    drive().run(estimator)
    apart, ratio = distance(estimator, centralised()[0])
    assert apart < (0.2 if mode == "rescale" else 1e-5)
    assert ratio < (0.2 if mode == "rescale" else 1e-5)


@pytest.mark.parametrize("mode", ["no_reset", "rescale"])
def test_without_a_reset_it_is_close_and_never_surer(mode: Mode) -> None:
    estimator = make(mode)
    drive().run(estimator)
    best = centralised()[0]
    apart, _ = distance(estimator, best)
    assert 1e-6 < apart < 2.0
    scale = np.sqrt(np.diag(best.covariance)[best.model.active])
    more = (estimator.covariance - best.covariance)[np.ix_(best.model.active, best.model.active)]
    assert np.linalg.eigvalsh(more / np.outer(scale, scale)).min() > -1e-2


@pytest.mark.parametrize("mode", ["no_reset", "rescale"])
def test_local_filters_fuse_to_what_is_published(mode: Mode) -> None:
    """After an update and its feedback the information of all adds up to the master's."""
    estimator = make(mode)
    drive().run(estimator, 60)
    assert isinstance(estimator, NoResetFilter)
    used = estimator.model.active
    infos, vectors = [], []
    parts = [estimator.local(name) for name in NAMES]
    if mode == "rescale":
        n = estimator.model.size
        parts.append((estimator._bank_dxs[-1], estimator._bank[-1, :n, :n]))
    unit = np.sqrt(np.diag(estimator.covariance)[used])
    for dx, p in parts:
        info = np.linalg.inv(p[np.ix_(used, used)] / np.outer(unit, unit))
        infos.append(info)
        vectors.append(info @ (dx[used] / unit))
    fused = np.linalg.inv(np.sum(infos, axis=0))
    expected = estimator.covariance[np.ix_(used, used)] / np.outer(unit, unit)
    assert fused == pytest.approx(expected, abs=1e-6)
    carried = estimator._dxs[0][used] / unit  # not zero while feedback is held
    assert fused @ np.sum(vectors, axis=0) == pytest.approx(carried, abs=1e-5)


# --------------------------------------------------------------------------- sharing factors


@pytest.mark.parametrize("mode", ["no_reset", "fusion_reset"])
def test_adaptive_factors_follow_the_better_source_and_sum_to_one(mode: Mode) -> None:
    estimator = make(mode, ("gnss", "rdss"), adaptive=True)
    assert estimator.shares == {"gnss": 0.5, "rdss": 0.5}
    drive().run(estimator)
    assert sum(estimator.shares.values()) == pytest.approx(1.0)
    assert estimator.shares["gnss"] > 0.6  # 1.5 m and velocity against 20 m
    assert estimator.shares["rdss"] > 0.02


def test_configured_factors_are_brought_to_a_sum_of_one() -> None:
    estimator = make("no_reset", ("gnss", "rdss"), shares=(3.0, 1.0))
    assert estimator.shares == {"gnss": 0.75, "rdss": 0.25}
    with pytest.raises(ValueError, match="share"):
        make("no_reset", shares=(1.0, 1.0))
    with pytest.raises(ValueError, match="at least one"):
        make("no_reset", ())


def test_which_filter_a_measurement_belongs_to() -> None:
    names = ("gnss", "gnss_b", "rdss")
    assert local_of("gnss", names) == 0
    assert local_of("gnss_velocity", names) == 0
    assert local_of("gnss_b", names) == 1
    assert local_of("gnss_b_velocity", names) == 1
    assert local_of("rdss_height", names) == 2
    for common in ("zero_velocity", "non_holonomic", "operator", "gnssx", "wheel"):
        assert local_of(common, names) is None


# --------------------------------------------------------------------------- numbers stay sound


@pytest.mark.parametrize("mode", MODES)
def test_a_source_that_never_speaks_or_sees_one_state_stays_finite(mode: Mode) -> None:
    """An hour of velocity alone beside position: the velocity's filter loses its position."""
    model, _ = runs.make_estimator("ins21", IMU)
    options = FederatedOptions(mode=mode)
    estimator = federated(model, 100.0, ("a", "v", "mute"), options)
    sd = runs.initial_sd(model, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    nav = runs.level_nav((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    estimator.initialise(0, 0, nav, np.zeros(model.size), np.diag(sd**2))
    buffer = ImuBuffer(1.0, 4000.0, np.eye(3), 0.0, 100.0)
    earth, g = 7.292115e-5, 9.7936
    force = dcm_from_quaternion(nav[6:]).T @ np.array([0.0, 0.0, -g])
    rate = earth * np.array([math.cos(nav[0]), 0.0, -math.sin(nav[0])])
    times = np.arange(1, 3601, dtype=np.int64) * runs.SECOND
    buffer.append(times, np.tile(np.concatenate([rate, force]), (3600, 1)))
    lat, lon, height = (float(x) for x in nav[:3])
    names = []
    for t in range(10, 3600, 5):
        t_ns = t * runs.SECOND
        estimator.propagate(buffer, t_ns)
        names.append(
            estimator.update(
                PositionMeasurement("a", t_ns, 0.999999, lat, lon, height, (3.0, 3.0, 3.0), ZERO)
                if t % 10
                else VelocityMeasurement("v", t_ns, 0.999999, ZERO, (0.1, 0.1, 0.1), ZERO)
            ).name
        )
    assert set(names) == {"fused"}
    assert estimator.isolated == {}
    sigma = estimator.sigmas()
    assert np.isfinite(sigma).all()
    assert (sigma[:3] < 3.0).all()
    p = estimator.covariance[np.ix_(model.active, model.active)]
    scale = np.sqrt(np.diag(p))
    assert np.linalg.eigvalsh(p / np.outer(scale, scale)).min() > -1e-9
    if isinstance(estimator, NoResetFilter):
        for name in ("v", "mute"):
            dx, cov = estimator.local(name)
            assert np.isfinite(dx).all()
            assert np.isfinite(cov).all()
            assert cov[6, 6] < 1e11 * p[6, 6]


def test_a_planar_model_leaves_out_what_it_has_not() -> None:
    model, _ = runs.make_estimator("planar15", IMU)
    estimator = federated(model, IMU.gap_s, ("a", "b"), FederatedOptions())
    drive().start(estimator)
    buffer = runs.filled_buffer(IMU, drive().times, drive().samples)
    estimator.propagate(buffer, runs.SECOND)
    lat, lon = (float(x) for x in estimator.nav[:2])
    measurement = PositionMeasurement(
        "a", runs.SECOND, 0.9999, lat, lon, None, (3.0, 3.0, 3.0), ZERO
    )
    assert estimator.update(measurement).name == "fused"
    assert estimator.covariance[5, 5] == estimator.covariance[8, 8] == 0.0


def test_a_measurement_that_is_no_number_changes_nothing() -> None:
    for mode in MODES:
        estimator = make(mode)
        drive().run(estimator, 20)
        before = estimator.snapshot()
        for source in ("gnss", "other"):
            bad = PositionMeasurement(
                source, estimator.t_ns, 0.9999, math.nan, 0.0, 0.0, (1.0, 1.0, 1.0), ZERO
            )
            assert estimator.update(bad).name == "not_finite"
        assert (estimator.snapshot().kept == before.kept).all()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("fault", ["", "step"])
def test_a_rewind_gives_the_same_bits(mode: Mode, fault: study.FaultKind) -> None:
    """Fixes of the second source come 1.7 s late, through isolation of the first."""
    rng = np.random.default_rng(2)
    measurements = [a for a in study.fixes(rng, fault) if 65e9 < a.t_ns < 82e9]
    model, _ = runs.make_estimator("ins15", study.STUDY_IMU)
    truth = study.truth()
    times = runs.sample_times(truth)
    first, last = np.searchsorted(times, [65_000_000_000, 84_000_000_000])
    samples = runs.imu_run(study.STUDY_IMU, truth, 4).samples[first:last]
    results = []
    for late_ns in (0, 1_700_000_000):
        options = FederatedOptions(mode=mode, adaptive=True)
        estimator = federated(model, 0.5, study.SOURCES, options)
        nav = runs.true_nav(truth, np.array([times[first - 1] * 1e-9]))[0]
        sd = study.initial_sd(model)
        start = int(times[first - 1])
        estimator.initialise(start, 0, nav, np.zeros(model.size), np.diag(sd**2))
        buffer = ImuBuffer(50.0, 40.0, np.eye(3), 0.0, 0.5)
        timeline = Timeline(estimator, buffer, 15.0, 0.5)
        timeline.start()
        waiting = sorted(
            measurements, key=lambda a: a.t_ns + late_ns * (a.source == study.SOURCES[1])
        )
        k = 0
        for row in range(0, len(samples), 5):
            buffer.append(times[first + row : first + row + 5], samples[row : row + 5])
            while k < len(waiting) and waiting[k].t_ns + late_ns * (
                waiting[k].source == study.SOURCES[1]
            ) <= int(times[min(first + row + 4, last - 1)]):
                timeline.insert(waiting[k])
                k += 1
            timeline.advance()
        assert k == len(waiting)
        assert (timeline.counters.rewinds > 0) == (late_ns > 0)
        results.append(estimator)
    one, other = (e.snapshot() for e in results)
    assert results[0].isolated == results[1].isolated
    assert bool(results[0].isolated) == bool(fault)
    assert (one.kept == other.kept).all()
    first, second = cast("Any", one.extra), cast("Any", other.extra)
    assert first.records == second.records
    for a, b in zip(first.arrays, second.arrays, strict=True):
        assert np.array_equal(a, b)
