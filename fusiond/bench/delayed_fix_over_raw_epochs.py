"""Cost of the tick in which a delayed RDSS fix arrives over raw GNSS epochs.

IMU at 200 Hz, a receiver's raw epochs of 40 satellites with two frequencies at 10 Hz, ticks at 100
Hz. The tick inserts the delayed fix, repeats the epochs since then, and reads the solution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count

import numpy as np

from fusiond.bench.delayed_fix import tick_of_delayed_fix
from fusiond.bench.raw_epoch import SIGNALS, Crowd
from fusiond.configuration.schema import Config
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.gnss.raw import GnssRaw, GnssRawOptions
from fusiond.simulation.scenarios import CAR_IMU, SCENARIOS

RATE_HZ, EPOCHS_HZ = 200.0, 10.0
DELAY_S = 1.5
"""Age of an RDSS fix as it comes: docs/rdss-terminal.md."""
AT_S, EVERY_S = 90.0, 2.0
"""Time of the first delayed fix after the start, and the interval between delayed fixes."""
SAMPLES, TICK_SAMPLES = round(RATE_HZ / EPOCHS_HZ), round(RATE_HZ / 100.0)


class RawDrive:
    """Navigator on a drive with raw epochs, run tick by tick, with delayed fixes inserted."""

    def __init__(self, repetitions: int) -> None:
        scenario = SCENARIOS["drive"]
        imu = CAR_IMU.model_copy(update={"rate_hz": RATE_HZ})
        self.truth = replace(scenario, imu=imu).truth(AT_S + (repetitions + 1) * EVERY_S)
        rng = np.random.default_rng(1)
        output = replace(scenario, imu=imu).imu_output(self.truth, rng)
        self._times = np.rint(self.truth.t_s[1:] * 1e9).astype(np.int64)
        self._samples = np.hstack((output.gyro, output.accel))
        options = GnssRawOptions(rate_hz=EPOCHS_HZ, signals=SIGNALS)
        self._receiver = GnssRaw(self.truth, options, rng)
        aiding = {"raw": {"kind": "raw", "systems": ["G", "C"]}, "rdss": {}}
        self.navigator = Navigator(Config.model_validate({"imu": imu, "aiding": aiding}))
        self._crowd = Crowd(self._receiver, 0, self.navigator.raw["raw"], "raw")
        self._row = self._epoch = 0

    def delayed(self, number: int) -> Callable[[], int]:
        """Drive on to the next delayed fix, and return the tick of its arrival as the work to
        time."""
        self.go_on(AT_S + number * EVERY_S)
        now = int(self._times[self._row - 1])
        return tick_of_delayed_fix(self, now - round(DELAY_S * 1e9), now)

    def go_on(self, until_s: float) -> None:
        """Advance to `until_s`, tick by tick."""
        until = round(until_s * RATE_HZ)
        while self._row < until:
            self.tick()
        assert self.navigator.started is not None

    def tick(self) -> None:
        """Add the samples of one tick and the epochs that they have reached; read the solution."""
        rows = slice(self._row, self._row + TICK_SAMPLES)
        self._row = rows.stop
        self.navigator.add_imu(self._times[rows], self._samples[rows])
        now = int(self._times[self._row - 1])
        r = self._receiver
        while self._epoch < len(r) and round(float(r.t_s[self._epoch]) * 1e9) <= now:
            t_ns = round(float(r.t_s[self._epoch]) * 1e9)
            self.navigator.add(self._crowd.of(r.epoch(self._epoch)), t_ns)
            self._epoch += 1
        self.navigator.tick(now)
        self.navigator.solution(now)


def delayed_raw(repetitions: int) -> Callable[[int], Callable[[], int]]:
    """Make a function whose every call returns the tick of the next delayed fix as the work to
    time."""
    drive, numbers = RawDrive(repetitions), count()
    return lambda _: drive.delayed(next(numbers))
