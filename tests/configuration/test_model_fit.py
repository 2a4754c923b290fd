"""What `check` and the daemon say of a model that lacks its sensor's errors, and that it is so."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.model_fit import MINUTE_S, after_a_minute, model_doubts
from fusiond.configuration.schema import ClockOptions, Config, Imu
from fusiond.configuration.sensor_class import CLASSES
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.live.chain import Chain
from fusiond.live.events import Events
from fusiond.models.catalogue import MODELS, make_model
from fusiond.outputs.messages.event import EventMessage
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import static
from tests import runs

FULL = ("ins15", "ins20", "ins21", "ins23", "planar15")
"""Models with states for the accelerometers' biases; `ins21` alone has some for scale factors."""


def configured(model: str, **imu: object) -> Config:
    return Config.model_validate({"imu": imu, "estimator": {"model": model}})


@pytest.mark.parametrize("kind", [None, *CLASSES])
@pytest.mark.parametrize("name", MODELS)
def test_each_model_with_each_class_says_what_it_lacks(name: str, kind: str | None) -> None:
    config = configured(name, **({} if kind is None else {"sensor_class": kind}))
    said, noise = list(model_doubts(config)), imu_noise(config.imu)
    biases = [text for text in said if "has no accelerometer bias" in text]
    scales = [text for text in said if "has no scale factors" in text]
    assert len(biases) == (0 if name in FULL else 1)
    assert len(scales) == (0 if name == "ins21" else 1)
    assert len(said) == len(biases) + len(scales)
    of = "[imu]" if kind is None else f"sensor class {kind!r}"
    assert all(of in text and "choose" in text for text in said)
    # With the number: what a bias does in a minute, and what a corner makes of the heading.
    bias = math.hypot(noise.force_bias_initial, noise.force_bias_instability)
    assert all(f"the bias does {0.5 * bias * 3600.0:,.0f} m" in text for text in biases)
    degrees = 90.0 * noise.rate_scale
    assert all(f"by {degrees:.2g} deg in a quarter turn" in text for text in scales)


def test_a_unit_without_bias_and_scale_factors_needs_no_state() -> None:
    """That of paper 001, whose 1e-3 g is white."""
    white = {
        "accel_noise_m_s_sqrt_h": 0.083,
        "accel_bias_initial_mg": 1e-9,
        "accel_bias_instability_mg": 1e-9,
        "gyro_scale_ppm": 1e-9,
    }
    for name in ("planar10", "ins17"):
        assert list(model_doubts(configured(name, **white))) == []


def test_the_figures_are_those_of_the_filter() -> None:
    """A minute at rest without measurements: what 10 mg moves, and what noise alone makes of
    sigma."""
    imu = Imu(rate_hz=20.0)
    model = make_model("ins15", imu_noise(imu))
    truth = Truth(static(MINUTE_S), (0.5, 2.0, 50.0), imu.rate_hz, MINUTE_S)
    buffer = runs.filled_buffer(imu, runs.sample_times(truth), runs.imu_run(imu, truth, 1).samples)
    sigma = {}
    for name, bias in (("bias", 0.0980665), ("noise", 0.0)):
        sd = np.zeros(model.size)
        sd[model.slots_of("accel_bias")] = bias
        estimator = KalmanEstimator(model, imu.gap_s)
        state = truth.at(np.zeros(1))
        nav = np.concatenate([state.position[0], np.zeros(3), [1.0, 0.0, 0.0, 0.0]])
        estimator.initialise(0, 0, nav, np.zeros(model.size), np.diag(sd**2))
        estimator.propagate(buffer, round(MINUTE_S * 1e9))
        sigma[name] = math.sqrt(estimator.covariance[6, 6])
    noise = imu_noise(imu)
    # Beside the white noise the biases' own walk.
    assert sigma["bias"] == pytest.approx(0.5 * 0.0980665 * MINUTE_S**2, rel=0.01)
    known = after_a_minute(noise.force_noise, noise.rate_noise)
    assert known < sigma["noise"] < 1.2 * known


def test_the_daemon_says_it_once() -> None:
    heard: list[EventMessage] = []
    clock = Clock(ClockOptions())
    events = Events(clock)
    events.listen(heard.append)
    Chain(configured("planar10"), clock, events)
    said, scales = [e for e in heard if e.code == "states_absent"]
    assert (said.source, said.level) == ("navigator", "warning")
    assert "the bias does 177 m" in said.text
    assert "2,000 ppm of the gyros" in scales.text
    Chain(configured("ins21"), clock, events)
    assert [e.code for e in heard].count("states_absent") == 2
