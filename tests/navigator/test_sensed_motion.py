"""What the IMU felt between fixes: its slopes against differences, and a copy of the past."""

import numpy as np
import pytest

from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.motion_descent import judge_guess, least_squares, moved
from fusiond.navigation.rotation import dcm_from_rpy
from fusiond.navigator.alignment import motion_fit, sensed_motion

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


def shifted(imu: ImuBuffer, force: np.ndarray) -> sensed_motion.Span:
    samples = imu.samples[: imu.end].copy()
    samples[:, 3:] -= force
    return sensed_motion.Span(imu.times[: imu.end].copy(), samples)


def test_slopes_by_biases_are_those_of_differences(imu: ImuBuffer) -> None:
    at, step = instants(imu), 1e-4
    bias = np.array([0.01, -0.02, 0.03])
    f = sensed_motion.sensed(imu, at, bias)
    for axis in range(3):
        unit = np.eye(3)[axis] * step
        ahead = sensed_motion.sensed(shifted(imu, unit), at, bias)
        behind = sensed_motion.sensed(shifted(imu, -unit), at, bias)
        slope = (ahead.gained - behind.gained) / (2.0 * step)
        assert f.slopes[:, :, axis] == pytest.approx(slope, abs=1e-6)
        ahead, behind = (
            sensed_motion.sensed(imu, at, bias + unit),
            sensed_motion.sensed(imu, at, bias - unit),
        )
        slope = (ahead.gained - behind.gained) / (2.0 * step)
        # Of 600 m/s per rad/s: steps of 10 ms are of the first order.
        assert f.slopes[:, :, 3 + axis] == pytest.approx(slope, abs=0.05)
        turn = (ahead.turned[-1] - behind.turned[-1]) @ f.turned[-1].T / (2.0 * step)
        assert f.turns[:, axis] == pytest.approx([turn[2, 1], turn[0, 2], turn[1, 0]], abs=1e-3)


def test_rates_at_fixes_are_the_means_around_them(imu: ImuBuffer) -> None:
    at = instants(imu)
    rates = sensed_motion.sensed(imu, at, np.zeros(3)).rates
    means = [sensed_motion.samples_at(imu, int(t_ns))[:3] for t_ns in at]
    assert rates == pytest.approx(np.array(means), abs=1e-12)


LATE_S, SD_M_S = 0.09, 0.03
DOWN = np.array([0.0, 0.0, -9.8])


def pulling_off() -> tuple[ImuBuffer, sensed_motion.Measured]:
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
    return buffer, sensed_motion.Measured((BEGIN_NS + at * 1e9).astype(np.int64), v, sd, levers)


@pytest.mark.parametrize("sd_late_s", [0.0, 0.1])
def test_velocities_that_are_late_tilt_nobody_who_asks_whether_they_are(sd_late_s: float) -> None:
    """What tilt and force bias make together is known to some mm/s^2: is it right?"""
    imu, m = pulling_off()
    noise = imu_noise(Imu())
    f = sensed_motion.sensed(imu, m.instants, sensed_motion.rate_before_motion(imu, m))
    found = motion_fit.fit(imu, f, m, noise, 9.8, 0.0, 0.02, sd_late_s)
    h = np.zeros((2, 10))
    h[:, :2] = 9.8 * np.array([[0.0, 1.0], [-1.0, 0.0]])
    h[:, 3:6] = found.dcm[:2]
    # phi is computed minus true, as the bias is true minus computed.
    wrong = (found.dcm @ (-found.biases[:3] + [0.0, 0.0, -9.8]))[:2]
    nees = wrong @ np.linalg.solve(h @ found.covariance @ h.T, wrong)
    if sd_late_s == 0.0:
        assert found.delay_s == found.covariance[9, 9] == 0.0
        assert nees > 25.0
        return
    assert nees < 9.0
    sd_s = np.sqrt(found.covariance[9, 9])
    assert sd_s < 0.03
    assert abs(found.delay_s - LATE_S) < 3.0 * sd_s


def test_what_a_guess_says_moves_by_its_slopes(imu: ImuBuffer) -> None:
    """Of a vehicle that turns, with a lever, where the integrals were made with the biases (else by
    BENT_RAD) and nothing is late: how a tilt turns what 0.1 s of 12 have gained is left out."""
    rng = np.random.default_rng(5)
    at = instants(imu)
    v, levers = rng.normal(0.0, 5.0, (len(at), 3)), np.tile((1.4, 0.2, -1.2), (len(at), 1))
    m = sensed_motion.Measured(at, v, np.full(v.shape, 0.1), levers)
    f = sensed_motion.sensed(imu, at, np.array([0.01, -0.02, 0.03]))
    asked = motion_fit.Asked(imu_noise(Imu()), 9.8, 0.3, np.full(10, 0.1), 0.1)
    guess = motion_fit.Guess(dcm_from_rpy(0.02, -0.03, 0.4), f.biases, 0.0, v[0])
    packed = guess.packed()

    def judged(guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z, rows = np.empty(3 * len(at) + 10), np.empty((3 * len(at) + 10, 13))
        made = (f.of.t_s, f.of.means, f.gained, f.turned, f.slopes, f.biases)
        judge_guess(*made, v, m.sd, levers, asked.packed(), guess, z, rows)
        return z, rows

    _, rows = judged(packed)
    h = 1e-5
    for column, step in enumerate(h * np.eye(13)):
        ahead, behind = np.empty(19), np.empty(19)
        moved(packed, step, ahead)
        moved(packed, -step, behind)
        slope = (judged(behind)[0] - judged(ahead)[0]) / (2.0 * h)
        assert rows[:, column] == pytest.approx(slope, abs=3e-3 * abs(slope).max())


def test_least_squares_are_those_of_numpy() -> None:
    rng = np.random.default_rng(6)
    rows, z, step = rng.standard_normal((40, 13)), rng.standard_normal(40), np.empty(13)
    rows *= np.logspace(-4, 4, 13)
    assert least_squares(rows, z, step)
    expected = np.linalg.lstsq(rows / np.logspace(-4, 4, 13), z, rcond=None)[0]
    assert step * np.logspace(-4, 4, 13) == pytest.approx(expected, rel=1e-9)
    rows[:, 5] = 0.0
    assert not least_squares(rows, z, step)


def test_rate_before_motion() -> None:
    imu, m = pulling_off()
    imu.samples[:, :3] = 0.05, -0.02, 0.01
    assert sensed_motion.rate_before_motion(imu, m) == pytest.approx([0.05, -0.02, 0.01])
    moving = m._replace(velocity=m.velocity + 1.0)
    assert not sensed_motion.rate_before_motion(imu, moving).any()


def test_a_span_is_felt_as_the_buffer_it_was_taken_from(imu: ImuBuffer) -> None:
    at, none = instants(imu), np.zeros(3)
    span = sensed_motion.span_since(imu, int(at[0]))
    assert len(span.times) < imu.end
    there, here = sensed_motion.sensed(span, at, none), sensed_motion.sensed(imu, at, none)
    assert np.array_equal(there.gained, here.gained)
    assert there.rates == pytest.approx(here.rates, abs=1e-12)


@pytest.mark.parametrize("seed", range(24))
def test_gyros_that_nobody_calibrated_lead_no_fit_astray(seed: int) -> None:
    """Straight on at 6 m/s for 17 s, of which a gyro with 6 deg/s of bias makes 100 deg."""
    rng = np.random.default_rng(seed)
    n, spare = round(RATE_HZ * 17.5), imu_noise(Imu(sensor_class="consumer"))
    rate, force = (sd * rng.standard_normal(3) for sd in (0.05, spare.force_bias_initial))
    rate[:2] = np.sign(rate[:2]) * (0.1, 0.02)
    samples = np.tile([*rate, *(force + DOWN)], (n, 1))
    samples[:, :3] += spare.rate_noise * np.sqrt(RATE_HZ) * rng.standard_normal((n, 3))
    samples[:, 3:] += spare.force_noise * np.sqrt(RATE_HZ) * rng.standard_normal((n, 3))
    times = BEGIN_NS + (np.arange(1, n + 1) / RATE_HZ * 1e9).astype(np.int64)
    past = sensed_motion.Span(times, samples)
    at = BEGIN_NS + (np.arange(0.2, 17.3, 0.9) * 1e9).astype(np.int64)
    v = np.array([6.0, 0.0, 0.0]) + 0.05 * rng.standard_normal((len(at), 3))
    m = sensed_motion.Measured(
        at, v, np.full(v.shape, 0.05), np.tile((1.4, 0.2, -1.2), (len(at), 1))
    )
    f = sensed_motion.sensed(past, at, sensed_motion.rate_before_motion(past, m))
    for yaw in (0.0, np.pi):
        found = motion_fit.fit(past, f, m, spare, 9.8, yaw, np.radians(5.0), 0.1)
        assert found.converged
        assert found.cost < 2.0 * found.degrees
        turn = dcm_from_rpy(0.0, 0.0, yaw) @ found.dcm.T
        tilt = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0]])
        wrong, p = rate - found.biases[3:], found.covariance
        # 99.9 % of 24 seeds and two ways each.
        assert tilt @ np.linalg.solve(p[:2, :2], tilt) < 22.0
        assert wrong @ np.linalg.solve(p[6:9, 6:9], wrong) < 24.0
