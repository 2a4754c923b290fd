"""Why a vehicle does not align: words that say what to do, and an event when they change."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.measurements import MonotonicStamp, PositionFix
from fusiond.configuration.schema import Config
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, follow
from tests import runs

RATE_HZ = 50.0
TACTICAL = {"sensor_class": "tactical", "gyro_bias_initial_deg_h": 0.3, "rate_hz": RATE_HZ}
TACTICAL["gyro_bias_instability_deg_h"] = 0.1


def _told(
    legs: tuple[Leg, ...], seconds: float, **settings: Any
) -> tuple[str, list[tuple[str, str]]]:
    """The last reason and all events of a drive with fixes without velocity."""
    config = Config.model_validate(settings)
    truth = Truth(follow(legs, seconds, course_deg=70.0), runs.ORIGIN, RATE_HZ, seconds)
    times = runs.sample_times(truth)
    samples = runs.imu_run(config.imu, truth, 5).samples
    events: list[tuple[str, str]] = []
    navigator = Navigator(config, on_event=lambda code, text: events.append((code, text)))
    for row in range(0, len(times), 50):
        rows = slice(row, row + 50)
        navigator.add_imu(times[rows], samples[rows])
        t_ns = int(times[rows][-1])
        lat, lon, height = truth.at(np.array([t_ns * 1e-9])).position[0]
        fix = PositionFix("gnss", t_ns, MonotonicStamp(t_ns), float(lat), float(lon), float(height))
        navigator.add(fix, t_ns, seen_ns=t_ns)
        navigator.advance()
    assert navigator.started is None
    return navigator.mode(navigator.imu.latest_ns)[1], events


def test_a_rest_too_short_to_gyrocompass_says_how_much_is_missing() -> None:
    legs = (Leg(88), Leg(6, speed_m_s=8.0), Leg(20))
    why, events = _told(legs, 110.0, imu=TACTICAL, alignment={"heading": ["gyrocompass"]})
    needs = "of the 120 that gyrocompassing needs"
    texts = [text for code, text in events if code == "not_aligned"]
    # At rest, and moved: two lines, however the seconds count up.
    assert len(texts) == 2
    assert needs in texts[0]
    assert ", then moved" not in texts[0]
    assert f"s {needs}, then moved" in texts[1]
    assert f"s {needs}, then moved" in why


def test_samples_at_another_rate_than_configured_are_named() -> None:
    alignment = {"heading": ["gyrocompass"]}
    why, events = _told((Leg(20),), 20.0, imu={**TACTICAL, "rate_hz": 100.0}, alignment=alignment)
    said = "samples come at 50 Hz, the configuration says 100: correct imu.rate_hz"
    assert said in why
    assert any(said in text for code, text in events if code == "not_aligned")


def test_a_sensor_that_is_never_quiet_says_by_how_much() -> None:
    shaken = {**TACTICAL, "accel_noise_m_s_sqrt_h": 3.0}
    why, _ = _told((Leg(20),), 20.0, imu=shaken, alignment={"heading": ["gyrocompass"]})
    assert why.startswith("No level: stand still, or drive with fixes; shaken by ")
    assert "rest is below 0.5 and 0.15" in why
