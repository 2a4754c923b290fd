"""What the IMU felt between fixes: its slopes against differences, and a copy of the past."""

import numpy as np
import pytest

from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.alignment import motion

RATE_HZ, SECONDS = 100.0, 12.0
BEGIN_NS = 7_000_000_000


@pytest.fixture(scope="module")
def imu() -> ImuBuffer:
    """A vehicle that brakes and takes a bend."""
    t = np.arange(1, round(RATE_HZ * SECONDS) + 1) / RATE_HZ
    buffer = ImuBuffer(RATE_HZ, 30.0, np.eye(3), 0.0, 0.3)
    samples = np.zeros((len(t), 6))
    samples[:, 0] = 0.05 * np.sin(2.0 * t)
    samples[:, 2] = 0.3 * np.sin(0.5 * t)
    samples[:, 3] = 1.5 * np.cos(0.7 * t)
    samples[:, 4] = 2.0 * np.sin(0.5 * t)
    samples[:, 5] = -9.81
    buffer.append((BEGIN_NS + t * 1e9).astype(np.int64), samples)
    return buffer


def instants(imu: ImuBuffer) -> np.ndarray:
    return imu.times[[50, 300, 301, 800, 1100]] + 3_000_000


def shifted(imu: ImuBuffer, force: np.ndarray) -> motion.Span:
    samples = imu.samples[: imu.end].copy()
    samples[:, 3:] -= force
    return motion.Span(imu.times[: imu.end].copy(), samples)


def test_slopes_by_biases_are_those_of_differences(imu: ImuBuffer) -> None:
    at, step = instants(imu), 1e-4
    bias = np.array([0.01, -0.02, 0.03])
    f = motion.felt(imu, at, bias)
    for axis in range(3):
        unit = np.eye(3)[axis] * step
        ahead = motion.felt(shifted(imu, unit), at, bias)
        behind = motion.felt(shifted(imu, -unit), at, bias)
        slope = (ahead.gained - behind.gained) / (2.0 * step)
        assert f.slopes[:, :, axis] == pytest.approx(slope, abs=1e-6)
        ahead, behind = motion.felt(imu, at, bias + unit), motion.felt(imu, at, bias - unit)
        slope = (ahead.gained - behind.gained) / (2.0 * step)
        # Of 600 m/s per rad/s: steps of 10 ms are of the first order.
        assert f.slopes[:, :, 3 + axis] == pytest.approx(slope, abs=0.05)
        turn = (ahead.turned[-1] - behind.turned[-1]) @ f.turned[-1].T / (2.0 * step)
        assert f.turns[:, axis] == pytest.approx([turn[2, 1], turn[0, 2], turn[1, 0]], abs=1e-3)


def test_rates_at_fixes_are_the_means_around_them(imu: ImuBuffer) -> None:
    at = instants(imu)
    rates = motion.felt(imu, at, np.zeros(3)).rates
    means = [motion.rate_at(imu, int(t_ns)) for t_ns in at]
    assert rates == pytest.approx(np.array(means), abs=1e-12)


def test_a_span_is_felt_as_the_buffer_it_was_taken_from(imu: ImuBuffer) -> None:
    at, none = instants(imu), np.zeros(3)
    span = motion.span_since(imu, int(at[0]))
    assert len(span.times) < imu.end
    there, here = motion.felt(span, at, none), motion.felt(imu, at, none)
    assert np.array_equal(there.gained, here.gained)
    assert there.rates == pytest.approx(here.rates, abs=1e-12)
