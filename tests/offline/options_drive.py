"""A drive with every kind of measurement as files, and the configuration that it is navigated
by."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.schema import Config
from fusiond.navigation.rotation import dcm_from_rpy
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, follow
from tests import runs
from tests.offline.nmea_lines import sentence

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


def write_files(folder: Path) -> Path:
    """The folder, with a file of each kind."""
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
            p[:2] + rng.standard_normal(2) / np.array(runs.metres_per_unit(p[0], p[2]))[:2]
        )
        hms = f"0733{t_s:05.2f}"
        speed, course = math.hypot(*v[:2]) + 0.05, math.degrees(math.atan2(v[1], v[0])) % 360.0
        place = f"{dm(lat, 2)},N,{dm(lon, 3)},E"
        lines += [
            f"GNGGA,{hms},{place},1,14,0.9,{(p[2] if t_s < LIFTED_S else 5e3) - 40:.2f},M,40.0,M,,",
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
    scale = np.array(runs.metres_per_unit(runs.ORIGIN[0], runs.ORIGIN[2]))[:2]
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


def measurements(config: Config, files: Path) -> list[tuple[str, Path]]:
    """The files that the configuration has a use for."""
    return [(FILES[n][0], files / FILES[n][1]) for n in config.aiding if n in FILES]
