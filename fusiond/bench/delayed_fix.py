"""Cost of the worst tick: a fix arrives 10 s late, and the filter repeats 10 s.

IMU at 200 Hz, a receiver's position and velocity and a wheel's speed at 10 Hz each, ticks at 100
Hz. The tick in which the late fix arrives inserts it, repeats the last 10 s with 2000 samples and
300 measurements, and reads the solution. A tick has 10 ms for all its work.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Protocol

import numpy as np

from drivers.measurements import DelayedFix, MonotonicStamp, PositionFix, WheelSpeed
from fusiond.configuration.schema import Config
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.gnss.receiver import GnssReceiver
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.scenarios import CAR_IMU, SCENARIOS

RATE_HZ, FIXES_HZ = 200.0, 10.0
DELAY_S = 10.0
AT_S, EVERY_S = 110.0, 1.0
"""Time of the first delayed fix after the start, and the interval between delayed fixes."""
SAMPLES, TICK_SAMPLES = round(RATE_HZ / FIXES_HZ), round(RATE_HZ / 100.0)


class Driven(Protocol):
    """Simulated drive: its navigator, its truth, and the work of one tick."""

    navigator: Navigator
    truth: Truth

    def tick(self) -> None: ...


def tick_of_delayed_fix(drive: Driven, at: int, now: int) -> Callable[[], int]:
    """Run the tick at `now` (ns) in which an RDSS fix, valid at `at`, arrives."""
    lat, lon, height = drive.truth.at(np.array([at * 1e-9])).position[0].tolist()
    fix = DelayedFix("rdss", now, MonotonicStamp(at), lat, lon, height, 20.0)

    def work() -> int:
        rewinds = drive.navigator.timeline.counters.rewinds
        assert drive.navigator.add(fix, at, seen_ns=now) == "accepted"
        drive.tick()
        assert drive.navigator.timeline.counters.rewinds > rewinds
        return 1

    return work


class Drive:
    """Navigator on a drive, run from measurement to measurement, with delayed fixes inserted."""

    def __init__(self, repetitions: int) -> None:
        scenario = SCENARIOS["drive"]
        imu = CAR_IMU.model_copy(update={"rate_hz": RATE_HZ})
        scenario = replace(scenario, imu=imu, gnss=replace(scenario.gnss, rate_hz=FIXES_HZ))
        self.truth = scenario.truth(AT_S + (repetitions + 1) * EVERY_S)
        rng = np.random.default_rng(1)
        output = scenario.imu_output(self.truth, rng)
        self._times = np.rint(self.truth.t_s[1:] * 1e9).astype(np.int64)
        self._samples = np.hstack((output.gyro, output.accel))
        self.receiver = GnssReceiver(self.truth, scenario.gnss, rng)
        lever = {"lever_arm_m": scenario.gnss.lever_arm_m}
        aiding = {"gnss": lever, "wheel": {"lever_arm_m": scenario.no_slip_m}, "rdss": lever}
        self.navigator = Navigator(Config.model_validate({"imu": imu, "aiding": aiding}))
        self._row = 0

    def delayed(self, number: int) -> Callable[[], int]:
        """Drive on to the next delayed fix, and return the tick of its arrival as the work to
        time."""
        self.go_on(AT_S + number * EVERY_S)
        row = self._row - round(DELAY_S * RATE_HZ)
        return tick_of_delayed_fix(self, int(self._times[row]), int(self._times[self._row - 1]))

    def go_on(self, until_s: float) -> None:
        """Advance to `until_s`, the instant of the next epoch."""
        until = round(until_s * RATE_HZ)
        while self._row < until:
            self.to_next_fix()
            self.fix()
            self._wheel()
            self._row += TICK_SAMPLES
            self.navigator.advance()
        assert self.navigator.started is not None

    def tick(self) -> None:
        """Add the samples of one tick and read its solution."""
        self._feed(TICK_SAMPLES)
        self.navigator.solution(int(self._times[self._row - 1]))

    def to_next_fix(self) -> None:
        """Add the samples up to and including the next epoch, and run the filter up to the tick
        before."""
        self._feed(SAMPLES - TICK_SAMPLES - self._row % SAMPLES)
        rows = slice(self._row, self._row + TICK_SAMPLES)
        self.navigator.add_imu(self._times[rows], self._samples[rows])

    def take_fix(self) -> None:
        """Insert the fix of the next epoch, run the filter, read the solution."""
        self.fix()
        self._row += TICK_SAMPLES
        self.navigator.advance()
        self.navigator.solution(int(self._times[self._row - 1]))

    def _feed(self, samples: int) -> None:
        rows = slice(self._row, self._row + samples)
        self.navigator.add_imu(self._times[rows], self._samples[rows])
        self.navigator.advance()
        self._row = rows.stop

    def fix(self) -> None:
        """Next epoch of the receiver."""
        r, epoch = self.receiver, self._row // SAMPLES
        t_ns = round(float(r.t_s[epoch]) * 1e9)
        stamp = MonotonicStamp(t_ns)
        lat, lon, height = r.position[epoch].tolist()
        n, e, d = r.v_ned[epoch].tolist()
        fix = PositionFix("gnss", t_ns, stamp, lat, lon, height, sd_ned_m=r.sd_ned_m)
        fix = replace(fix, v_ned_m_s=(n, e, d), sd_v_ned_m_s=r.sd_v_ned_m_s)
        self.navigator.add(fix, t_ns)

    def _wheel(self) -> None:
        """Add the wheel's speed at an epoch."""
        r, epoch = self.receiver, self._row // SAMPLES
        t_ns = round(float(r.t_s[epoch]) * 1e9)
        n, e, _ = r.v_ned[epoch].tolist()
        speed = WheelSpeed("wheel", t_ns, MonotonicStamp(t_ns), math.hypot(n, e))
        self.navigator.add(speed, t_ns)


def delayed_fix(repetitions: int) -> Callable[[int], Callable[[], int]]:
    """Make a function whose every call returns the tick of the next delayed fix as the work to
    time."""
    drive, numbers = Drive(repetitions), count()
    return lambda _: drive.delayed(next(numbers))
