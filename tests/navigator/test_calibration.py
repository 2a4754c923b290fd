"""What is calibrated: a sensor mounted askew and wheels that say too much are found on a drive;
what it does not show stays at its prior and says so, and the next start takes it up."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.measurements import Measurement, MonotonicStamp, PositionFix, WheelSpeed
from fusiond.configuration.schema import Config
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import mounting_block, time_offset_block
from fusiond.navigation.rotation import dcm_from_rpy
from fusiond.navigator.calibration import (
    LOOK_NS,
    STAYS_S,
    CalibrationState,
    CalibrationWatch,
    Parameter,
)
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.saved_calibration import (
    CHANGES,
    SavedCalibration,
    mounting_digest,
    saved_calibration,
)
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, follow
from tests import runs

Array = NDArray[np.float64]
RATE_HZ, SECONDS = 50.0, 210.0
START_NS = 7_003 * runs.SECOND
# What the owner does not know: the sensor is turned by so much (deg), wheels say 1.5 % too much.
PITCH_DEG, YAW_DEG, SCALE = -3.0, 4.0, 0.015
NOT_OBSERVED, OBSERVED, SETTLED = CalibrationState
CONFIG: dict[str, Any] = {
    "imu": {"rate_hz": RATE_HZ, "sensor_class": "mems"},
    "aiding": {
        "gnss": {"bias_sd_m": 0.0, "time_offset_sd_s": 0.05},
        "wheel": {"drift_sd_m_s": 0.0},
    },
    "constraints": {"non_holonomic": {"enabled": True}},
    "alignment": {
        "heading": ["config"],
        "heading_deg": 40.0 + YAW_DEG,
        "heading_sd_deg": 5.0,
        "position_deg_m": [30.5, 114.3, 40.0],
        "position_sd_m": 5.0,
    },
}


@dataclass(frozen=True)
class Recorded:
    """Stamps (n,), samples (n, 6), and measurements in their order."""

    times: NDArray[np.int64]
    samples: Array
    measurements: list[Measurement]


@lru_cache(maxsize=1)
def drive() -> Recorded:
    """Ten seconds at rest, then a town: bends, stops and starts."""
    legs = [Leg(10), *(3 * (*runs.TOWN, *runs.TOWN[::-1]))]
    truth = Truth(follow(legs, SECONDS, course_deg=40.0), runs.ORIGIN, RATE_HZ, SECONDS)
    config = Config.model_validate(CONFIG)
    turn = dcm_from_rpy(0.0, math.radians(PITCH_DEG), math.radians(YAW_DEG))
    samples = runs.imu_run(config.imu, truth, 3).samples
    samples = np.hstack([samples[:, :3] @ turn, samples[:, 3:] @ turn])
    rng = np.random.default_rng(5)
    found: list[Measurement] = []
    t = np.arange(0.5, SECONDS - 1.0, 0.5)
    states = truth.at(t)
    for t_s, p, v in zip(t, states.position, states.v_ned, strict=True):
        at = START_NS + round(t_s * 1e9)
        metre = 1.0 / runs.metres_per_unit(p[0], p[2])
        lat, lon, up = (float(x) for x in p + 0.05 * metre * rng.standard_normal(3))
        n, e, d = (float(x) for x in v + 0.05 * rng.standard_normal(3))
        stamp = MonotonicStamp(at)
        found.append(
            PositionFix(
                "gnss",
                at,
                stamp,
                lat,
                lon,
                up,
                sd_ned_m=(0.05, 0.05, 0.05),
                v_ned_m_s=(n, e, d),
                sd_v_ned_m_s=(0.05, 0.05, 0.05),
            )
        )
        speed = (1.0 + SCALE) * math.hypot(*v[:2]) + 0.05 * float(rng.standard_normal())
        found.append(WheelSpeed("wheel", at, stamp, speed))
    return Recorded(runs.sample_times(truth, START_NS), samples, found)


def run(
    seconds: float,
    calibration: SavedCalibration | None = None,
    on_event: Callable[[str, str], None] = lambda code, text: None,
    heading: str = "config",
    spare_s: float = math.inf,
) -> Navigator:
    """A navigator after the first seconds of the drive; from `spare_s` on by the spare IMU, which
    sits as the first."""
    d = drive()
    aligned = {**CONFIG["alignment"], "heading": [heading]}
    settings: dict[str, Any] = {**CONFIG, "alignment": aligned}
    if spare_s < seconds:
        settings["imu"] = {**CONFIG["imu"], "spare": {"source": "spare"}}
    navigator = Navigator(Config.model_validate(settings), on_event=on_event)
    navigator.calibration = calibration
    waiting = list(d.measurements)
    step = round(RATE_HZ / 2.0)
    for first in range(0, round(seconds * RATE_HZ), step):
        if first == round(spare_s * RATE_HZ if spare_s < seconds else -1.0):
            navigator.change_imu()
        navigator.add_imu(d.times[first : first + step], d.samples[first : first + step])
        while waiting and waiting[0].t_seen_ns <= navigator.imu.latest_ns:
            m = waiting.pop(0)
            navigator.add(m, m.t_seen_ns)
        navigator.advance()
    return navigator


@lru_cache(maxsize=1)
def driven() -> tuple[dict[str, Parameter], tuple[tuple[str, str], ...]]:
    """What the whole drive shows, and the events."""
    events: list[tuple[str, str]] = []
    navigator = run(SECONDS, on_event=lambda *event: events.append(event))
    return {p.name: p for p in navigator.calibrating.parameters}, tuple(events)


def test_a_drive_shows_mounting_and_wheels_within_their_sigma() -> None:
    found, _ = driven()
    for name, true in {
        "mounting_pitch_deg": PITCH_DEG,
        "mounting_yaw_deg": YAW_DEG,
        "wheel_scale": SCALE,
        "wheel_latency_s": 0.0,
        "axle_lever_m": 0.0,
        "gnss_time_s": 0.0,
        "gnss_velocity_time_s": 0.0,
    }.items():
        assert found[name].state is SETTLED, found[name]
        assert abs(found[name].value - true) < 3.0 * found[name].sd, found[name]


def test_a_parked_vehicle_shows_nothing_and_says_so() -> None:
    navigator = run(9.0)
    assert navigator.started is not None
    assert {p.state for p in navigator.calibrating.parameters} == {NOT_OBSERVED}
    assert saved_calibration(navigator.calibrating.parameters, "") is None


def test_each_settled_parameter_is_told_once() -> None:
    found, events = driven()
    told = [text.split(", one sigma ")[0] for code, text in events if code == "calibrated"]
    labels = ["_".join(words.lower().split()[:-2]) for words in told]  # without figure and unit
    assert sorted(set(labels)) == sorted(labels)
    settled = {name for name, p in found.items() if p.state is SETTLED}
    assert {name for name in settled if not name.startswith(tuple(labels))} == set()


def test_the_next_start_knows_what_this_one_has_found() -> None:
    found, _ = driven()
    saved = saved_calibration(found.values(), "")
    assert saved is not None
    again = {p.name: p for p in run(9.0, saved).calibrating.parameters}
    p = again["mounting_yaw_deg"]
    assert p.value == pytest.approx(found["mounting_yaw_deg"].value, abs=0.05)
    assert p.sd == pytest.approx(
        math.hypot(found["mounting_yaw_deg"].sd, CHANGES["mounting"]), rel=0.05
    )


def test_a_saved_calibration_that_is_wrong_is_given_up() -> None:
    events: list[str] = []
    wrong = SavedCalibration("", {"mounting_yaw_deg": (YAW_DEG - 8.0, 0.1)})
    navigator = run(SECONDS, wrong, lambda code, text: events.append(code), "gnss_course")
    assert events.count("calibration_refused") == 1
    found = {p.name: p for p in navigator.calibrating.parameters}["mounting_yaw_deg"]
    assert abs(found.value - YAW_DEG) < 3.0 * found.sd


@pytest.mark.parametrize(
    "change",
    [
        {"imu": {"mounting_deg": [0.0, 1.0, 0.0]}},
        {"imu": {"axes": ["-x", "-y", "+z"]}},
        {"imu": {"time_offset_s": 0.1}},
        {"constraints": {"non_holonomic": {"lever_arm_m": [-1.0, 0.0, 0.0]}}},
        {"aiding": {"gnss": {"lever_arm_m": [0.0, 0.0, -1.0]}}},
        {"aiding": {"wheel": {"scale": 1.01}}},
    ],
)
def test_another_mounting_is_another_digest(change: dict[str, Any]) -> None:
    plain = mounting_digest(Config(aiding={"gnss": {}, "wheel": {}}))  # type: ignore[dict-item]
    data = {**change, "aiding": {"gnss": {}, "wheel": {}, **change.get("aiding", {})}}
    assert mounting_digest(Config.model_validate(data)) != plain
    assert mounting_digest(Config.model_validate({"aiding": {"gnss": {}, "wheel": {}}})) == plain


# ------------------------------------------------------------------ the watch alone


def watched(values: Callable[[float], float], sd: float, walk: bool = False) -> CalibrationState:
    """The state of the last parameter after three minutes of `values(t_s)`, in prior sigmas."""
    block = time_offset_block("gnss_time", 1.0) if walk else mounting_block(1.0)
    model = Model("watched", (block,))
    watch = CalibrationWatch(model, lambda code, text: None)
    for t_s in range(0, 180, 5):
        xi = np.full(model.size, values(float(t_s)))
        watch.look(t_s * runs.SECOND, xi, np.eye(model.size) * sd**2)
    return watch.parameters[-1].state


@pytest.mark.parametrize(
    ("sd", "moves_in_a_minute", "state"),
    [
        (1.0, 0.0, NOT_OBSERVED),
        (0.5, 0.0, OBSERVED),
        (0.15, 0.0, SETTLED),
        (0.15, 0.1, SETTLED),
        (0.15, 0.3, OBSERVED),
    ],
)
def test_settled_is_narrow_and_still(
    sd: float, moves_in_a_minute: float, state: CalibrationState
) -> None:
    assert watched(lambda t_s: t_s * moves_in_a_minute / STAYS_S, sd) is state


def test_what_wanders_by_nature_may_move_so_far() -> None:
    for fast, state in ((0.5, SETTLED), (2.0, OBSERVED)):
        step = fast * 1e-3 * math.sqrt(STAYS_S)  # of the block's random walk
        assert watched(lambda t_s, step=step: t_s * step / STAYS_S, 1e-6, walk=True) is state


@pytest.mark.parametrize("turned_deg", [0.0, 5.0])
def test_a_unit_that_turns_is_told_and_one_that_is_learned_of_is_not(turned_deg: float) -> None:
    """The mean of noisy looks at a constant moves by what its variance shrinks by, for ever; once
    the constant changes it moves by more, though a mean of so many moves slowly."""
    model = Model("watched", (mounting_block(math.radians(5.0)),))
    told = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        watch = CalibrationWatch(model, lambda code, text: None)
        prior, noise = math.radians(5.0), math.radians(1.0)
        yaw = rng.normal(0.0, prior)
        estimate, variance = 0.0, prior**2
        for k in range(120):
            turned = math.radians(turned_deg) * (k >= 60)
            gain = variance / (variance + noise**2)
            estimate += gain * (yaw + turned + rng.normal(0.0, noise) - estimate)
            variance *= 1.0 - gain
            watch.look(k * LOOK_NS, np.full(model.size, estimate), np.eye(model.size) * variance)
            if watch.turned:
                told.append(k)
                break
        watch.restart()
        assert watch.turned is None
    assert len(told) == (30 if turned_deg else 0)
    assert all(60 <= k <= 110 for k in told)


def test_a_turn_is_told_within_a_second() -> None:
    """It is vouched for until then."""
    prior, second_ns = math.radians(5.0), 1_000_000_000
    model = Model("watched", (mounting_block(prior),))
    watch = CalibrationWatch(model, lambda code, text: None)
    p = np.eye(model.size) * (0.2 * prior) ** 2
    for k in range(64):
        moved = math.radians(2.0) * (k >= 63)
        watch.look(k * second_ns, np.full(model.size, moved), p)
        assert (watch.turned is not None) == (k >= 63)


def test_a_turn_gives_up_a_calibration_of_before() -> None:
    events: list[str] = []
    saved = SavedCalibration("", {"mounting_yaw_deg": (YAW_DEG, 0.1)})
    navigator = run(60.0, saved, lambda code, text: events.append(code), "gnss_course")
    assert navigator.calibration is not None
    navigator.calibrating.turned = "the IMU has turned"
    navigator._calibrate()
    assert navigator.calibration is None
    assert "calibration_refused" in events


def test_what_was_configured_wrongly_is_no_turn() -> None:
    """Seven of its sigmas: the state says so, and starting anew would not change it."""
    prior, noise, yaw = math.radians(5.0), math.radians(1.0), math.radians(35.0)
    model = Model("watched", (mounting_block(prior),))
    watch = CalibrationWatch(model, lambda code, text: None)
    estimate, variance = 0.0, prior**2
    for k in range(200):
        watch.look(k * LOOK_NS, np.full(model.size, estimate), np.eye(model.size) * variance)
        gain = variance / (variance + (5.0 * noise) ** 2)
        estimate += gain * (yaw - estimate)
        variance *= 1.0 - gain
    assert watch.turned is None


def test_a_spare_is_another_mounting_and_no_turn() -> None:
    events: list[str] = []
    navigator = run(125.0, on_event=lambda code, _: events.append(code), spare_s=100.0)
    assert "diverged" not in events
    assert navigator.started is not None
    found = {p.name: p.value for p in navigator.calibrating.parameters}
    assert abs(found["mounting_yaw_deg"]) < YAW_DEG + 1.0  # found anew


def test_nothing_is_settled_before_a_minute_has_passed() -> None:
    model = Model("watched", (mounting_block(1.0),))
    watch = CalibrationWatch(model, lambda code, text: None)
    for cell in range(round(STAYS_S * 1e9 / LOOK_NS)):
        assert watch.look(cell * LOOK_NS, np.zeros(model.size), np.eye(model.size) * 1e-4)
        assert not watch.settled
        assert not watch.look(cell * LOOK_NS + 1, np.zeros(model.size), np.eye(model.size))
    watch.look(round(STAYS_S * 1e9), np.zeros(model.size), np.eye(model.size) * 1e-4)
    assert watch.settled
    watch.restart()
    assert not watch.settled
