"""Error-state models: the papers' state lists, blocks of clocks, both row widths of the kernels."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.blocks import clock_blocks, misalignment
from fusiond.models.catalogue import MODELS, make_model
from fusiond.models.model import Model
from tests import runs

IMU = Imu(rate_hz=50.0)
SIZES = {
    "planar10": 10,
    "planar15": 15,
    "ins15": 15,
    "ins17": 17,
    "ins20": 20,
    "ins21": 21,
    "ins23": 23,
}


def states(model: Model) -> int:
    return sum(len(block.states) for block in model.blocks)


@pytest.mark.parametrize("name", MODELS)
def test_models_have_the_papers_number_of_states(name: str) -> None:
    model = make_model(name, imu_noise(IMU))
    assert states(model) == SIZES[name]
    assert int(model.active.sum()) == SIZES[name]


def test_a_further_block_takes_the_place_of_its_namesake() -> None:
    model = make_model("ins23", imu_noise(IMU), *clock_blocks(("G", "C")))
    assert states(model) == 24
    assert model.slots_of("clock_offset") == [18, 19]
    assert model.rate_terms.tolist() == [[18, 19], [20, 20]]


def test_slots_of_blocks_that_a_model_has_not() -> None:
    model = make_model("ins23", imu_noise(IMU), *clock_blocks(("G", "C")))
    assert model.slots_or_missing(("clock_offset", 2), ("elsewhere", 1)).tolist() == [18, 19, -1]
    offset, nothing = model.slots_of_each(("clock_offset",), ("elsewhere", ""))
    assert (offset.tolist(), nothing.tolist()) == ([18, 19], [])


def test_more_states_than_the_kernels_hold() -> None:
    with pytest.raises(ValueError, match="at most 40 fit"):
        make_model("ins23", imu_noise(IMU), *(misalignment(f"m{k}", 1e-3) for k in range(6)))


def started(model: Model) -> KalmanEstimator:
    estimator = KalmanEstimator(model, IMU.gap_s)
    sd = runs.initial_sd(model, np.full(3, 0.01), 0.5, 5.0)
    nav = runs.level_nav((0.05, -0.02, 1.0), (8.0, 3.0, 0.2))
    estimator.initialise(0, 0, nav, np.zeros(model.size), np.diag(sd**2))
    return estimator


def moved(model: Model, seconds: float = 4.0) -> KalmanEstimator:
    truth = runs.town_truth(seconds, IMU.rate_hz)
    run = runs.imu_run(IMU, truth, 3)
    buffer = runs.filled_buffer(IMU, runs.sample_times(truth), run.samples)
    estimator = started(model)
    estimator.propagate(buffer, buffer.latest_ns)
    return estimator


@pytest.mark.parametrize(
    ("name", "more", "widths"),
    [("ins15", 2, (20, 24)), ("ins17", 4, (20, 32)), ("ins21", 3, (24, 32))],
)
def test_a_wide_covariance_holds_the_same_numbers_as_a_narrow_one(
    name: str, more: int, widths: tuple[int, int]
) -> None:
    noise = imu_noise(IMU)
    narrow = moved(make_model(name, noise))
    model = make_model(name, noise, *(misalignment(f"m{k}", 1e-3) for k in range(more)))
    wide = moved(model)
    n = narrow.model.size
    assert (narrow.model.width, model.width) == widths
    np.testing.assert_allclose(wide.nav, narrow.nav, rtol=0, atol=0)
    np.testing.assert_allclose(wide.covariance[:n, :n], narrow.covariance, rtol=1e-12)


def test_clock_offset_is_the_integral_of_its_drift() -> None:
    model = make_model("ins15", imu_noise(IMU), *clock_blocks(("G", "C")))
    estimator = moved(model, 4.0)
    t = estimator.t_ns * 1e-9
    offsets, drift = model.slots_of("clock_offset"), model.slots_of("clock_drift")[0]
    p = estimator.covariance
    # White noise of density w on a rate: variance w t, covariance w t^2 / 2, of the integral w t^3
    # / 3; to the first order in the sample interval.
    w, s, d = 0.04, 0.01, 300.0
    assert p[drift, drift] == pytest.approx(d**2 + w * t, rel=1e-9)
    for k in offsets:
        assert p[k, drift] == pytest.approx(d**2 * t + w * t**2 / 2, rel=1e-6)
        expected = 3e5**2 + d**2 * t**2 + s * t + w * t**3 / 3
        assert p[k, k] == pytest.approx(expected, rel=1e-9)
    between = d**2 * t**2 + w * t**3 / 3
    assert p[offsets[0], offsets[1]] == pytest.approx(between, rel=1e-6)


def test_clock_estimates_run_on() -> None:
    model = make_model("ins15", imu_noise(IMU), *clock_blocks())
    truth = runs.town_truth(3.0, IMU.rate_hz)
    run = runs.imu_run(IMU, truth, 3)
    buffer = runs.filled_buffer(IMU, runs.sample_times(truth), run.samples)
    estimator = started(model)
    offset, drift = model.slots_of("clock_offset")[0], model.slots_of("clock_drift")[0]
    estimator.xi[[offset, drift]] = 1000.0, -25.0
    estimator.propagate(buffer, buffer.latest_ns)
    t = estimator.t_ns * 1e-9
    assert estimator.xi[offset] == pytest.approx(1000.0 - 25.0 * t, abs=1e-6)
    assert estimator.xi[drift] == -25.0


def test_model_command_prints_states_units_noise_and_sigma() -> None:
    result = CliRunner().invoke(app, ["model", "ins23", "--json", "-"])
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    by_name = {state["name"]: state for state in report["states"]}
    assert len(by_name) == report["size"] == 23
    assert by_name["gyro_bias.x"]["unit"] == "rad/s"
    assert by_name["gyro_bias.x"]["initial_sigma"] == pytest.approx(math.radians(0.1))
    assert by_name["clock_offset.receiver"]["rate"] == "clock_drift"
    text = CliRunner().invoke(app, ["model", "planar10"]).stdout
    assert "planar10: 10 states, height held" in text
    assert "deg/h" in text


def test_model_command_names_what_there_is() -> None:
    result = CliRunner().invoke(app, ["model", "ins99"])
    assert result.exit_code == 2
    assert "ins15" in result.output


IMU_CSV = (
    "t_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2\n"
    "0.01,0,0,0,0,0,-9.8\n"
)
TOO_MANY = """
vehicle = "all"
[aiding.raw]
[aiding.gnss]
[aiding.rdss]
[aiding.star_tracker]
[aiding.sar]
targets_deg_m = { P1 = [30.0, 114.0, 20.0] }
"""


def test_a_model_that_outgrows_the_kernels_is_a_mistake_of_the_configuration(
    tmp_path: Path,
) -> None:
    config, imu = tmp_path / "all.toml", tmp_path / "imu.csv"
    config.write_text(TOO_MANY)
    imu.write_text(IMU_CSV)
    runner = CliRunner()
    for command in (
        ["check", "--compile", str(config)],
        ["model", "ins21", "--config", str(config)],
        ["process", str(config), "--imu", str(imu)],
    ):
        result = runner.invoke(app, command)
        assert result.exit_code == 78, command
        assert "states, at most 40" in result.stderr
        assert "sar_misalignment" in result.stderr
    assert "gnss_velocity_time" in result.stderr
    config.write_text(TOO_MANY + '[estimator]\nmodel = "ins15"\n')
    assert runner.invoke(app, ["check", "--compile", str(config)]).exit_code == 0


def test_ins20s_accelerometer_walks_as_its_markov_part_does() -> None:
    """Its whole variance, and 2 s^2 / tau: 0.1 mg of a MEMS unit, not its 10 mg at switch-on."""
    noise = imu_noise(Imu())
    block = next(b for b in make_model("ins20", noise).blocks if b.name == "accel_markov")
    whole = math.hypot(noise.force_bias_initial, noise.force_bias_instability)
    assert block.steady == block.initial == whole
    walk = 2.0 * noise.force_bias_instability**2 / noise.bias_correlation_s
    assert math.isclose(2.0 * block.steady**2 / block.tau_s, walk)
