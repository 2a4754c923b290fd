"""Restarts from the state of moments ago at random instants of a drive, faster than real time:

    python benchmarks/restarts.py [TIMES] [--seed S]

What `benchmarks/kill_nine.py` does to the daemon's process is done here to clock and navigator
alone: at each instant a new pair gets what the old one would have kept, after a gap that is drawn.
JSON: how many first errors, and errors of the two seconds after them, are beyond three sigma, by
figure; beside it the same of the run that never stopped.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import PositionFix, TimeReport, UtcStamp
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.restart_from_memory import LONGEST_GAP_S, WarmStart, warm_state
from fusiond.simulation.gnss.receiver import GnssReceiver
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.scenarios import ANTENNA_M, SCENARIOS, random_streams
from fusiond.simulation.trajectories import drive
from fusiond.studies.faults.error_sigma_score import QUANTITIES
from fusiond.studies.faults.runs import error_sample
from fusiond.studies.faults.sensor_data import gnss_fixes

Array = NDArray[np.float64]

SECOND = 1_000_000_000
BEGIN_NS = 7_000 * SECOND
UTC_NS = 1_780_000_000 * SECOND
DURATION_S = 1500.0
SETTLED_S = 60.0
WATCHED_S = 2.0
LEAST_GAP_S = 0.3
RATE_HZ = 100.0
CONFIG = Config.model_validate(
    {
        "imu": {"axes": ("+x", "-y", "-z")},
        "aiding": {"gnss": {"lever_arm_m": ANTENNA_M}},
        "alignment": {"heading": ["gnss_course"]},
    }
)


@dataclass
class Host:
    """Host time; the system clock is right."""

    now_ns: int = BEGIN_NS

    def monotonic_ns(self) -> int:
        return self.now_ns

    slewed_ns = monotonic_ns

    def realtime_ns(self) -> int:
        return UTC_NS + self.now_ns - BEGIN_NS

    def boottime_ns(self) -> int:
        return self.now_ns


@dataclass(frozen=True)
class Received:
    """Samples (n, 6) with their stamps (n,) ns; fixes in order of arrival and when that was."""

    truth: Truth
    stamps: NDArray[np.int64]
    samples: Array
    fixes: list[PositionFix]
    seen: NDArray[np.int64]


def received(seed: int) -> Received:
    """What IMU and receiver of `fusiond simulate drive` say."""
    scenario = replace(SCENARIOS["drive"], path=partial(drive, rest_s=5.0))
    truth = scenario.truth(DURATION_S)
    imu_rng, gnss_rng, *_ = random_streams(seed)
    imu = scenario.imu_output(truth, imu_rng)
    fixes = []
    for item in gnss_fixes(GnssReceiver(truth, scenario.gnss, gnss_rng)):
        assert isinstance(item.measurement, PositionFix)
        north, east, _ = item.measurement.v_ned_m_s or (0.0, 0.0, 0.0)
        stamp = UtcStamp(UTC_NS + item.t_ns)
        fix = replace(item.measurement, t_seen_ns=BEGIN_NS + item.seen_ns, stamp=stamp)
        fixes.append(replace(fix, v_ned_m_s=(north, east, None)))
    stamps = BEGIN_NS + np.rint(truth.t_s[1:] * 1e9).astype(np.int64)
    samples = np.hstack((imu.gyro, imu.accel))
    return Received(truth, stamps, samples, fixes, np.array([f.t_seen_ns for f in fixes]))


class Process:
    """Clock and navigator, from row `row` on."""

    def __init__(self, data: Received, row: int) -> None:
        self._data, self._row = data, row
        self._host = Host(int(data.stamps[row]))
        self.clock = Clock(CONFIG.clock, self._host)
        self.navigator = Navigator(CONFIG)

    def run(self) -> Iterator[int]:
        """A sample at a time; the rows that have been navigated."""
        d = self._data
        for row in range(self._row, len(d.stamps)):
            before = int(d.stamps[row - 1]) if row > self._row else int(d.stamps[row]) - 1
            now = self._host.now_ns = int(d.stamps[row])
            self.navigator.add_imu(d.stamps[row : row + 1], d.samples[row : row + 1])
            for k in range(*np.searchsorted(d.seen, [before, now], side="right").tolist()):
                self._take(d.fixes[k])
            self.navigator.advance()
            yield row

    def _take(self, fix: PositionFix) -> None:
        assert isinstance(fix.stamp, UtcStamp)
        seen = fix.t_seen_ns
        self.clock.report(TimeReport("gnss", seen, fix.stamp.utc_ns, True))
        instant = self.clock.resolve(fix.stamp, "gnss", seen)
        self.navigator.add(fix, instant.t_valid_ns, instant.sd_s, seen)

    def ratios(self, row: int) -> Array:
        """Errors of QUANTITIES in sigmas; none before there is a solution."""
        said = self.navigator.solution(int(self._data.stamps[row]))
        if said.mode not in (Mode.NAVIGATING, Mode.COASTING):
            return np.zeros(len(QUANTITIES))
        at = replace(said, t_ns=said.t_ns - BEGIN_NS)
        true = self._data.truth.at(np.array([at.t_ns * 1e-9]))
        return np.array(error_sample(at, true).ratios)


def restarted(old: Process, data: Received, row: int, gap_s: float) -> tuple[Array, Array]:
    """First errors, and the greatest of the time after, of a process that follows `old`."""
    navigator, clock = old.navigator, old.clock
    state = warm_state(
        navigator.estimator, navigator.imu, "GNSS course", "", "boot", 0, confirmed=True
    )
    new = Process(data, row + round(gap_s * RATE_HZ))
    new.navigator.trial.warm = WarmStart(state, new.navigator.model)
    new.clock.resume(clock.known())
    found = [
        new.ratios(k) for k, _ in zip(new.run(), range(round(WATCHED_S * RATE_HZ)), strict=False)
    ]
    return found[0], np.max(found, axis=0)


def measure(times: int, seed: int) -> dict[str, Any]:
    """The restarts of one drive."""
    rng = np.random.default_rng(seed)
    data = received(seed)
    last = len(data.stamps) - round((LONGEST_GAP_S + WATCHED_S) * RATE_HZ)
    rows = rng.choice(np.arange(round(SETTLED_S * RATE_HZ), last), times, replace=False)
    at = set(rows.tolist())
    process = Process(data, 0)
    first, later, never = [], [], []
    window: list[Array] = []
    for row in process.run():
        if row < SETTLED_S * RATE_HZ or process.navigator.started is None:
            continue
        window.append(process.ratios(row))
        if len(window) == round(WATCHED_S * RATE_HZ):
            never.append(np.max(window, axis=0))
            window.clear()
        if row in at:
            gap_s = float(rng.uniform(LEAST_GAP_S, LONGEST_GAP_S - 0.1))
            found = restarted(process, data, row, gap_s)
            first.append(found[0])
            later.append(found[1])
    return {
        "restarts": len(first),
        "first": _beyond(first),
        "two_seconds": _beyond(later),
        "two_seconds_without_restart": {"windows": len(never), **_beyond(never)},
    }


def _beyond(found: list[Array]) -> dict[str, Any]:
    """By figure: the part beyond three sigma and the greatest, in sigmas."""
    ratios = np.array(found)
    return {
        name: {
            "beyond_3_sigma": round(float((column > 3.0).mean()), 4),
            "greatest": round(float(column.max()), 2),
        }
        for name, column in zip(QUANTITIES, ratios.T, strict=True)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("times", type=int, nargs="?", default=500)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    print(json.dumps(measure(args.times, args.seed), indent=1))


if __name__ == "__main__":
    main()
