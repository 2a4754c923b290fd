r"""Standstill detector: the sensor is quiet over a window.

Over the samples of a window of the IMU (about 1 s), per axis,

    s_w = std(w),  s_f = std(f),   quiet if max s_w < a, max s_f < b and |mean w| < c

and if the mean force is that of the rest's first window, to within b: a smooth start is not rest.
An engine shakes the IMU and a passenger rocks the car, so the thresholds a, b, c belong to the
vehicle and stand in its configuration. Windows lie on a fixed grid of time, so the verdict is a
function of the samples alone, however they were handed over.

Source: Skog, Handel, Nilsson, Rantakokko, Zero-velocity detection: an algorithm evaluation, IEEE
T-BME 57 (2010), the moving-variance and rate-energy detectors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]

# A window with fewer samples says nothing about a standard deviation.
FEWEST_SAMPLES = 10
# Sigmas at which a rate is no bias of the gyro's data sheet.
BIAS_SIGMAS = 3.0
# Quiet windows in a row that are averaged: ten seconds, in which the rocking of a vehicle at rest
# averages out and a slow turn does not.
LONGEST_RUN = 10


@dataclass(frozen=True, slots=True)
class QuietLimits:
    """Upper limits: standard deviations per axis and mean rate, SI units; the window in ns."""

    window_ns: int
    rate_sd: float
    force_sd: float
    mean_rate: float


@dataclass(frozen=True, slots=True)
class Window:
    """A finished window: its end, means (3,) and whether the sensor was quiet in all of it.

    `run_rate` (3,) is the mean rate of the last `run` quiet windows in a row, this one with them;
    `scatter` (3,) the variance of one of them, as they differ (nothing where there is one).
    """

    end_ns: int
    samples: int
    mean_rate: Array
    mean_force: Array
    quiet: bool
    run: int
    run_rate: Array
    scatter: Array


@compiled("void(f8[:, ::1], i8, i8, f8[::1], f8[::1])")
def _moments(samples: Array, first: int, end: int, mean: Array, sd: Array) -> None:
    count = end - first
    for j in range(6):
        total = 0.0
        for i in range(first, end):
            total += samples[i, j]
        mean[j] = total / count
        total = 0.0
        for i in range(first, end):
            d = samples[i, j] - mean[j]
            total += d * d
        sd[j] = np.sqrt(total / count)


@compiled("i8(i8[::1], i8, i8, i8, i8)")
def next_cell(times: NDArray[np.int64], first: int, end: int, width_ns: int, cell: int) -> int:
    """The first of rows first ... end-1 that lies in another cell of the grid of time than `cell`;
    -1 where none does."""
    for i in range(first, end):
        if times[i] // width_ns != cell:
            return i
    return -1


def judge(
    times: NDArray[np.int64], samples: Array, first: int, end: int, limits: QuietLimits
) -> Window:
    """Judge rows first ... end-1 as one window."""
    mean, sd = np.zeros(6), np.zeros(6)
    _moments(samples, first, end, mean, sd)
    x, y, z, *force_sd = sd.tolist()
    mx, my, mz = mean[:3].tolist()
    quiet = (
        end - first >= FEWEST_SAMPLES
        and max(x, y, z) < limits.rate_sd
        and max(force_sd) < limits.force_sd
        and max(abs(mx), abs(my), abs(mz)) < limits.mean_rate
    )
    rate = mean[:3]
    return Window(int(times[end - 1]), end - first, rate, mean[3:], quiet, 1, rate, np.zeros(3))


class StandstillDetector:
    """Cuts the stream of samples into windows on a fixed grid and judges each once."""

    def __init__(self, limits: QuietLimits) -> None:
        self.limits = limits
        self._first: int | None = None
        self._reference: Array | None = None
        self._run: list[Array] = []

    def feed(
        self, times: NDArray[np.int64], samples: Array, start: int, new: int, end: int
    ) -> list[Window]:
        """Judge the windows that rows `new` ... `end`-1 complete. `start` numbers row 0.

        A window is complete with the first sample of the next one; it is judged if all of its
        rows are still held.
        """
        windows: list[Window] = []
        width = self.limits.window_ns
        if self._first is None:
            self._first = start + new
        row = max(new - 1, 0)
        while (stop := next_cell(times, row, end, width, int(times[row]) // width)) >= 0:
            row = stop
            first = self._first - start
            if 0 <= first < stop:
                windows.append(self._judged(judge(times, samples, first, stop, self.limits)))
            self._first = start + stop
        return windows

    def _judged(self, w: Window) -> Window:
        """With the quiet windows before it: none itself if the mean force has left that of the
        first window of this rest."""
        if not w.quiet:
            self._reference, self._run = None, []
            return w
        if self._reference is None:
            self._reference = w.mean_force
        elif np.abs(w.mean_force - self._reference).max() > self.limits.force_sd:
            self._reference, self._run = None, []
            return replace(w, quiet=False)
        self._run = [*self._run, w.mean_rate][-LONGEST_RUN:]
        if len(self._run) == 1:
            return w
        rate: Array = np.add.reduce(self._run) / len(self._run)
        scatter: Array = np.add.reduce(np.square(self._run - rate)) / (len(self._run) - 1)
        return replace(w, run=len(self._run), run_rate=rate, scatter=scatter)
