"""`fusiond process` over the real drive: the figures that the README states, as bounds.

0.10 m RMS to the RTK track after a minute; 5 m RMS of the largest error in each of eight 15 s
outages (7.6 m is what others reach), in each of five sets of them that are shifted against each
other; the track inside two stated sigma in 90 to 99.5 % of the epochs inside the forty. (Errors of
one outage go together. All of eight outages are inside one time in three where sigma is honest, so
that one set tells nothing of one that is too large; all of 24, which is what the five cover, three
times in a hundred.) Smoothed 0.5 m in the outages. All of it from a configuration of signs of axes
and a class of sensor.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from fusiond.configuration.load import load_config
from fusiond.files.measurement_csv import (
    GnssTable,
    TrajectoryTable,
    read_gnss,
    read_solution,
    read_truth,
)
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.offline.compare import compare
from fusiond.offline.process import process
from tests.places import DATA, REPOSITORY

DRIVE = DATA / "drive_0708"
OUTAGES = [(243433.499 + 45.0 * i, 15.0) for i in range(8)]
SHIFTS_S = (0.0, 9.0, 18.0, 27.0, 36.0)

pytestmark = pytest.mark.skipif(
    not DRIVE.is_dir(), reason=f"real drive drive_0708 is absent: {DRIVE} (set FUSIOND_DATA)"
)


class Processed(NamedTuple):
    """What `process` said, and its table."""

    result: dict[str, Any]
    solution: TrajectoryTable


Outages = Callable[[float, bool], Processed]


def _process(out: Path, outages: list[tuple[float, float]], smooth: bool = False) -> Processed:
    """Smoothed, the fixes' errors count as white: the track is the receiver's own, so that what its
    fixes share is in it, and the comparison cannot see what sigma allows for it."""
    config = load_config(REPOSITORY / "config" / "drive_0708.toml")
    if smooth:
        white = config.aiding["gnss"].model_copy(update={"bias_sd_m": 0.0})
        config = config.model_copy(update={"aiding": {**config.aiding, "gnss": white}})
    measurements = [("gnss", DRIVE / "gnss.csv")]
    result = process(config, DRIVE / "imu.csv", measurements, outages, out, smooth=smooth)
    return Processed(result, read_solution(out))


@pytest.fixture(scope="module")
def with_outages(tmp_path_factory: pytest.TempPathFactory) -> Outages:
    """The drive with outages shifted by so many seconds, smoothed or not: processed once each."""
    out = tmp_path_factory.mktemp("outages") / "solution.csv"
    return cache(lambda shift_s, smooth: _process(out, _shifted(shift_s), smooth))


def _shifted(shift_s: float) -> list[tuple[float, float]]:
    return [(start + shift_s, length) for start, length in OUTAGES]


def _errors(solution: TrajectoryTable, track: GnssTable, rows: Any) -> tuple[Any, Any]:
    """North and east errors (n, 2) in m at rows of the track, and the stated sigmas (n, 2)."""
    t = track.t_s[rows]
    lat, lon = track.lat_rad[rows], track.lon_rad[rows]
    there = float(lat[0])
    north = (np.interp(t, solution.t_s, solution.lat_rad) - lat) * meridian_radius(there)
    east = (np.interp(t, solution.t_s, solution.lon_rad) - lon) * transverse_radius(there)
    sigma = [np.interp(t, solution.t_s, solution.sd_position[:, i]) for i in range(2)]
    return np.column_stack([north, east * np.cos(there)]), np.column_stack(sigma)


def test_follows_the_track_from_nothing_but_the_data(tmp_path: Path) -> None:
    result, solution = _process(tmp_path / "solution.csv", [])
    assert result["aligned"] == "GNSS course, on the move"
    assert result["mode"] == "navigating"
    report = compare(solution, read_truth(DRIVE / "gnss.csv"), after_s=60.0)
    assert report["horizontal_rms_m"] <= 0.10


def _in_outages(solution: TrajectoryTable, shift_s: float) -> tuple[Any, Any]:
    """The largest error (m) in each outage, and by epoch whether the track is inside two sigma."""
    track = read_gnss(DRIVE / "gnss.csv")
    largest, inside = [], []
    for start, length in _shifted(shift_s):
        rows = (track.t_s >= start) & (track.t_s < start + length)
        error, sigma = _errors(solution, track, rows)
        largest.append(np.hypot(*error.T).max())
        inside.append(((error / sigma) ** 2).sum(axis=1) <= 4.0)
    return np.array(largest), np.concatenate(inside)


def test_outages_and_their_stated_sigma(with_outages: Outages) -> None:
    inside = []
    for shift_s in SHIFTS_S:
        result, solution = with_outages(shift_s, False)
        assert result["sources"]["gnss"]["withheld"] == 8 * 60  # 4 Hz
        largest, inside_now = _in_outages(solution, shift_s)
        assert np.sqrt(np.mean(np.square(largest))) <= 5.0
        inside.append(inside_now)
    assert np.concatenate(inside).mean() >= 0.90


WIDE = pytest.mark.xfail(
    strict=True, reason="fixes of 1 cm by quality 1 count with 0.3 m: sigma in outages is too wide"
)


@pytest.mark.parametrize("smooth", [pytest.param(False, marks=WIDE), True])
def test_sigma_in_outages_is_not_too_wide(with_outages: Outages, smooth: bool) -> None:
    shifts_s = (0.0,) if smooth else SHIFTS_S
    inside = [_in_outages(with_outages(s, smooth).solution, s)[1] for s in shifts_s]
    assert np.concatenate(inside).mean() <= 0.995


def test_smoothed_outages_and_their_stated_sigma(with_outages: Outages) -> None:
    result, solution = with_outages(0.0, True)
    assert result["smoothed"]["rows"] == result["solution_rows"]
    largest, inside = _in_outages(solution, 0.0)
    assert np.sqrt(np.mean(np.square(largest))) <= 0.5
    assert inside.mean() >= 0.80
