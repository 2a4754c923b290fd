"""Sensor errors: units, statistics, determinism; and the files of `simulate`."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.configuration.schema import Config, Imu
from fusiond.files.measurement_csv import read_gnss, read_imu, read_rdss, read_truth
from fusiond.simulation.files import simulate
from fusiond.simulation.gnss.receiver import GnssOptions
from fusiond.simulation.markov import gauss_markov
from fusiond.simulation.scenarios import SCENARIOS, Scenario, random_streams
from fusiond.simulation.sensor_errors import Vibration, imu_output
from fusiond.simulation.trajectories import static
from tests.places import REPOSITORY

Array = NDArray[np.float64]
TINY = 1e-12
QUIET = Imu(
    rate_hz=100.0,
    gyro_noise_deg_sqrt_h=TINY,
    accel_noise_m_s_sqrt_h=TINY,
    gyro_bias_instability_deg_h=TINY,
    accel_bias_instability_mg=TINY,
    gyro_bias_initial_deg_h=TINY,
    accel_bias_initial_mg=TINY,
    gyro_scale_ppm=TINY,
    accel_scale_ppm=TINY,
)


def _allan_deviation(rate: Array, step_s: float, cluster: int) -> Array:
    """Non-overlapping Allan deviation of rates (n, columns) at cluster * step_s."""
    n = len(rate) // cluster
    means = rate[: n * cluster].reshape(n, cluster, -1).mean(axis=1)
    deviation: Array = np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2, axis=0))
    return deviation


@pytest.mark.parametrize("tau_s", [0.1, 1.0, 10.0])
def test_random_walk_comes_out_as_configured(tau_s: float) -> None:
    imu = QUIET.model_copy(update={"gyro_noise_deg_sqrt_h": 0.3, "accel_noise_m_s_sqrt_h": 0.1})
    zero = np.zeros((360_000, 3))
    output = imu_output(imu, zero, zero, np.random.default_rng(1))
    cluster = round(tau_s * imu.rate_hz)
    # Angle random walk N: Allan deviation N / sqrt(tau); n clusters leave 1 / sqrt(2 n).
    tolerance = 5.0 / math.sqrt(2.0 * len(zero) / cluster)
    gyro = _allan_deviation(output.gyro, 0.01, cluster) * math.sqrt(tau_s)
    np.testing.assert_allclose(np.degrees(gyro) * 60.0, 0.3, rtol=tolerance)
    accel = _allan_deviation(output.accel, 0.01, cluster) * math.sqrt(tau_s)
    np.testing.assert_allclose(accel * 60.0, 0.1, rtol=tolerance)


def test_gauss_markov_has_its_sigma_and_correlation() -> None:
    x = gauss_markov(
        np.random.default_rng(2), (4000, 500), step_s=1.0, correlation_s=50.0, sigma=2.0
    )
    assert x.std() == pytest.approx(2.0, rel=0.02)
    lagged = float(np.mean(x[:-50] * x[50:])) / float(np.mean(x * x))
    assert lagged == pytest.approx(math.exp(-1.0), abs=0.02)


def test_bias_is_a_turn_on_constant_and_a_markov_part() -> None:
    imu = QUIET.model_copy(
        update={
            "rate_hz": 1.0,
            "gyro_bias_initial_deg_h": 360.0,
            "gyro_bias_instability_deg_h": 10.0,
            "bias_correlation_s": 100.0,
        }
    )
    zero = np.zeros((1000, 3))
    runs = [imu_output(imu, zero, zero, np.random.default_rng(s)).gyro_bias for s in range(300)]
    deg_h = np.degrees(np.stack(runs)) * 3600.0
    for row in (0, 500, 999):
        assert deg_h[:, row].std() == pytest.approx(math.hypot(360.0, 10.0), rel=0.08)
    change = deg_h[:, 500] - deg_h[:, 400]
    assert change.std() == pytest.approx(10.0 * math.sqrt(2.0 * (1.0 - math.exp(-1.0))), rel=0.08)


def test_turn_on_bias_and_scale_are_in_data_sheet_units() -> None:
    imu = QUIET.model_copy(update={"gyro_bias_initial_deg_h": 360.0, "accel_bias_initial_mg": 10.0})
    one = np.ones((1, 3))
    outputs = [imu_output(imu, one, one, np.random.default_rng(s)) for s in range(400)]
    gyro = np.concatenate([o.gyro - 1.0 for o in outputs])
    accel = np.concatenate([o.accel - 1.0 for o in outputs])
    assert np.degrees(gyro.std()) * 3600.0 == pytest.approx(360.0, rel=0.06)
    assert accel.std() / 9.80665e-3 == pytest.approx(10.0, rel=0.06)
    np.testing.assert_allclose(outputs[0].gyro_bias, outputs[0].gyro - 1.0, atol=1e-12)
    scaled = QUIET.model_copy(update={"gyro_scale_ppm": 2000.0})
    errors = [imu_output(scaled, one, one, np.random.default_rng(s)).gyro for s in range(400)]
    assert np.std(np.concatenate(errors)) == pytest.approx(2e-3, rel=0.06)


def test_mounting_of_the_real_drive() -> None:
    """x backward, y right, z up; an extra -6.8 deg pitch, 5.4 deg yaw of the box."""
    imu = QUIET.model_copy(update={"axes": ("-x", "+y", "-z")})
    forward = np.array([[1.0, 0.0, 0.0]])
    down = np.array([[0.0, 0.0, 1.0]])
    output = imu_output(imu, down, forward, np.random.default_rng(0))
    np.testing.assert_allclose(output.accel, [[-1.0, 0.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(output.gyro, [[0.0, 0.0, -1.0]], atol=1e-9)
    turned = QUIET.model_copy(update={"mounting_deg": (0.0, 0.0, 90.0)})
    output = imu_output(turned, down, forward, np.random.default_rng(0))
    np.testing.assert_allclose(output.accel, [[0.0, -1.0, 0.0]], atol=1e-9)


def test_vibration_and_resolution() -> None:
    zero = np.zeros((20_000, 3))
    rng = np.random.default_rng(4)
    vibration = Vibration(accel_m_s2=2.0, frequency_hz=27.3)
    shaken = imu_output(QUIET, zero, zero, rng, vibration=vibration).accel
    average = math.sin(math.pi * 0.273) / (math.pi * 0.273)
    assert shaken.std() == pytest.approx(2.0 * average / math.sqrt(2.0), rel=1e-2)
    steps = imu_output(QUIET, zero, shaken, rng, accel_step_m_s2=0.01).accel / 0.01
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_streams_of_devices_are_independent() -> None:
    imu, gnss, rdss, raw = (rng.standard_normal(4) for rng in random_streams(7))
    again = random_streams(7)
    assert np.array_equal(gnss, again[1].standard_normal(4))
    assert not np.allclose(imu, gnss)
    assert not np.allclose(gnss, rdss)
    assert not np.allclose(gnss, raw)


# --------------------------------------------------------------------------- files


def test_simulate_writes_the_same_bytes_for_the_same_seed(tmp_path: Path) -> None:
    scenario = SCENARIOS["drive"]
    first = simulate(scenario, tmp_path / "a", seed=5, duration_s=70.0)
    again = simulate(scenario, tmp_path / "b", seed=5, duration_s=70.0)
    other = simulate(scenario, tmp_path / "c", seed=6, duration_s=70.0)
    for name, path in first.files.items():
        assert path.read_bytes() == again.files[name].read_bytes()
        assert (path.read_bytes() == other.files[name].read_bytes()) == (name == "truth")


def test_files_are_what_the_readers_accept(tmp_path: Path) -> None:
    scenario = Scenario("static", static, 60.0, gnss=GnssOptions(outages=((20.0, 10.0),)))
    written = simulate(scenario, tmp_path, seed=1)
    imu, gnss = read_imu(written.files["imu"]), read_gnss(written.files["gnss"])
    rdss, truth = read_rdss(written.files["rdss"]), read_truth(written.files["truth"])
    for table in (imu, gnss, rdss, truth):
        assert not table.rejected
    rows = {"imu": len(imu.t_s), "gnss": len(gnss.t_s), "rdss": len(rdss.t_s)}
    assert written.rows == rows | {"truth": len(truth.t_s)}
    assert rows["imu"] == 6_000
    assert rows["gnss"] == 500
    assert not np.any((gnss.t_s >= 20.0) & (gnss.t_s < 30.0))
    latency = gnss.t_arrival_s - gnss.t_s
    assert latency.min() >= 0.05 - 1e-5
    assert latency.max() < 0.2
    delay = rdss.t_arrival_s - rdss.t_s
    assert delay.min() >= 0.6 - 1e-5
    assert delay.max() <= 5.0 + 1e-5
    assert np.linalg.norm(imu.accel.mean(axis=0)) == pytest.approx(9.79, abs=0.3)
    error_m = (gnss.lat_rad - truth.lat_rad[0]) * 6.353e6
    assert error_m.std() == pytest.approx(0.8, rel=0.2)
    np.testing.assert_allclose(gnss.sd_position[0], [0.8, 0.8, 1.5])


@pytest.mark.parametrize(
    ("name", "scenario"),
    [
        ("vehicle", "drive"),
        ("vehicle", "static"),
        ("tactical", "flight"),
        ("flight_sar", "flight-sar"),
    ],
)
def test_scenarios_fit_the_shipped_configurations(name: str, scenario: str) -> None:
    path = REPOSITORY / "config" / f"{name}.toml"
    config = Config.model_validate(tomllib.loads(path.read_text()))
    assert SCENARIOS[scenario].fitted(config) == SCENARIOS[scenario]


def test_a_scenario_can_be_fitted_to_another_vehicle() -> None:
    config = Config.model_validate(
        {
            "imu": {"rate_hz": 50.0},
            "aiding": {"gnss": {"lever_arm_m": [1.0, 2.0, 3.0]}},
            "constraints": {"non_holonomic": {"enabled": True, "lever_arm_m": [-2.0, 0.0, 0.0]}},
        }
    )
    fitted = SCENARIOS["drive"].fitted(config)
    assert fitted.gnss.lever_arm_m == (1.0, 2.0, 3.0)
    assert fitted.rdss == SCENARIOS["drive"].rdss
    assert fitted.truth(10.0).path.arm_m == (2.0, 0.0, 0.0)
    assert len(fitted.truth(10.0).gyro) == 500
