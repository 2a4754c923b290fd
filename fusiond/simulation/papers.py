"""Vehicles of the papers: configuration and devices for the model of each paper.

A paper is a shipped configuration with further lines (docs/papers.md prints them). The simulated
vehicle has the paper's devices; the shipped configuration supplies what the paper leaves open.
`fusiond demo --paper` runs the daemon on one of them, `fusiond study papers` its models through the
navigator.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, cycle
from typing import TYPE_CHECKING, Any

from drivers.shipped_files import shipped
from fusiond.configuration.schema import Config
from fusiond.simulation.gnss.raw_stream import RawFormat
from fusiond.simulation.scenarios import SCENARIOS, Scenario
from fusiond.simulation.trajectories import Leg, Path, flight, follow, level_flight

if TYPE_CHECKING:
    from fusiond.simulation.live_devices import Device

REST_S = 8.0
COURSE_DEG = 40.0
"""Initial heading of the car, known at the start as in paper 000."""
IMU_COMES_S = 25.0
TOWN = (
    Leg(9, speed_m_s=14.0),
    Leg(3),
    Leg(6, turn_deg=60.0),
    Leg(6, speed_m_s=9.0),
    Leg(6, turn_deg=-90.0),
    Leg(8, speed_m_s=18.0),
    Leg(8, turn_deg=30.0, climb_deg=2.0),
    Leg(6, climb_deg=0.0),
    Leg(8, speed_m_s=0.0),
    Leg(5),
)
WHITE: dict[str, Any] = {"bias_sd_m": 0.0, "time_offset_sd_s": 0.0, "lever_arm_sd_m": 0.0}
"""Receiver with white errors only, as in the papers' models."""
AS_TAKEN: dict[str, Any] = {
    "ionosphere_sd": 0.5,
    "ionosphere_local_sd": 0.15,
    "ionosphere_as_broadcast": True,
    "wet_delay_sd_m": 0.12,
    "signal_in_space_sd_m": 0.6,
}
"""Sky whose errors match the daemon's assumptions (`fusiond.gnss.signal_choice`): orbits, clocks,
and residuals of ionosphere and troposphere models: half of what is broadcast, and 0.3 of that from
satellite to satellite. The sky of `Scenario` is better, except that its ionosphere models are a
third off."""
NO_SCALES = {"gyro_scale_ppm": 1e-9, "accel_scale_ppm": 1e-9}
"""Inertial unit without scale factor errors, for which the papers' models have no states."""


def town(duration_s: float) -> Path:
    """Path with a short rest, then repeated town streets."""
    legs = chain([Leg(REST_S)], cycle(TOWN))
    return follow(legs, duration_s, course_deg=COURSE_DEG, bank_ratio=-0.08)


def level_town(duration_s: float) -> Path:
    """Path in a town without hills, for a filter that holds its height."""
    legs = chain([Leg(REST_S)], cycle(replace(leg, climb_deg=None) for leg in TOWN))
    return follow(legs, duration_s, course_deg=COURSE_DEG, bank_ratio=-0.08)


def _by_ranges(scenario: Scenario) -> Scenario:
    """Vehicle with ranges, under a sky that matches the daemon's assumptions."""
    return replace(scenario, gnss_raw=replace(scenario.gnss_raw, **AS_TAKEN))


@dataclass(frozen=True)
class Paper:
    """Paper: `lines` are its configuration, `start` shortens the demo; both by section. The
    inertial unit starts after `imu_comes_s`."""

    title: str
    config: str
    lines: dict[str, Any]
    devices: tuple[Device, ...]
    vehicle: Callable[[], Scenario]
    start: dict[str, Any]
    imu_comes_s: float = 0.0
    raw: RawFormat | None = None


PAPERS: dict[str, Paper] = {
    "000": Paper(
        "double-star positioning and SINS with optimal prediction, 15 states",
        "tactical.toml",
        {
            "estimator": {"model": "planar15"},
            "aiding": {"rdss": {"strategy": "optimal_prediction"}},
        },
        ("imu", "rdss"),
        lambda: replace(
            SCENARIOS["drive"],
            path=level_town,
            rdss=replace(SCENARIOS["drive"].rdss, service_frequency_s=1),
        ),
        {
            "vehicle_class": "road",
            # 15 states hold no scale factors, and the paper's sensor has none.
            "imu": NO_SCALES,
            # As the paper starts: 30 arc seconds.
            "alignment": {
                "heading": ["config"],
                "heading_deg": COURSE_DEG,
                "heading_sd_deg": 30.0 / 3600.0,
            },
            "aiding": {"rdss": {"bias_sd_m": 0.0}},
        },
    ),
    "001": Paper(
        "GPS, star tracker and SINS of a micro air vehicle, 10 states",
        "flight_star.toml",
        {"estimator": {"model": "planar10", "filter": "multiscale"}},
        ("imu", "gnss", "star_tracker"),
        lambda: replace(SCENARIOS["flight-star"], path=partial(level_flight, rest_s=REST_S)),
        {},
    ),
    "002": Paper(
        "INS, GNSS ranges, SAR and star tracker, 23 states",
        "flight_sar.toml",
        {"estimator": {"model": "ins23"}, "aiding": {"gnss": {"kind": "raw"}}},
        ("imu", "gnss", "star_tracker", "sar"),
        lambda: _by_ranges(replace(SCENARIOS["flight-sar"], path=partial(flight, rest_s=REST_S))),
        {"imu": NO_SCALES, "alignment": {"heading": ["gnss_course"]}},
        raw="ubx",
    ),
    "003": Paper(
        "BeiDou ranges and INS, 20 states, Markov clock drift",
        "vehicle.toml",
        {
            "estimator": {"model": "ins20"},
            "aiding": {"gnss": {"kind": "raw", "systems": ["C"], "clock_drift_tau_s": 300.0}},
        },
        ("imu", "gnss"),
        lambda: _by_ranges(replace(SCENARIOS["drive"], path=town)),
        {"imu": NO_SCALES},
        raw="ubx",
    ),
    "004": Paper(
        "active and passive receiver, federated; the inertial unit comes later",
        "vehicle.toml",
        {"estimator": {"filter": "federated", "federated": {"fusion": "correlated"}}},
        ("imu", "gnss", "rdss"),
        lambda: replace(
            SCENARIOS["drive"],
            path=town,
            rdss=replace(SCENARIOS["drive"].rdss, service_frequency_s=1),
        ),
        {"aiding": {"gnss": WHITE}},
        imu_comes_s=IMU_COMES_S,
    ),
}


def merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Merge the keys of `over` into `base`, section by section."""
    found = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(found.get(key), dict)
        found[key] = merged(found[key], value) if both else value
    return found


def with_lines(base: dict[str, Any], lines: dict[str, Any]) -> dict[str, Any]:
    """Configuration with further lines. A measurement of another kind replaces the section, whose
    keys differ, except for the antenna's lever arm."""
    base, changed = {**base, "aiding": {**base["aiding"]}}, lines.get("aiding", {})
    for name, section in changed.items():
        was = base["aiding"].get(name, {})
        if section.get("kind", was.get("kind", name)) != was.get("kind", name):
            base["aiding"][name] = {"lever_arm_m": was["lever_arm_m"]}
    return merged(base, lines)


def settings(number: str) -> dict[str, Any]:
    """Configuration of a paper as in a file: the shipped one with its lines, without devices."""
    paper = PAPERS[number]
    base = tomllib.loads(shipped(paper.config).read_text(encoding="utf-8"))
    base.pop("sources")
    return with_lines(base, paper.lines)


def configured(number: str, more: dict[str, Any] | None = None) -> tuple[Config, Scenario]:
    """Configuration of a paper with its start and `more`, and the matching vehicle."""
    paper = PAPERS[number]
    found = merged(settings(number), {**paper.start, "vehicle": "demo"})
    config = Config.model_validate(with_lines(found, more or {}))
    return config, paper.vehicle().fitted(config)
