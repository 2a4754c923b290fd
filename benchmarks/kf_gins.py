"""`fusiond process` beside KF-GINS, another filter of 21 states, over the same files:

    python benchmarks/kf_gins.py PROGRAM [PROGRAM ...] [--pairs N]

PROGRAM is an executable of KF-GINS (https://github.com/i2Nav-WHU/KF-GINS, C++), built by whoever
measures: nothing of it is here. Three cases: `long`, 3361 s at 200 Hz with a fix a second (672,200
samples); `short`, a minute of it from moving off; `drive`, the recorded drive `drive_0708` (100 Hz,
four fixes a second), where its data is there. Both propagate a covariance and write solution and
sigmas at each sample. KF-GINS is given its initial state, the truth of a simulation or what fusiond
begins the recorded drive with; fusiond aligns itself, reads velocities too and judges each fix.

Processor time of whole processes, user and system, taken in turns; of the ratios of the pairs the
median, smallest and largest. Both solutions' horizontal errors stand beside them (RMS from 30 s
after the start; of the recorded drive the distance from its RTK track): what is timed must work.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.load import load_config
from fusiond.configuration.si_units import sensor_to_body
from fusiond.files.measurement_csv import (
    GnssTable,
    TrajectoryTable,
    read_gnss,
    read_imu,
    read_solution,
    read_truth,
)
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import CAR_IMU, SCENARIOS

Array = NDArray[np.float64]

PAIRS = 5
LONG_S, SHORT_S, MOVES_OFF_S = 3361.0, 60.0, 58.0
SETTLED_S = 30.0
ROOT = Path(__file__).resolve().parent.parent
RECORDED = Path(os.environ.get("FUSIOND_DATA", ROOT.parent / "shared/data")) / "drive_0708"
SIMULATED = """\
[imu]
rate_hz = 200.0
axes = ["+x", "-y", "-z"]
[aiding.gnss]
lever_arm_m = [0, 0, -1]
"""
# Noise of the sensor class of both; the units are those that its author chose.
OPTIONS = """\
imupath: "{folder}/imu.txt"
gnsspath: "{folder}/gnss.txt"
outputpath: "{folder}/out"
imudatalen: 7
imudatarate: {rate}
starttime: {start}
endtime: -1
initpos: {position}
initvel: {velocity}
initatt: {attitude}
initgyrbias: [0, 0, 0]
initaccbias: [0, 0, 0]
initgyrscale: [0, 0, 0]
initaccscale: [0, 0, 0]
initposstd: [0.1, 0.1, 0.2]
initvelstd: [0.1, 0.1, 0.1]
initattstd: [0.5, 0.5, 3.0]
imunoise:
  arw: [0.3, 0.3, 0.3]
  vrw: [0.1, 0.1, 0.1]
  gbstd: [100.0, 100.0, 100.0]
  abstd: [1000.0, 1000.0, 1000.0]
  gsstd: [1000.0, 1000.0, 1000.0]
  asstd: [1000.0, 1000.0, 1000.0]
  corrtime: 1.0
antlever: {lever}
"""


@dataclass
class Case:
    """The files of one comparison, and what solutions are held against."""

    name: str
    folder: Path
    config: Path
    imu: Path
    gnss: Path
    rate_hz: float
    samples: int
    truth: TrajectoryTable | GnssTable

    @property
    def command(self) -> list[str]:
        """Of fusiond."""
        files = ["--imu", str(self.imu), "--aid", f"gnss={self.gnss}", "--out", str(self.solution)]
        return [sys.executable, "-m", "fusiond", "process", str(self.config), *files]

    @property
    def solution(self) -> Path:
        """What fusiond writes."""
        return self.folder / "solution.csv"


def _cut(path: Path, out: Path, first_s: float, last_s: float) -> None:
    """Rows of a table whose time lies within."""
    head, *rows = path.read_text().splitlines()
    kept = [row for row in rows if first_s <= float(row.partition(",")[0]) < last_s]
    out.write_text("\n".join([head, *kept]) + "\n")


def _simulated(folder: Path) -> list[Case]:
    drive = SCENARIOS["drive"]
    gnss = replace(drive.gnss, rate_hz=1.0, latency_s=(0.0, 0.0))
    imu = CAR_IMU.model_copy(update={"rate_hz": 200.0})
    made = simulate(replace(drive, imu=imu, gnss=gnss), folder / "long", duration_s=LONG_S)
    short = folder / "short"
    short.mkdir()
    for name in ("imu", "gnss"):
        _cut(made.files[name], short / f"{name}.csv", MOVES_OFF_S, MOVES_OFF_S + SHORT_S)
    truth = read_truth(made.files["truth"])
    cases = []
    for name, files in (("long", folder / "long"), ("short", short)):
        (files / "config.toml").write_text(SIMULATED)
        tables = files / "imu.csv", files / "gnss.csv"
        samples = len(read_imu(tables[0]).t_s)
        cases.append(Case(name, files, files / "config.toml", *tables, 200.0, samples, truth))
    return cases


def _recorded(folder: Path) -> list[Case]:
    if not RECORDED.is_dir():
        print(f"no {RECORDED}: without the recorded drive")
        return []
    folder = folder / "drive"
    folder.mkdir()
    imu, gnss = RECORDED / "imu.csv", RECORDED / "gnss.csv"
    count, config = len(read_imu(imu).t_s), ROOT / "config/drive_0708.toml"
    return [Case("drive", folder, config, imu, gnss, 100.0, count, read_gnss(gnss))]


def prepare(case: Case) -> None:
    """Run fusiond once, and write what KF-GINS reads beside it."""
    subprocess.run(case.command, check=True, stdout=subprocess.DEVNULL)
    config, imu, gnss = load_config(case.config), read_imu(case.imu), read_gnss(case.gnss)
    begin = read_solution(case.solution)
    if isinstance(case.truth, TrajectoryTable):
        begin = case.truth
    # Its first sample is only where it begins.
    first_s = max(imu.t_s[0], begin.t_s[0])
    at = int(np.searchsorted(begin.t_s, first_s))
    turn = sensor_to_body(config.imu).T
    h = np.diff(imu.t_s, prepend=imu.t_s[0] - 1.0 / case.rate_hz)[:, None]
    rows = np.column_stack((imu.t_s, imu.gyro @ turn * h, imu.accel @ turn * h))
    np.savetxt(case.folder / "imu.txt", rows, fmt="%.9f" + " %.12e" * 6)
    sd = np.where(np.isnan(gnss.sd_position), 1.0, gnss.sd_position)
    place = np.column_stack((*np.degrees((gnss.lat_rad, gnss.lon_rad)), gnss.height_m, sd))
    lines = [
        f"{t:.9f} {lat:.12f} {lon:.12f} {height:.6f} {north:.4f} {east:.4f} {down:.4f}"
        for t, (lat, lon, height, north, east, down) in zip(gnss.t_s, place, strict=True)
    ]
    (case.folder / "gnss.txt").write_text("\n".join(lines))  # a last line end would count
    lat, lon = np.degrees((begin.lat_rad[at], begin.lon_rad[at])).tolist()
    said = OPTIONS.format(
        folder=case.folder,
        rate=round(case.rate_hz),
        start=float(begin.t_s[at]),
        position=[lat, lon, float(begin.height_m[at])],
        velocity=begin.v[at].tolist(),
        attitude=np.degrees(begin.rpy[at]).tolist(),
        lever=list(config.aiding["gnss"].lever_arm_m),
    )
    (case.folder / "kf-gins.yaml").write_text(said)
    (case.folder / "out").mkdir()


def error_m(case: Case, t_s: Array, lat_rad: Array, lon_rad: Array) -> float:
    """RMS of the horizontal distance from what is held against, away from the start."""
    truth = case.truth
    inside = (truth.t_s > t_s[0] + SETTLED_S) & (truth.t_s < t_s[-1])
    at = truth.t_s[inside]
    north = (np.interp(at, t_s, lat_rad) - truth.lat_rad[inside]) * 6.37e6
    east = (np.interp(at, t_s, lon_rad) - truth.lon_rad[inside]) * 6.37e6
    east = east * np.cos(truth.lat_rad[inside])
    return float(np.sqrt(np.mean(north**2 + east**2)))


def seconds(command: list[str]) -> float:
    """Processor time of a process, user and system."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def measure(case: Case, programs: list[str], pairs: int) -> None:
    """One line for each program."""
    ours = read_solution(case.solution)
    off = error_m(case, ours.t_s, ours.lat_rad, ours.lon_rad)
    print(f"{case.name}: {case.samples} samples; fusiond {len(ours.t_s)} rows, {off:.2f} m RMS")
    for program in programs:
        command = [program, str(case.folder / "kf-gins.yaml")]
        taken = [(seconds(case.command), seconds(command)) for _ in range(pairs)]
        theirs = np.loadtxt(case.folder / "out/KF_GINS_Navresult.nav")
        off = error_m(case, theirs[:, 1], *np.radians(theirs[:, 2:4].T))
        ratios = [a / b for a, b in taken]
        print(
            f"  {Path(program).name}: {len(theirs)} rows, {off:.2f} m RMS; "
            f"{statistics.median(a for a, _ in taken):.2f} s to "
            f"{statistics.median(b for _, b in taken):.2f} s, ratio "
            f"{statistics.median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})",
            flush=True,
        )


def main() -> None:
    """Measure all cases."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("programs", nargs="+", metavar="PROGRAM")
    parser.add_argument("--pairs", type=int, default=PAIRS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="fusiond-pairs-") as folder:
        for case in [*_simulated(Path(folder)), *_recorded(Path(folder))]:
            prepare(case)
            measure(case, options.programs, options.pairs)


if __name__ == "__main__":
    main()
