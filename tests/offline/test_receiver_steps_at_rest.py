"""Receivers that drive off by themselves, as in case 19, at other speeds, rates and rests.

The vehicle drives for 48 s and rests; its receiver reports a motion for a while, then rest where it
has come to. Position and velocity are one story: out together, back together, sigma covers."""

from __future__ import annotations

import csv
import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusiond.configuration.load import load_config
from fusiond.files.measurement_csv import read_gnss, read_solution
from fusiond.offline.process import process
from tests.places import DATA

CASES = DATA.parent / "cases"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason=f"{CASES} is missing: set FUSIOND_DATA")
DRIVE_S, START_S = 48.0, 200_000.0
METRES = 111_200.0
SD_M, SD_M_S = (0.5, 0.5, 1.0), (0.05, 0.05, 0.075)
AFTER_S = 25.0


def _rows(name: str) -> list[list[str]]:
    with gzip.open(CASES / name, "rt") as file:
        return list(csv.reader(file))


def files(
    folder: Path, speed: float, rate_hz: float, rest_s: float, moves_s: float
) -> tuple[Path, Path]:
    """Inertial samples and fixes: those of the case for its drive, then drawn ones."""
    rng, course = np.random.default_rng(7), 0.7
    ends_s = DRIVE_S + rest_s + moves_s + AFTER_S
    header, *samples = _rows("19_step_imu.csv.gz")
    still = samples[5000:]
    imu, gnss = folder / "imu.csv", folder / "gnss.csv"
    with imu.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(header)
        for k in range(round(100.0 * ends_s)):
            row = samples[k] if k < 5000 else still[(k - 5000) % len(still)]
            out.writerow([repr(START_S + 0.01 * k), *row[1:]])
    header, *fixes = _rows("19_step_gnss.csv.gz")
    places = np.array([[float(x) for x in row[1:3]] for row in fixes[250:300]])
    lat, lon = places.mean(axis=0).tolist()
    to_m = np.array([METRES, METRES * math.cos(math.radians(lat)), -1.0])
    with gnss.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(header)
        out.writerows(fixes[: round(5.0 * DRIVE_S) : round(5.0 / rate_hz)])
        for k in range(round(DRIVE_S * rate_hz), round(ends_s * rate_hz)):
            since_s = k / rate_hz - DRIVE_S - rest_s
            way_m = speed * min(max(since_s, 0.0), moves_s)
            v = speed if 0.0 <= since_s < moves_s else 0.0
            ahead = np.array([math.cos(course), math.sin(course), 0.0])
            place = (way_m * ahead + np.array(SD_M) * rng.standard_normal(3)) / to_m
            place += np.array([lat, lon, 450.0])
            velocity = v * ahead + np.array(SD_M_S) * rng.standard_normal(3)
            numbers = [START_S + k / rate_hz, *place, 1, 12, *SD_M, *velocity, *SD_M_S]
            out.writerow([repr(float(x)) for x in numbers[:4]] + ["1", "12"] + numbers[6:])
    return imu, gnss


@pytest.mark.parametrize(
    ("speed", "rate_hz", "rest_s", "moves_s"),
    [
        (3.0, 5.0, 12.0, 60.0),  # passes the gate of a filter that has coasted for a minute
        (40.0, 5.0, 12.0, 60.0),  # its end is a step within one interval of fixes
        (0.5, 5.0, 12.0, 60.0),
        (20.0, 1.0, 12.0, 60.0),  # position and velocity show it in one epoch
        (3.0, 1.0, 40.0, 60.0),
        (10.0, 5.0, 5.0, 30.0),
    ],
)
def test_position_and_velocity_are_out_and_back_together(
    tmp_path: Path, speed: float, rate_hz: float, rest_s: float, moves_s: float
) -> None:
    imu, gnss = files(tmp_path, speed, rate_hz, rest_s, moves_s)
    out = tmp_path / "solution.csv"
    result = process(load_config(CASES / "02.toml"), imu, [("gnss", gnss)], out=out)
    isolated = [result["sources"][name]["isolated"] for name in ("gnss", "gnss_velocity")]
    assert min(isolated) > 0.9 * moves_s * rate_hz
    if moves_s >= 60.0:  # of a shorter one the place stays in doubt for the rest of a minute
        assert abs(isolated[0] - isolated[1]) <= max(2, 3 * rate_hz)
    solution, fixes = read_solution(out), read_gnss(gnss)
    there = [np.interp(solution.t_s, fixes.t_s, x) for x in (fixes.lat_rad, fixes.lon_rad)]
    rest = solution.t_s < START_S + DRIVE_S + rest_s
    shown = np.flatnonzero(~rest)
    last = np.flatnonzero(rest)[-1]
    radius, lat = math.degrees(METRES), solution.lat_rad[last]

    def away(lat_rad: Any, lon_rad: Any) -> Any:
        north, east = solution.lat_rad[shown] - lat_rad, solution.lon_rad[shown] - lon_rad
        return radius * np.hypot(north, east * math.cos(lat))

    fix = away(there[0][shown], there[1][shown])
    nearer = np.minimum(fix, away(lat, solution.lon_rad[last]))
    sigma = np.hypot(*solution.sd_position[shown, :2].T)
    assert np.all(nearer - 3.0 * SD_M[0] <= 3.5 * sigma)
    if moves_s >= 60.0:
        assert fix[-1] < 3.0
        assert result["mode"] == "navigating"
