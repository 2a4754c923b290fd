"""Noise in the place of accelerometer biases: its density, its interval, the tilt it leaves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are, solve_discrete_are, solve_discrete_lyapunov

from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.models.blocks import ImuNoise
from fusiond.models.catalogue import make_model
from fusiond.models.unmodelled_bias_noise import (
    density_of,
    tilt_memory_s,
    with_force_biases_as_noise,
)
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigator.alignment.start import Levelled, Place, build_start
from fusiond.simulation.markov import gauss_markov

Row = tuple[float, float, float]
CLASSES = [Imu(sensor_class=name) for name in ("consumer", "mems", "tactical")]


@pytest.mark.parametrize(("tau_s", "interval_s"), [(50.0, 400.0), (50.0, 50.0), (1e6, 20.0)])
def test_density_is_the_variance_of_the_integral(tau_s: float, interval_s: float) -> None:
    """Of drawn biases; 4000 of them know a variance to 9 % with 99.99 %."""
    rng = np.random.default_rng(3)
    step_s, runs = interval_s / 1000.0, 4000
    markov = gauss_markov(rng, (1000, runs), step_s=step_s, correlation_s=tau_s, sigma=0.3)
    constant = 0.2 * rng.standard_normal(runs)
    velocity = (markov + constant).sum(axis=0) * step_s
    found = float(np.mean(velocity**2)) / interval_s
    assert density_of(0.2, 0.3, tau_s, interval_s) == pytest.approx(found, rel=0.09)


def test_density_between_its_limits() -> None:
    short, long = density_of(0.0, 0.3, 100.0, 1e-3), density_of(0.0, 0.3, 100.0, 1e9)
    assert short == pytest.approx(0.09 * 1e-3, rel=1e-4)
    assert long == pytest.approx(2.0 * 0.09 * 100.0, rel=1e-4)
    # The series and the formula meet.
    below, above = (density_of(0.1, 0.3, 100.0, 100.0 * x) for x in (0.99e-4, 1.01e-4))
    assert above / below == pytest.approx(1.01 / 0.99, rel=1e-6)


@pytest.mark.parametrize("imu", CLASSES)
def test_memory_is_when_the_gyro_has_lost_the_tilt(imu: Imu) -> None:
    noise = imu_noise(imu)
    t = tilt_memory_s(noise)
    walk = 2.0 * noise.rate_bias_instability**2 / noise.bias_correlation_s
    wandered = noise.rate_noise**2 * t + walk * t**3 / 3.0
    bias = math.hypot(noise.force_bias_initial, noise.force_bias_instability)
    assert math.sqrt(wandered) == pytest.approx(bias / STANDARD_GRAVITY_M_S2, rel=1e-9)


@pytest.mark.parametrize("imu", CLASSES)
def test_steady_tilt_is_that_of_the_bias(imu: Imu) -> None:
    """Tilt and drift on one axis, the velocity's derivative felt with the noise: the Riccati
    equation's sigma is b / g, or a third more."""
    noise = imu_noise(imu)
    bias = math.hypot(noise.force_bias_initial, noise.force_bias_instability)
    sensed = with_force_biases_as_noise(noise).force_noise ** 2 / STANDARD_GRAVITY_M_S2**2
    tau_s = noise.bias_correlation_s
    f = np.array([[0.0, 1.0], [0.0, -1.0 / tau_s]])
    q = np.diag([noise.rate_noise**2, 2.0 * noise.rate_bias_instability**2 / tau_s])
    scale = np.diag([bias / STANDARD_GRAVITY_M_S2, noise.rate_bias_instability])
    back = np.linalg.inv(scale)
    h = np.array([[1.0], [0.0]])
    p = solve_continuous_are((back @ f @ scale).T, scale @ h, back @ q @ back, np.array([[sensed]]))
    assert 0.9 < math.sqrt(p[0, 0]) < 1.34


def test_without_a_bias_nothing_is_added() -> None:
    noise = replace(imu_noise(Imu()), force_bias_initial=0.0, force_bias_instability=0.0)
    assert with_force_biases_as_noise(noise) == noise


@pytest.mark.parametrize(
    ("name", "left_out_mg"),
    [("planar10", 10.0), ("ins17", 10.0), ("planar15", 0.0), ("ins21", 0.0)],
)
def test_a_level_is_wrong_by_the_bias_that_no_state_holds(name: str, left_out_mg: float) -> None:
    """10 mg are 0.57 deg. Where there is a state, the tilt of a start has it by correlation."""
    model = make_model(name, imu_noise(Imu()))
    bias = left_out_mg * 1e-3 * STANDARD_GRAVITY_M_S2
    assert model.force_left_out == pytest.approx(bias, rel=1e-3)
    place = Place(None, np.array([0.5, 2.0, 40.0]), 5.0, 5.0)
    start = build_start(
        *(model, 0, place, np.eye(3), 0.02, np.zeros(3), np.full(3, 0.1), "a test"),
        levelled=Levelled(np.eye(3)),
    )
    tilt = np.degrees(np.sqrt(np.diag(start.covariance)[:2]))
    assert tilt == pytest.approx([math.hypot(0.1, 0.573)] * 2, rel=0.01)
    p = start.covariance[np.ix_(model.active, model.active)]
    assert np.linalg.eigvalsh(p).min() > -1e-12


def test_a_gyrocompass_is_wrong_by_it_as_well() -> None:
    model = make_model("planar10", imu_noise(Imu()))
    place = Place(None, np.array([0.8, 2.0, 40.0]), 5.0, 5.0)
    start = build_start(
        *(model, 0, place, np.eye(3), 0.0, np.zeros(3), np.full(3, 0.1), "a test"),
        levelled=Levelled(np.eye(3)),
        compassed=True,
    )
    p, tilt = start.covariance, model.force_left_out / STANDARD_GRAVITY_M_S2
    assert p[0, 2] == pytest.approx(-math.tan(0.8) * tilt**2, rel=0.01)


def test_only_the_model_without_the_states_has_the_noise() -> None:
    noise: ImuNoise = imu_noise(Imu(sensor_class="mems"))
    whites = {
        name: next(b for b in make_model(name, noise).blocks if b.name == "velocity").white
        for name in ("ins15", "ins17", "ins20", "ins23")
    }
    plain = noise.force_noise**2
    assert whites["ins15"] == whites["ins20"] == whites["ins23"] == plain
    assert whites["ins17"] > 100.0 * plain


def steady_nees(density: float, bias: float, gyro: float, velocity_sd: float, step_s: float) -> Row:
    """NEES of the tilt, and of the velocity before and after a measurement, of the steady filter.

    States v and phi with v' = g phi + force noise, phi' = gyro noise, v measured each `step_s`. The
    filter has white noise of `density` for a constant bias; the truth has the bias, whose steady
    effect is phi = -b / g and none on v."""
    g, h, r = STANDARD_GRAVITY_M_S2, step_s, velocity_sd**2
    f = np.array([[1.0, g * h], [0.0, 1.0]])
    walk = gyro**2 * np.array([[g * g * h**3 / 3.0, g * h * h / 2.0], [g * h * h / 2.0, h]])
    row = np.array([[1.0, 0.0]])
    before = solve_discrete_are(f.T, row.T, walk + np.diag([density * h, 0.0]), np.array([[r]]))
    gain = before[:, :1] / (before[0, 0] + r)
    kept = np.eye(2) - gain @ row
    after = kept @ before
    error = solve_discrete_lyapunov(kept @ f, kept @ walk @ kept.T + r * gain @ gain.T)
    drawn = f @ error @ f.T + walk
    tilt = (error[1, 1] + (bias / g) ** 2) / after[1, 1]
    return float(tilt), float(drawn[0, 0] / before[0, 0]), float(error[0, 0] / after[0, 0])


def test_no_density_is_honest_about_tilt_and_velocity_at_once() -> None:
    """A tactical unit whose velocity is measured to 0.02 m/s at 5 Hz, as by Doppler."""
    g, bias, gyro = STANDARD_GRAVITY_M_S2, 9.81e-3, math.radians(0.05 / 60.0)
    sd, step_s = 0.02, 0.2
    honest = [
        (0.7 <= tilt <= 1.4, 0.7 <= velocity <= 1.4)
        for tilt, velocity, _ in (
            steady_nees(q, bias, gyro, sd, step_s) for q in np.logspace(-9.0, 2.0, 111)
        )
    ]
    tilts, velocities = zip(*honest, strict=True)
    assert any(tilts)
    assert any(velocities)
    assert not any(t and v for t, v in honest)
    # The density that states the tilt's own size: between measurements it adds q h to a variance
    # to which the bias adds (b h)^2. Just after one the velocity is the measurement's. The tilt
    # errs by the bias, and by half as much again from the gyro.
    q = bias**2 * (bias / (g * gyro)) ** 2
    tilt, before, after = steady_nees(q, bias, gyro, sd, step_s)
    assert tilt == pytest.approx(1.5, abs=0.05)
    assert after == pytest.approx(1.0, abs=0.05)
    assert before == pytest.approx(sd**2 / (sd**2 + q * step_s), rel=0.1)
    assert before < 0.01
