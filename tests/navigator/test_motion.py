"""What the IMU felt between fixes: its slopes against differences, and a copy of the past."""

import numpy as np
import pytest

from fusiond.configuration.schema import Imu
from fusiond.configuration.settings import imu_noise
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


LATE_S, SD_M_S = 0.09, 0.03


def pulling_off() -> tuple[ImuBuffer, motion.Measured]:
    """Northward from rest to 12 m/s, level, the sensors perfect; velocities that are late."""
    n = round(RATE_HZ * SECONDS)
    t = np.arange(1, n + 1) / RATE_HZ
    buffer = ImuBuffer(RATE_HZ, 30.0, np.eye(3), 0.0, 0.3)
    samples = np.zeros((n, 6))
    samples[:, 3] = np.interp(t - 0.5 / RATE_HZ, [5.0, 6.0, 8.5, 9.5], [0.0, 3.0, 3.0, 0.0])
    samples[:, 5] = -9.8
    buffer.append((BEGIN_NS + t * 1e9).astype(np.int64), samples)
    at = np.arange(0.5, SECONDS - 0.5, 0.5)
    v = np.zeros((len(at), 3))
    v[:, 0] = np.interp(at + LATE_S, t, np.cumsum(samples[:, 3]) / RATE_HZ)
    v += SD_M_S * np.random.default_rng(2).standard_normal(v.shape)
    sd, levers = np.full(v.shape, SD_M_S), np.zeros(v.shape)
    return buffer, motion.Measured((BEGIN_NS + at * 1e9).astype(np.int64), v, sd, levers)


@pytest.mark.parametrize("sd_late_s", [0.0, 0.1])
def test_velocities_that_are_late_tilt_nobody_who_asks_whether_they_are(sd_late_s: float) -> None:
    """What tilt and force bias make together is known to some mm/s^2: is it right?"""
    imu, m = pulling_off()
    noise = imu_noise(Imu())
    f = motion.felt(imu, m.instants, motion.rate_before_motion(imu, m))
    found = motion.fit(imu, f, m, noise, 9.8, 0.0, 0.02, sd_late_s)
    h = np.zeros((2, 10))
    h[:, :2] = 9.8 * np.array([[0.0, 1.0], [-1.0, 0.0]])
    h[:, 3:6] = found.dcm[:2]
    # phi is computed minus true, as the bias is true minus computed.
    wrong = (found.dcm @ (-found.biases[:3] + [0.0, 0.0, -9.8]))[:2]
    nees = wrong @ np.linalg.solve(h @ found.covariance @ h.T, wrong)
    if sd_late_s == 0.0:
        assert found.late_s == found.covariance[9, 9] == 0.0
        assert nees > 25.0
        return
    assert nees < 9.0
    sd_s = np.sqrt(found.covariance[9, 9])
    assert sd_s < 0.03
    assert abs(found.late_s - LATE_S) < 3.0 * sd_s


def test_rate_before_motion() -> None:
    imu, m = pulling_off()
    imu.samples[:, :3] = 0.05, -0.02, 0.01
    assert motion.rate_before_motion(imu, m) == pytest.approx([0.05, -0.02, 0.01])
    moving = m._replace(velocity=m.velocity + 1.0)
    assert not motion.rate_before_motion(imu, moving).any()


def test_a_span_is_felt_as_the_buffer_it_was_taken_from(imu: ImuBuffer) -> None:
    at, none = instants(imu), np.zeros(3)
    span = motion.span_since(imu, int(at[0]))
    assert len(span.times) < imu.end
    there, here = motion.felt(span, at, none), motion.felt(imu, at, none)
    assert np.array_equal(there.gained, here.gained)
    assert there.rates == pytest.approx(here.rates, abs=1e-12)
