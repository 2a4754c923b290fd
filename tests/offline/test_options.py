"""Each option of the configuration changes `process` as it changes the daemon.

One drive with every kind of aid, from files, goes through `process` and, arrival by arrival,
through the door of the daemon's chain, tick by tick: the filter's state at the end is the same to
the bit. An option that is new must be put here, or among those that no recorded file knows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import astuple
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import BaseModel

from drivers.base import DriverStatus
from fusiond.clock.clock import Clock
from fusiond.configuration.aiding import AnyAiding
from fusiond.configuration.schema import Config
from fusiond.live.chain import Chain
from fusiond.live.events import Events
from fusiond.live.sources import Source
from fusiond.navigation.rotation import dcm_from_rpy
from fusiond.navigator.navigator import Navigator
from fusiond.offline.aid_files import source_of
from fusiond.offline.process import process
from fusiond.offline.recorded import read_recorded
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, follow
from tests import runs
from tests.clock.host_time import Host
from tests.offline.test_nmea_file import sentence

Array = NDArray[np.float64]

RATE_HZ, SECONDS = 50.0, 46.0
BEGIN_S = 1_774_337_580  # 2026-03-24T07:33:00
REST_S = 10.0
LIFTED_S = 43.0
"""From then on the receiver is at 5 km, where roads go and ships do not."""

BASE: dict[str, Any] = {
    "imu": {"rate_hz": RATE_HZ},
    "scheduler": {"rate_hz": 50.0},
    "alignment": {"heading": ["gnss_course"], "course_speed_m_s": 2.0},
    "constraints": {"non_holonomic": {"enabled": True}},
    "estimator": {"model": "ins15", "buffer_s": 12.0},
    "aiding": {
        "gnss": {},
        "rdss": {},
        "wheel": {},
        "barometer": {},
        "heading": {},
        "compass": {"declination_deg": 2.0},
    },
}
FILES = {
    "gnss": ("nmea", "receiver.nmea"),
    "attitude": ("attitude", "attitude.csv"),
    "star_tracker": ("attitude", "attitude.csv"),
    "sar": ("bearing", "bearing.csv"),
    **{kind: (kind, f"{kind}.csv") for kind in ("rdss", "wheel", "barometer")},
}
"""By section of aiding: kind and name of what it takes."""
POINT_M = (4000.0, 2500.0, 600.0)
"""What the radar sees: so far north, east and up of the start."""


def legs() -> list[Leg]:
    moving = [Leg(6, speed_m_s=9.0), Leg(6, turn_deg=60.0), Leg(8, turn_deg=-90.0)]
    return [Leg(REST_S), *moving, Leg(6, speed_m_s=0.0), Leg(10)]


def dm(degrees: float, width: int) -> str:
    whole, minutes = divmod(round(abs(degrees) * 6e8), 6 * 10**8)
    return f"{whole:0{width}d}{minutes / 1e7:010.7f}"


@lru_cache(maxsize=1)
def truth() -> Truth:
    return Truth(follow(legs(), SECONDS, course_deg=40.0), runs.ORIGIN, RATE_HZ, SECONDS)


def table(path: Path, header: str, rows: list[tuple[float, ...]]) -> Path:
    lines = [",".join(f"{x:.10g}" if abs(x) < 1e8 else f"{x:.6f}" for x in row) for row in rows]
    path.write_text("\n".join((header, *lines)) + "\n")
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    drive, rng = truth(), np.random.default_rng(40)
    samples = runs.imu_run(Config.model_validate(BASE).imu, drive, 21).samples
    imu = [(BEGIN_S + t, *row) for t, row in zip(drive.t_s[1:], samples.tolist(), strict=True)]
    axes = [
        f"{what}_{axis}_{unit}"
        for what, unit in (("gyro", "rad_s"), ("accel", "m_s2"))
        for axis in "xyz"
    ]
    table(folder / "imu.csv", ",".join(("t_s", *axes)), imu)

    def states(spacing_s: float) -> Iterator[tuple[float, Any, Any, Any]]:
        t = np.arange(0.5, SECONDS - 1.0, spacing_s)
        at = drive.at(t)
        for k, t_s in enumerate(t.tolist()):
            yield t_s, at.position[k], at.v_ned[k], at.rpy[k]

    lines = []
    for t_s, p, v, rpy in states(1.0):
        lat, lon = np.degrees(
            p[:2] + rng.standard_normal(2) / np.array(runs.metres(p[0], p[2]))[:2]
        )
        hms = f"0733{t_s:05.2f}"
        speed, course = math.hypot(*v[:2]) + 0.05, math.degrees(math.atan2(v[1], v[0])) % 360.0
        place = f"{dm(lat, 2)},N,{dm(lon, 3)},E"
        lines += [
            f"GNGGA,{hms},{place},1,14,0.9,{p[2] if t_s < LIFTED_S else 5e3:.2f},M,0.0,M,,",
            f"GNRMC,{hms},A,{place},{speed / 0.514444:.3f},{course:.2f},240326,,,A,V",
            f"GNTHS,{math.degrees(rpy[2]) % 360.0:.2f},A",
            *(5 * [f"HCHDM,{(math.degrees(rpy[2]) - 2.0) % 360.0:.1f},M"]),
        ]
    (folder / "receiver.nmea").write_bytes(b"".join(map(sentence, lines)))
    rdss = [
        (BEGIN_S + t, BEGIN_S + t + 1.53, *np.degrees(p[:2]).tolist(), p[2], 20.0, 0.0)
        for t, p, _, _ in states(3.1)
    ]
    header = "t_s,t_arrival_s,lat_deg,lon_deg,height_m,precision_class_m,multi_value"
    table(folder / "rdss.csv", header, rdss)
    wheel = [(BEGIN_S + t, math.hypot(*v[:2])) for t, _, v, _ in states(0.33)]
    table(folder / "wheel.csv", "t_s,speed_m_s", wheel)
    air = [(BEGIN_S + t, 101325.0 - 11.8 * p[2]) for t, p, _, _ in states(0.51)]
    table(folder / "barometer.csv", "t_s,pressure_pa", air)
    stars = [(BEGIN_S + t, *np.degrees(rpy).tolist()) for t, _, _, rpy in states(2.3)]
    table(folder / "attitude.csv", "t_s,roll_deg,pitch_deg,yaw_deg", stars)
    scale = np.array(runs.metres(runs.ORIGIN[0], runs.ORIGIN[2]))[:2]
    point = np.array(
        [*(runs.ORIGIN[:2] + np.array(POINT_M[:2]) / scale), runs.ORIGIN[2] + POINT_M[2]]
    )
    seen = []
    for t_s, p, _, rpy in states(1.7):
        away = (point - p) * (*scale, -1.0)
        x, y, z = dcm_from_rpy(*rpy).T @ away
        angles = math.degrees(math.atan2(y, x)), math.degrees(math.atan2(-z, math.hypot(x, y)))
        seen.append((BEGIN_S + t_s, *angles, *np.degrees(point[:2]).tolist(), point[2]))
    header = "t_s,azimuth_deg,elevation_deg,target_lat_deg,target_lon_deg,target_height_m"
    table(folder / "bearing.csv", header, seen)
    return folder


def aids(config: Config, files: Path) -> list[tuple[str, Path]]:
    """The files that the configuration has a use for."""
    return [(FILES[n][0], files / FILES[n][1]) for n in config.aiding if n in FILES]


def changed(options: dict[str, Any]) -> Config:
    """The configuration with options by dotted names; a new section of aiding comes in place of the
    compass, for which there is no room beside it."""
    settings = deepcopy(BASE)
    for key, value in options.items():
        *path, name = key.split(".")
        section = settings
        for part in path:
            if part in ("attitude", "star_tracker", "sar"):
                settings["aiding"].pop("compass", None)
            section = section.setdefault(part, {})
        section[name] = value
    return Config.model_validate(settings)


class Told(NamedTuple):
    """Where it is, how sure, how each measurement ended."""

    state: Array
    bounds: Array
    words: tuple[Any, ...]
    t_ns: int

    def same(self, other: Told, rounding: float = 1e-9) -> bool:
        """To the rounding of as many steps; tables hold times of today to 0.2 us."""
        close = partial(np.allclose, rtol=rounding, atol=1e-3 * rounding, equal_nan=True)
        if self.words != other.words or self.state.shape != other.state.shape:
            return False
        if abs(self.t_ns - other.t_ns) > 1000:
            return False
        return close(self.state, other.state) and close(self.bounds, other.bounds)


def told(navigator: Navigator) -> Told:
    e = navigator.estimator
    outcomes = navigator.timeline.counters.outcomes
    ended = {source: dict(+counts) for source, counts in outcomes.items() if +counts}
    refused = {source: dict(counts) for source, counts in navigator.refused.items()}
    reports = navigator.verdicts.reports()
    verdicts = {name: (r.verdict, r.window_verdict, r.k, r.alpha) for name, r in reports.items()}
    solution = navigator.solution(navigator.imu.latest_ns)
    state = np.concatenate([np.ravel(a) for a in (e.nav, e.xi, e.covariance)])
    bounds = [x for x in astuple(solution.bound) if isinstance(x, float)]
    words = ended, refused, verdicts, solution.mode, solution.reason
    return Told(state, np.array(bounds), words, solution.t_ns)


def by_process(config: Config, files: Path) -> Told:
    seen: list[Navigator] = []
    process(config, files / "imu.csv", aids(config, files), watch=seen.append)
    return told(seen[-1])


def by_daemon(config: Config, files: Path) -> Told:
    """The same arrivals through the daemon's chain, a tick a sample."""
    read = read_recorded(config, files / "imu.csv", aids(config, files), (), None, None)
    times = np.rint(read.imu.t_s * 1e9).astype(np.int64)
    host = Host(mono=int(times[0]), true_utc_at_zero=0)
    clock = Clock(config.clock, host)
    chain = Chain(config, clock, Events(clock))
    tick_ns = round(1e9 / config.scheduler.rate_hz)
    begin, end = (int(times[k]) // tick_ns for k in (0, -1))
    given = taken = 0
    for k in range(begin, end + 2):
        while given < len(read.arrivals) and read.arrivals[given].t_arrival_ns <= k * tick_ns:
            item: Any = read.arrivals[given].measurement
            host.mono = read.arrivals[given].t_arrival_ns
            chain.sources.all.setdefault(item.source, Source(item.source, _Device()))
            chain.sources._emit(item)
            given += 1
        while taken < len(times) and times[taken] <= k * tick_ns:
            row = int(times[taken]), tuple(read.imu.samples[taken].tolist())
            chain.sources.imu._waiting.append(row)
            taken += 1
        host.mono = k * tick_ns
        chain.tick(k * tick_ns)
    return told(chain.navigator)


class _Device:
    status = DriverStatus()


STRATEGIES = ("optimal_prediction", "position_compensation", "none")

CHANGED: dict[str, dict[str, Any]] = {
    # Options that are changed together: what one of them does alone, it does not do less so.
    "vehicle_class": {"vehicle_class": "marine"},
    "sensor_class": {"imu.sensor_class": "consumer"},
    "imu": {
        "imu.axes": ("+y", "-x", "+z"),
        "imu.mounting_deg": (1.0, -2.0, 80.0),
        "imu.time_offset_s": 0.013,
        "imu.rate_hz": 60.0,
        "imu.gyro_range_deg_s": 15.0,
        "imu.accel_range_g": 1.2,
        "imu.gyro_noise_deg_sqrt_h": 0.5,
        "imu.accel_noise_m_s_sqrt_h": 0.2,
        "imu.gyro_bias_instability_deg_h": 20.0,
        "imu.accel_bias_instability_mg": 0.3,
        "imu.bias_correlation_s": 300.0,
        "imu.gyro_bias_initial_deg_h": 700.0,
        "imu.accel_bias_initial_mg": 20.0,
        "imu.gyro_scale_ppm": 4000.0,
        "imu.accel_scale_ppm": 4000.0,
        "imu.misalignment_deg": 0.3,
        "imu.gap_s": 0.1,
    },
    "gnss": {
        "aiding.gnss.lever_arm_m": (1.0, 0.2, -0.5),
        "aiding.gnss.gate_probability": 0.99,
        "aiding.gnss.sigma_scale": 1.5,
        "aiding.gnss.robust": True,
        "aiding.gnss.range_error_m": 2.0,
        "aiding.gnss.velocity_sd_m_s": 0.2,
        "aiding.gnss.min_position_sd_m": 0.5,
        "aiding.gnss.min_velocity_sd_m_s": 0.15,
        "aiding.gnss.velocity_delay_s": 0.1,
        "aiding.gnss.time_offset_sd_s": 0.05,
        "aiding.gnss.time_sd_s": 0.02,
        "aiding.gnss.bias_sd_m": 0.7,
        "aiding.gnss.bias_down_sd_m": 2.0,
        "aiding.gnss.bias_correlation_s": 600.0,
    },
    "gnss lever": {"aiding.gnss.lever_arm_sd_m": 0.4},
    "gnss without velocity": {
        "aiding.gnss.use_velocity": False,
        "alignment.heading": ("positions",),
    },
    **{f"rdss {name}": {"aiding.rdss.strategy": name} for name in STRATEGIES},
    "rdss": {
        "aiding.rdss.lever_arm_m": (1.0, 0.0, -0.5),
        "aiding.rdss.gate_probability": 0.9,
        "aiding.rdss.sigma_scale": 0.5,
        "aiding.rdss.robust": True,
        "aiding.rdss.satellites_deg": (80.0, 110.5),
        "aiding.rdss.range_sd_m": 9.0,
        "aiding.rdss.height_sd_m": 20.0,
        "aiding.rdss.fix_height_sd_m": 10.0,
        "aiding.rdss.bias_sd_m": 8.0,
        "aiding.rdss.bias_correlation_s": 100.0,
    },
    "rdss class": {"aiding.rdss.noise": "class"},
    "wheel": {
        "aiding.wheel.lever_arm_m": (-1.0, 0.5, 0.0),
        "aiding.wheel.gate_probability": 0.9,
        "aiding.wheel.sigma_scale": 2.0,
        "aiding.wheel.robust": True,
        "aiding.wheel.sd_m_s": 0.2,
        "aiding.wheel.scale": 1.02,
        "aiding.wheel.latency_s": 0.1,
        "aiding.wheel.drift_sd_m_s": 0.2,
        "aiding.wheel.drift_s": 3.0,
        "aiding.wheel.scale_sd": 0.05,
        "aiding.wheel.latency_sd_s": 0.1,
    },
    "barometer": {
        "aiding.barometer.lever_arm_m": (0.0, 0.0, -1.0),
        "aiding.barometer.gate_probability": 0.9,
        "aiding.barometer.sigma_scale": 2.0,
        "aiding.barometer.robust": True,
        "aiding.barometer.sd_m": 3.0,
        "aiding.barometer.weather_sd_m": 30.0,
        "aiding.barometer.weather_walk_m_sqrt_s": 0.3,
        "aiding.barometer.temperature_sd": 0.08,
        "aiding.barometer.airflow_sd": 0.3,
    },
    "heading": {
        "aiding.heading.gate_probability": 0.9,
        "aiding.heading.sigma_scale": 1.5,
        "aiding.heading.robust": True,
        "aiding.heading.sd_deg": 2.0,
        "aiding.heading.lever_arm_m": (0.0, 0.0, -1.0),
    },
    "compass": {
        "aiding.compass.gate_probability": 0.999,
        "aiding.compass.sigma_scale": 1.5,
        "aiding.compass.robust": True,
        "aiding.compass.sd_deg": 2.0,
        "aiding.compass.declination_deg": 3.0,
        "aiding.compass.deviation_sd_deg": 4.0,
        "aiding.compass.disturbance_sd_deg": 2.0,
        "aiding.compass.disturbance_s": 10.0,
        "aiding.compass.lever_arm_m": (0.0, 0.0, -1.0),
    },
    "attitude": {
        "aiding.attitude.lever_arm_m": (0.0, 0.0, -1.0),
        "aiding.attitude.gate_probability": 0.9,
        "aiding.attitude.sigma_scale": 1.5,
        "aiding.attitude.robust": True,
    },
    "star_tracker": {
        "aiding.star_tracker.lever_arm_m": (0.0, 0.0, -1.0),
        "aiding.star_tracker.gate_probability": 0.9,
        "aiding.star_tracker.sigma_scale": 1.5,
        "aiding.star_tracker.robust": True,
        "aiding.star_tracker.sd_arcsec": 900.0,
        "aiding.star_tracker.misalignment_sd_arcsec": 100.0,
        "aiding.star_tracker.misalignment_correlation_s": 60.0,
    },
    "sar": {
        "aiding.sar.lever_arm_m": (0.0, 0.0, 1.0),
        "aiding.sar.gate_probability": 0.9,
        "aiding.sar.sigma_scale": 1.5,
        "aiding.sar.robust": True,
        "aiding.sar.sd_arcsec": 2000.0,
        "aiding.sar.misalignment_sd_arcsec": 100.0,
        "aiding.sar.misalignment_correlation_s": 60.0,
        "aiding.sar.min_range_m": 3000.0,
    },
    "zero_velocity": {
        "constraints.zero_velocity.window_s": 0.7,
        "constraints.zero_velocity.gyro_sd_deg_s": 0.4,
        "constraints.zero_velocity.accel_sd_m_s2": 0.2,
        "constraints.zero_velocity.max_rate_deg_s": 1.0,
        "constraints.zero_velocity.max_speed_m_s": 0.3,
        "constraints.zero_velocity.velocity_sd_m_s": 0.1,
        "constraints.zero_velocity.rate_sd_deg_s": 0.2,
        "constraints.zero_velocity.interval_s": 0.3,
    },
    "no zero_velocity": {"constraints.zero_velocity.enabled": False},
    "non_holonomic": {
        "constraints.non_holonomic.sd_m_s": 0.3,
        "constraints.non_holonomic.sd_down_m_s": 0.4,
        "constraints.non_holonomic.drift_sd_m_s": 0.2,
        "constraints.non_holonomic.drift_s": 3.0,
        "constraints.non_holonomic.mounting_sd_deg": 2.0,
        "constraints.non_holonomic.min_speed_m_s": 3.0,
        "constraints.non_holonomic.interval_s": 0.2,
        "constraints.non_holonomic.lever_arm_m": (-1.0, 0.0, 0.0),
        "constraints.non_holonomic.lever_arm_sd_m": 0.5,
    },
    "no non_holonomic": {"constraints.non_holonomic.enabled": False},
    "alignment": {
        "alignment.levelling_s": 3.0,
        "alignment.course_speed_m_s": 4.0,
        "alignment.course_sd_deg": 3.0,
    },
    "alignment by configuration": {
        "alignment.heading": ("config",),
        "alignment.heading_deg": 42.0,
        "alignment.heading_sd_deg": 3.0,
    },
    "alignment at a place": {
        "alignment.heading": ("config",),
        "alignment.heading_deg": 42.0,
        "alignment.position_deg_m": (30.5, 114.3, 42.0),
        "alignment.position_sd_m": 20.0,
    },
    "gyrocompass": {
        "alignment.heading": ("gyrocompass",),
        "alignment.gyrocompass_s": 5.0,
        "alignment.gyrocompass_max_sd_deg": 360.0,
        "imu.gyro_bias_initial_deg_h": 1.0,
        "imu.gyro_noise_deg_sqrt_h": 0.01,
        "imu.gyro_bias_instability_deg_h": 0.1,
    },
    "estimator": {
        "estimator.model": "ins21",
        "estimator.buffer_s": 10.0,
        "estimator.checkpoint_s": 1.0,
        "estimator.coast_after_s": 0.2,
        "estimator.invalid_sd_m": 0.1,
        "aiding": {name: BASE["aiding"][name] for name in ("gnss", "rdss")},
    },
    "unscented": {
        "estimator.filter": "unscented",
        "estimator.unscented.spread": 1.5,
        "estimator.unscented.propagation": True,
        "aiding": {name: BASE["aiding"][name] for name in ("gnss", "rdss")},
    },
    "multiscale": {
        "estimator.filter": "multiscale",
        "estimator.multiscale.scales": 3,
        "estimator.multiscale.wavelet": "db2",
        "aiding": {name: BASE["aiding"][name] for name in ("gnss", "rdss")},
    },
    "federated": {
        "estimator.filter": "federated",
        "estimator.federated.sources": ("gnss", "rdss"),
        "estimator.federated.mode": "fusion_reset",
        "estimator.federated.sharing": "adaptive",
        "estimator.federated.shares": {"gnss": 2.0, "rdss": 1.0},
        "estimator.federated.fault_detection": False,
        "aiding": {name: BASE["aiding"][name] for name in ("gnss", "rdss")},
    },
    "federated with detection": {
        "estimator.filter": "federated",
        "estimator.federated.mode": "rescale",
        "estimator.federated.master_share": 0.3,
        "estimator.federated.retained": 0.7,
        "estimator.federated.false_alarm_probability": 0.3,
        "estimator.federated.window": 3,
        "estimator.federated.readmit_after": 2,
        "aiding": {name: BASE["aiding"][name] for name in ("gnss", "rdss")},
    },
    "integrity": {
        "integrity.horizontal_alert_limit_m": 20.0,
        "integrity.vertical_alert_limit_m": 30.0,
        "integrity.integrity_risk_per_hour": 1e-4,
        "integrity.false_alarm_per_hour": 1e-3,
        "integrity.fault_probability_per_hour": {"gnss": 1e-2},
    },
    "scheduler": {"scheduler.rate_hz": 3.0},
    "consistency": {"consistency.window": 25, "consistency.alpha": 0.2},
}
NO_FILE_KNOWS = {
    # What leaves the daemon, and how its process runs.
    *("vehicle", "log_level", "mqtt", "recording", "outputs"),
    # Where a daemon of before was: a file is not of today.
    *("state_file", "alignment.saved_max_age_s"),
    # What turns a device's stamps into instants; tables have instants. Of a recorded bus below.
    *("sources", "clock"),
    # Raw data have tests of their own (tests/offline/test_process_walk.py); [aiding.height] has no
    # kind of file; the points of a table stand in it.
    *("aiding.raw", "aiding.height", "aiding.sar.targets_deg_m"),
    # A table of samples is of one unit.
    "imu.spare",
}


def leaves(model: type[BaseModel], before: str = "") -> Iterator[str]:
    """Dotted names of all options; of `aiding` by the kind of the section."""
    for name, field in model.model_fields.items():
        if f"{before}{name}" == "aiding":
            for kind in get_args(get_args(AnyAiding)[0]):
                yield from leaves(kind, f"aiding.{kind.model_fields['kind'].default}.")
            continue
        of = (field.annotation, *get_args(field.annotation))
        parts = [p for p in of if isinstance(p, type) and issubclass(p, BaseModel)]
        if parts and f"{before}{name}" != "sources":
            for part in parts:
                yield from leaves(part, f"{before}{name}.")
        elif name != "kind":
            yield f"{before}{name}"


def test_every_option_is_tried_or_known_to_no_file() -> None:
    tried = {key for options in CHANGED.values() for key in options}
    known = {name for name in leaves(Config) if not any(_under(name, n) for n in NO_FILE_KNOWS)}
    assert known - tried == set()
    assert tried - known == {"aiding"}


def _under(name: str, section: str) -> bool:
    return name == section or name.startswith(f"{section}.")


@pytest.mark.parametrize(
    ("kind", "section"),
    [
        *(("gnss", "gnss"), ("nmea", "gnss"), ("rdss", "rdss"), ("wheel", "wheel")),
        *(("barometer", "barometer"), ("attitude", "star_tracker"), ("bearing", "sar")),
    ],
)
def test_a_section_of_another_name_is_that_of_its_kind(kind: str, section: str) -> None:
    config = Config.model_validate({"aiding": {"rear": {"kind": section}}})
    assert source_of(kind, config) == "rear"
    both = Config.model_validate({"aiding": {"rear": {"kind": section}, section: {}}})
    named = "rear" if section == "star_tracker" else section  # its files have the kind `attitude`
    assert source_of(kind, both) == named


@pytest.fixture(scope="module")
def as_it_stands(files: Path) -> Told:
    return by_process(Config.model_validate(BASE), files)


def test_as_it_stands(files: Path, as_it_stands: Told) -> None:
    assert as_it_stands.same(by_daemon(Config.model_validate(BASE), files))
    ended = as_it_stands.words[0]
    for source in ("gnss", "gnss_velocity", "gnss_heading", "rdss", "wheel", "barometer"):
        assert ended[source]["fused"] > 5, source
    assert ended["compass"]["fused"] > 5


@pytest.mark.parametrize("name", CHANGED)
def test_options(name: str, files: Path, as_it_stands: Told) -> None:
    config = changed(CHANGED[name])
    found = by_process(config, files)
    assert found.same(by_daemon(config, files))
    assert not found.same(as_it_stands)
