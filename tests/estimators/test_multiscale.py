"""The multi-scale filter: against the ordinary one, through the timeline and the navigator."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.load import ConfigError, load_config
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.multiscale.filter import MultiscaleEstimator
from fusiond.models.catalogue import make_model
from fusiond.navigator.assembly import estimator_of
from fusiond.navigator.timeline import Timeline
from tests import runs
from tests.estimators.town_drive import IMU, LEVER, SD_V, begun, drive, run
from tests.navigator import vehicle

Array = NDArray[np.float64]


# --------------------------------------------------------------------------- estimator


def test_one_scale_is_the_ordinary_filter() -> None:
    model, buffer, measurements, start, sd = drive()
    one, ordinary = MultiscaleEstimator(model, IMU.gap_s, 1), KalmanEstimator(model, IMU.gap_s)
    for estimator in (one, ordinary):
        begun(estimator, start, sd)
        run(estimator, buffer, measurements)
        estimator.propagate(buffer, buffer.latest_ns)
    np.testing.assert_allclose(one.nav, ordinary.nav, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(one.xi, ordinary.xi, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(one.covariance, ordinary.covariance, rtol=1e-7, atol=1e-15)
    np.testing.assert_allclose(one.sigmas(), ordinary.sigmas(), rtol=1e-9)


@pytest.mark.parametrize("scales", [2, 3])
def test_the_start_is_the_ordinary_filter_and_then_blocks_take_over(scales: int) -> None:
    model, buffer, measurements, start, sd = drive()
    block = MultiscaleEstimator(model, IMU.gap_s, scales)
    ordinary = KalmanEstimator(model, IMU.gap_s)
    begun(block, start, sd)
    begun(ordinary, start, sd)
    first = 2**scales - 1
    for estimator in (block, ordinary):
        run(estimator, buffer, measurements[:first])
    np.testing.assert_allclose(block.nav, ordinary.nav, rtol=1e-12)
    np.testing.assert_allclose(block.covariance, ordinary.covariance, rtol=1e-9, atol=1e-18)
    for estimator in (block, ordinary):
        run(estimator, buffer, measurements[first : first + 2])
    ratio = np.diag(block.covariance) / np.diag(ordinary.covariance)
    assert np.abs(ratio - 1.0).max() > 1e-5


@pytest.mark.parametrize("wavelet", ["db2", "sym4", "coif1"])
def test_the_wavelet_changes_nothing_but_rounding(wavelet: str) -> None:
    model, buffer, measurements, start, sd = drive()
    found = []
    for name in ("haar", wavelet):
        estimator = MultiscaleEstimator(model, IMU.gap_s, 3, name)
        begun(estimator, start, sd)
        run(estimator, buffer, measurements)
        found.append(estimator)
    np.testing.assert_allclose(found[0].nav, found[1].nav, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found[0].covariance, found[1].covariance, rtol=1e-6, atol=1e-14)


@pytest.mark.parametrize("scales", [1, 2, 4])
def test_feedback_and_carrying_give_the_same_where_all_is_linear(scales: int) -> None:
    """Errors a ten-thousandth of what the filter expects: second-order terms are out of sight."""
    model, buffer, measurements, start, sd = drive(noise=1e-4)
    closed = MultiscaleEstimator(model, IMU.gap_s, scales)
    held = MultiscaleEstimator(model, IMU.gap_s, scales)
    turns = MultiscaleEstimator(model, IMU.gap_s, scales)
    for estimator in (closed, held, turns):
        begun(estimator, start, sd)
    held.hold()
    run(closed, buffer, measurements)
    run(held, buffer, measurements)
    for k, epoch in enumerate(measurements):  # held from time to time, released between two epochs
        if k % 3 == 1:
            turns.hold()
        run(turns, buffer, [epoch])
        if k % 3 == 2:
            turns.propagate(buffer, epoch[0].t_ns + 400_000_000)
            turns.release()
    for estimator in (closed, held, turns):
        estimator.propagate(buffer, buffer.latest_ns)
    held.release()
    turns.release()
    # Against what the estimate has changed in all: metres, metres a second, radians.
    unaided = MultiscaleEstimator(model, IMU.gap_s, scales)
    begun(unaided, start, sd)
    unaided.propagate(buffer, buffer.latest_ns)
    moved = np.abs(runs.nav_error(closed.nav, unaided.nav))
    for other in (held, turns):
        apart = np.abs(runs.nav_error(other.nav, closed.nav))
        assert (apart < 1e-3 * moved + 1e-9).all(), (apart, moved)
        np.testing.assert_allclose(other.xi, closed.xi, rtol=1e-2, atol=1e-10)


def test_measurements_of_an_instant_are_one_epoch_in_any_order() -> None:
    model, buffer, measurements, start, sd = drive()
    found = []
    for order in (1, -1):
        estimator = MultiscaleEstimator(model, IMU.gap_s, 2)
        begun(estimator, start, sd)
        run(estimator, buffer, [epoch[::order] for epoch in measurements])
        assert estimator.epochs == 3
        found.append(estimator)
    np.testing.assert_allclose(found[0].covariance, found[1].covariance, rtol=1e-2, atol=1e-7)
    apart = runs.nav_error(found[0].nav, found[1].nav)
    assert (
        np.abs(apart[6:]).max() < 0.02
    )  # the second measurement is linearised at a corrected state


@pytest.mark.parametrize("at", [1, 4, 20])
def test_a_gated_measurement_leaves_nothing_behind(at: int) -> None:
    model, buffer, measurements, start, sd = drive()
    t_ns = measurements[at][0].t_ns
    bad = VelocityMeasurement("wild", t_ns, 0.999, (50.0, 0.0, 0.0), SD_V, LEVER)
    between = VelocityMeasurement("wild", t_ns + 300_000_000, 0.999, (50.0, 0.0, 0.0), SD_V, LEVER)
    clean, tried = (MultiscaleEstimator(model, IMU.gap_s, 2) for _ in range(2))
    for estimator in (clean, tried):
        begun(estimator, start, sd)
        run(estimator, buffer, measurements[:at])
        estimator.propagate(buffer, t_ns)
        if estimator is tried:
            assert tried.update(bad).name == "gated"
        run(estimator, buffer, [measurements[at]])
        if estimator is tried:
            assert tried.update(bad).name == "gated"
        estimator.propagate(buffer, between.t_ns)
        if estimator is tried:
            outcome = tried.update(between)
            assert outcome.name == "gated"
            assert outcome.degrees == 3
            assert outcome.nis > 1e3
        run(estimator, buffer, measurements[at + 1 : at + 9])
    assert (clean.nav == tried.nav).all()
    assert (clean.covariance == tried.covariance).all()


def test_an_arrival_out_of_order_is_exact() -> None:
    """Through the timeline: late fixes rewind epochs, blocks and transition, bit for bit."""
    model, buffer, measurements, start, sd = drive()
    flat = [measurement for epoch in measurements for measurement in epoch]
    late = [measurement for k, measurement in enumerate(flat) if k % 5 != 2]
    found = []
    for order in (flat, late):
        estimator = MultiscaleEstimator(model, IMU.gap_s, 2)
        begun(estimator, start, sd)
        timeline = Timeline(estimator, buffer, keep_s=60.0, checkpoint_s=0.5)
        timeline.start()
        for measurement in order:
            timeline.insert(measurement)
        timeline.advance()
        for measurement in flat:
            if measurement not in order:
                timeline.insert(measurement)
                timeline.advance()
        found.append((estimator, timeline))
    (a, _), (b, rewound) = found
    assert rewound.counters.rewinds == len(flat) - len(late)
    assert (a.nav == b.nav).all()
    assert (a.xi == b.xi).all()
    assert (a.covariance == b.covariance).all()


def test_recording_tells_sigmas_and_changes_nothing() -> None:
    model, buffer, measurements, start, sd = drive()
    plain, recorded = (MultiscaleEstimator(model, IMU.gap_s, 2) for _ in range(2))
    for estimator in (plain, recorded):
        begun(estimator, start, sd)
        for epoch in measurements:
            estimator.propagate(buffer, epoch[0].t_ns, record=estimator is recorded)
            for measurement in epoch:
                estimator.update(measurement)
        estimator.propagate(buffer, buffer.latest_ns, record=estimator is recorded)
    assert (plain.nav == recorded.nav).all()
    assert (plain.covariance == recorded.covariance).all()
    np.testing.assert_allclose(buffer.sigmas[buffer.end - 1], recorded.sigmas(), rtol=1e-9)


def test_what_is_recorded_has_all_noise_since_the_last_epoch() -> None:
    model, buffer, measurements, start, sd = drive()
    estimator = MultiscaleEstimator(model, IMU.gap_s)
    begun(estimator, start, sd)
    run(estimator, buffer, measurements[:5])
    row = buffer.index_after(estimator.t_ns) + 40
    for k in (20, 40):  # nobody measures anything between
        estimator.propagate(buffer, int(buffer.times[row - 40 + k]), record=True)
    np.testing.assert_allclose(buffer.sigmas[row], estimator.sigmas(), rtol=1e-9)


def test_covariance_stays_symmetric_and_positive() -> None:
    model, buffer, measurements, start, sd = drive()
    estimator = MultiscaleEstimator(model, IMU.gap_s, 4)
    begun(estimator, start, sd)
    for epoch in measurements:
        run(estimator, buffer, [epoch])
        p = estimator.covariance
        assert (p == p.T).all()
        scale = np.sqrt(np.diag(p))
        assert np.linalg.eigvalsh(p / np.outer(scale, scale)).min() > 0.0
    assert math.hypot(*scale[6:8]) < 1.5


# --------------------------------------------------------------------------- configuration


def test_configuration_chooses_scales_and_wavelet() -> None:
    config = Config.model_validate(
        {"estimator": {"filter": "multiscale", "multiscale": {"scales": 3, "wavelet": "db4"}}}
    )
    estimator = estimator_of(config, make_model("ins15", imu_noise(config.imu)))
    assert isinstance(estimator, MultiscaleEstimator)
    assert estimator.length == 4


def test_in_the_navigator_whatever_the_delays() -> None:
    """The drive of the navigator's tests, constraints included; measurements up to 8 s late."""
    d = vehicle.drive()
    data = {**vehicle.CONFIG, "estimator": {"buffer_s": 12.0, "filter": "multiscale"}}
    rng = np.random.default_rng(1)
    late = rng.choice([0.0, 0.1, 1.5, 8.0], len(d.measurements)).tolist()
    found = []
    for delays in ([0.0] * len(late), late):
        navigator, row = vehicle.started(data)
        vehicle.feed(navigator, row, [7], delays)
        found.append(navigator)
    on_time, delayed = found
    assert isinstance(on_time.estimator, MultiscaleEstimator)
    assert vehicle.state_bytes(on_time) == vehicle.state_bytes(delayed)
    outcomes = vehicle.outcomes_of(on_time)
    assert outcomes == vehicle.outcomes_of(delayed)
    assert outcomes["gnss"]["fused"] == outcomes["wheel"]["fused"] == 34
    assert outcomes["non_holonomic"]["fused"] > 60
    true = runs.true_nav(d.truth, np.array([vehicle.SECONDS]))[0]
    error = runs.nav_error(on_time.estimator.nav, true)
    assert np.abs(error[6:]).max() < 1.0
    assert np.abs(error[3:6]).max() < 0.2


@pytest.mark.parametrize(("key", "value"), [("wavelet", '"bior2.2"'), ("scales", "5")])
def test_configuration_refuses_what_cannot_be(key: str, value: str, tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_text(f"[estimator.multiscale]\n{key} = {value}\n")
    with pytest.raises(ConfigError, match=f"estimator.multiscale.{key}"):
        load_config(path)
