"""Correlated fusion in the federated filter: the joint covariance is what theory says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.configuration.schema import Config
from fusiond.estimators.federated.correlated import CorrelatedFilter, best_combination
from fusiond.estimators.federated.fusion import fuse_correlated
from fusiond.estimators.federated.options import FederatedOptions
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.navigator.assembly import federated
from tests import runs
from tests.estimators.test_federated import IMU, NAMES, centralised, distance, drive
from tests.estimators.test_fusion import covariance, least_squares

Array = NDArray[np.float64]


def make(names: tuple[str, ...] = NAMES, **options: Any) -> CorrelatedFilter:
    model, _ = runs.make_estimator("ins21", IMU)
    made = federated(model, IMU.gap_s, names, FederatedOptions(fusion="correlated", **options))
    assert isinstance(made, CorrelatedFilter)
    return made


def parted(joint: Array, k: int) -> Array:
    """(k n, k n) as (k, k, n, n)."""
    n = len(joint) // k
    return joint.reshape(k, n, k, n).transpose(0, 2, 1, 3).copy()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_combination_is_least_squares(seed: int, count: int) -> None:
    rng, n = np.random.default_rng(seed), 3
    scales = np.tile([1e-5, 1.0, 300.0], count)
    joint = covariance(rng, count * n, scales)
    y = [rng.standard_normal(n) * scales[:n] for _ in range(count)]
    expected_x, expected_p = least_squares(
        [each / scales[:n] for each in y], joint / np.outer(scales, scales)
    )
    fused = best_combination(parted(joint, count))
    x = np.einsum("kij,kj->i", fused.weights, np.array(y))
    assert x / scales[:n] == pytest.approx(expected_x, rel=1e-6, abs=1e-7)
    unit = np.outer(scales[:n], scales[:n])
    assert fused.covariance / unit == pytest.approx(expected_p, rel=1e-6, abs=1e-8)


def test_combination_of_two_is_the_papers() -> None:
    joint = covariance(np.random.default_rng(8), 8, np.ones(8))
    parts = parted(joint, 2)
    x_1, x_2 = np.random.default_rng(9).standard_normal((2, 4))
    x, p = fuse_correlated(x_1, parts[0, 0], x_2, parts[1, 1], parts[0, 1])
    fused = best_combination(parts)
    assert fused.weights[0] @ x_1 + fused.weights[1] @ x_2 == pytest.approx(x, rel=1e-7)
    assert fused.covariance == pytest.approx(p, rel=1e-7, abs=1e-9)


def test_one_estimate_twice_is_that_estimate() -> None:
    p = covariance(np.random.default_rng(2), 3, np.ones(3))
    fused = best_combination(np.array([[p, p], [p, p]]))
    assert fused.covariance == pytest.approx(p)
    assert fused.weights.sum(axis=0) == pytest.approx(np.eye(3))


def test_each_local_filter_is_the_kalman_filter_of_its_source() -> None:
    """Of the same start and all of the noise; the rest of the bank does not touch it."""
    e = make(fault_detection=False)
    drive().run(e)
    for name in ("gnss", "rdss"):
        _, alone = runs.make_estimator("ins21", IMU)
        assert isinstance(alone, KalmanEstimator)
        measurements = drive().measurements
        own = [a for a in measurements if a.source.startswith(name) or a.source == "zero_rate"]
        d = drive()
        d.measurements = own
        try:
            d.run(alone)
        finally:
            d.measurements = measurements
        dx, cov = e.local(name)
        sigma = np.sqrt(np.diag(alone.covariance)[:9])
        there = runs.nav_error(e.nav, alone.nav) - dx[:9]
        # It is linear about the common solution, which the lone filter does not know.
        assert np.abs(there / sigma).max() < 0.05, name
        assert np.sqrt(np.diag(cov)[:9]) == pytest.approx(sigma, rel=0.02)


def test_it_is_near_the_centralised_filter_and_above_its_covariance() -> None:
    e = make()
    drive().run(e)
    central, _ = centralised()
    apart, _ = distance(e, central)
    assert apart < 1.0
    ratio = np.sqrt(np.diag(e.covariance)[:9] / np.diag(central.covariance)[:9])
    assert ratio.min() > 0.999
    assert ratio.max() < 1.15


def test_one_local_filter_is_the_centralised_one() -> None:
    """All is common to it, as no measurement has its name: gains into all, with their noise in
    common."""
    e = make(names=("nobody",))
    drive().run(e)
    apart, ratio = distance(e, centralised()[0])
    assert apart < 1e-5
    assert ratio < 1e-5


def test_what_is_common_to_all_makes_them_the_same() -> None:
    e = make(names=("nobody", "none"))
    drive().run(e)
    apart, ratio = distance(e, centralised()[0])
    assert apart < 1e-4
    assert ratio < 1e-4


def test_a_rewind_gives_the_same_bits() -> None:
    e = make()
    d = drive()
    d.run(e, 12)
    kept = e.snapshot()
    buffer = runs.filled_buffer(IMU, d.times, d.samples)

    def go_on() -> tuple[bytes, bytes, bytes]:
        for measurement in d.measurements[12:30]:
            e.propagate(buffer, measurement.t_ns)
            e.update(measurement)
        return e.nav.tobytes(), e.covariance.tobytes(), e.local("gnss")[1].tobytes()

    first = go_on()
    e.restore(kept)
    assert go_on() == first


def test_a_configuration_says_what_does_not_go_together() -> None:
    def section(**federated: Any) -> dict[str, Any]:
        aiding = {"gnss": {"kind": "gnss"}}
        return {
            "aiding": aiding,
            "estimator": {
                "filter": "federated",
                "federated": {"fusion": "correlated", **federated},
            },
        }

    Config.model_validate(section())
    for wrong in ({"mode": "rescale"}, {"sharing": "adaptive"}, {"shares": {"gnss": 1.0}}):
        with pytest.raises(ValueError, match="correlated"):
            Config.model_validate(section(**wrong))
