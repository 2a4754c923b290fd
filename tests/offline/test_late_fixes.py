"""Fixes that are constantly late, from files: solutions are then by the IMU's clock, and their
sigma, filtered or smoothed, holds what that clock may be off by; runs whose clocks are off by what
the configuration allows, at the quantiles of the normal distribution, show whether it does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fusiond.files.measurement_csv import TrajectoryTable, read_solution, read_truth
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigator.navigator import Navigator
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.studies.faults.runs import VEHICLE
from fusiond.studies.faults.sensor_data import town

Array = NDArray[np.float64]

RUNS = 3
CLOCK_SD_S = VEHICLE.aiding["gnss"].time_offset_sd_s
"""Of a receiver that is on time against the IMU, by the configuration."""
LATE_S = 0.8
GNSS_HZ = 2.0
SECONDS, SETTLED_S = 46.0, 42.0
"""Off after 15 s: that tells that the fixes are late, and a bend from 35 s on by how much."""


class Said(NamedTuple):
    """By one run, filtered while it ran and smoothed in its file: times (n,) in s, latitude and
    longitude (n, 2), sigmas (n, 9)."""

    t_s: Array
    place: Array
    sigmas: Array

    def squares(self, truth: TrajectoryTable) -> float:
        """Mean over the seconds after `SETTLED_S` of the squared errors north and east to sigma."""
        at = np.searchsorted(self.t_s, np.arange(SETTLED_S, SECONDS - 1.0, 0.5))
        t, lat = self.t_s[at], float(truth.lat_rad[0])
        true = [np.interp(t, truth.t_s, v) for v in (truth.lat_rad, truth.lon_rad)]
        metres = meridian_radius(lat), transverse_radius(lat) * np.cos(lat)
        errors = (self.place[at] - np.column_stack(true)) * metres / self.sigmas[at, :2]
        return float(np.square(errors).sum(axis=1).mean())


class Run(NamedTuple):
    """What it said; `without_overlap`, by how much at most the sigmas of a row are another's than
    those of the daemon's solution of that instant; and the truth."""

    filtered: Said
    smoothed: Said
    without_overlap: float
    truth: TrajectoryTable


def _shifted(path: Path, by_s: float, columns: int) -> None:
    """Add to the first columns, which are times."""
    header, *lines = path.read_text().splitlines()
    rows = [line.split(",", columns) for line in lines]
    text = [",".join([*(f"{float(t) + by_s:.6f}" for t in r[:-1]), r[-1]]) for r in rows]
    path.write_text("\n".join([header, *text]) + "\n")


def _driven(folder: Path, run: int) -> Run:
    scenario = SCENARIOS["drive"]
    receiver = replace(scenario.gnss, rate_hz=GNSS_HZ)
    simulate(replace(scenario, path=town, gnss=receiver), folder, run, SECONDS)
    _shifted(folder / "gnss.csv", LATE_S, 2)
    _shifted(folder / "imu.csv", CLOCK_SD_S * NormalDist().inv_cdf((run + 0.5) / RUNS), 1)
    rows, without_overlap = [], [0.0]

    def watch(navigator: Navigator) -> None:
        e, imu = navigator.estimator, navigator.imu
        if navigator.started is None or e.t_ns < SETTLED_S * 1e9:
            return
        s = navigator.solution(e.t_ns)
        said = np.array([*s.sd_ned_m, *s.sd_v_ned_m_s, *s.sd_rpy_rad])
        rows.append(np.array([e.t_ns * 1e-9, s.lat_rad, s.lon_rad, *said]))
        row = e.sample - 1 - imu.start
        if imu.times[row] == e.t_ns:  # nothing has been fused since it was written
            without_overlap.append(float(np.abs(imu.sigmas[row] / said - 1.0).max()))

    out = folder / "solution.csv"
    measurements = [("gnss", folder / "gnss.csv")]
    result = process(VEHICLE, folder / "imu.csv", measurements, out=out, watch=watch, smooth=True)
    assert "fixes_late" in [event["code"] for event in result["events"]]
    file, told = read_solution(out), np.array(rows)
    assert len(without_overlap) > 10
    return Run(
        Said(told[:, 0], told[:, 1:3], told[:, 3:]),
        Said(
            file.t_s,
            np.column_stack((file.lat_rad, file.lon_rad)),
            np.hstack((file.sd_position, file.sd_v, file.sd_rpy)),
        ),
        max(without_overlap),
        read_truth(folder / "truth.csv"),
    )


def test_sigma_holds_what_the_clock_may_be_off_by(tmp_path: Path) -> None:
    runs = [_driven(tmp_path / str(run), run) for run in range(RUNS)]
    # A clock is off by the same all drive: of each run the mean over it counts once.
    low, high = (chi2.ppf(p, 2 * RUNS) / RUNS for p in (0.025, 0.975))
    assert low <= sum(run.filtered.squares(run.truth) for run in runs) / RUNS <= high
    assert low <= sum(run.smoothed.squares(run.truth) for run in runs) / RUNS <= high
    # What is fused at the very instant of a sample comes after its row; the clock is a factor of 5.
    assert max(run.without_overlap for run in runs) < 0.01
