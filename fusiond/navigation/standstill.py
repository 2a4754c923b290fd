r"""Standstill detector: the sensor is quiet over a window.

Over the samples of a window of the IMU (about 1 s), per axis,

    s_w = std(w),  s_f = std(f),   quiet if max s_w < a, max s_f < b and |u mean w| < c

u is the direction of the mean force, which must agree with that of the rest's first window to
within b: a smooth start is no rest. A turn about a level axis would change it, so rates about level
axes are biases of any size. An engine shakes the IMU and a passenger rocks the car, so the
thresholds a, b, c belong to the vehicle and are in its configuration. Windows lie on a fixed time
grid, so the verdict is a function of the samples alone, in chunks of any size.

Source: Skog, Handel, Nilsson, Rantakokko, Zero-velocity detection: an algorithm evaluation, IEEE
T-BME 57 (2010), the moving-variance and rate-energy detectors.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]

# A window with fewer samples says nothing about a standard deviation.
FEWEST_SAMPLES = 10
# Sigmas at which a rate is no bias of the gyro's data sheet.
BIAS_SIGMAS = 3.0
# Quiet windows in a row that are averaged: ten seconds, in which the rocking of a vehicle at rest
# averages out and a slow turn does not.
LONGEST_RUN = 10


@immutable()
class QuietLimits:
    """Upper limits: standard deviations per axis and mean rate about the vertical, SI units; the
    window in ns."""

    window_ns: int
    rate_sd: float
    force_sd: float
    mean_rate: float


@immutable()
class Window:
    """A finished window: its end, means (3,) and whether the sensor was quiet in all of it.

    `run_rate` (3,) is the mean rate of the last `run` quiet windows in a row, including this one;
    `scatter` (3,) their variance (0 for one window).
    """

    end_ns: int
    samples: int
    mean_rate: Array
    mean_force: Array
    quiet: bool
    run: int
    run_rate: Array
    scatter: Array


@compiled("void(f8[:, ::1], i8, i8, f8[:, ::1])")
def _moments(samples: Array, first: int, end: int, found: Array) -> None:
    """Write to `found` (4, 3) means and standard deviations of rate and force of rows first ...
    end-1."""
    count = end - first
    for part in range(2):
        j = 3 * part
        x = y = z = 0.0  # three sums that do not wait for each other
        for i in range(first, end):
            x += samples[i, j]
            y += samples[i, j + 1]
            z += samples[i, j + 2]
        x, y, z = x / count, y / count, z / count
        found[part, 0], found[part, 1], found[part, 2] = x, y, z
        xx = yy = zz = 0.0
        for i in range(first, end):
            dx, dy, dz = samples[i, j] - x, samples[i, j + 1] - y, samples[i, j + 2] - z
            xx += dx * dx
            yy += dy * dy
            zz += dz * dz
        found[2 + part, 0] = np.sqrt(xx / count)
        found[2 + part, 1] = np.sqrt(yy / count)
        found[2 + part, 2] = np.sqrt(zz / count)


@compiled("i8(f8[:, ::1], i8, f8[:], f8[:, ::1])")
def _lengthen(rates: Array, run: int, rate: Array, found: Array) -> int:
    """Append `rate` (3,) to the first `run` of `rates` (LONGEST_RUN, 3), dropping the oldest if
    full; returns their number. Write to `found` (2, 3) their mean and their variance, of two or
    more."""
    if run == rates.shape[0]:
        for i in range(1, run):
            for j in range(3):
                rates[i - 1, j] = rates[i, j]
        run -= 1
    for j in range(3):
        rates[run, j] = rate[j]
    run += 1
    for j in range(3):
        total = 0.0
        for i in range(run):
            total += rates[i, j]
        found[0, j] = mean = total / run
        total = 0.0
        for i in range(run):
            total += (rates[i, j] - mean) * (rates[i, j] - mean)
        found[1, j] = total / max(run - 1, 1)
    return run


@compiled("i8(i8[::1], i8, i8, i8, i8)")
def next_cell(times: NDArray[np.int64], first: int, end: int, width_ns: int, cell: int) -> int:
    """First of the rows first ... end-1 outside the time grid's `cell`; -1 if there is none."""
    begin_ns = cell * width_ns
    for i in range(first, end):
        if not 0 <= times[i] - begin_ns < width_ns:
            return i
    return -1


def _about(rate: list[float], force: list[float]) -> float:
    """Size of the part of a rate (3,) about the axis of a force (3,)."""
    along = sum(w * f for w, f in zip(rate, force, strict=True))
    return abs(along) / max(math.hypot(*force), 1e-9)


class StandstillDetector:
    """Detector of standstills; it divides the samples into windows on a fixed grid and judges each
    once."""

    def __init__(self, limits: QuietLimits) -> None:
        self.limits = limits
        self._first: int | None = None
        self._reference: list[float] | None = None
        self._rates, self._run = np.zeros((LONGEST_RUN, 3)), 0

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
                windows.append(self._judge(int(times[stop - 1]), samples, first, stop))
            self._first = start + stop
        return windows

    def _judge(self, end_ns: int, samples: Array, first: int, end: int) -> Window:
        """Judge rows first ... end-1 as one window, with the quiet windows before it. It is not
        quiet if the mean force differs from that of the first window of this rest."""
        limits, found = self.limits, np.empty((4, 3))
        _moments(samples, first, end, found)
        mean_rate, mean_force, rate_sd, force_sd = found.tolist()
        quiet = (
            end - first >= FEWEST_SAMPLES
            and max(rate_sd) < limits.rate_sd
            and max(force_sd) < limits.force_sd
            and _about(mean_rate, mean_force) < limits.mean_rate
        )
        if quiet and self._reference is not None:
            both = zip(mean_force, self._reference, strict=True)
            quiet = max(abs(now - then) for now, then in both) <= limits.force_sd
        rate, force = found[0], found[1]
        run_rate, scatter, run = rate, np.zeros(3), 1
        if not quiet:
            self._reference, self._run = None, 0
        else:
            self._reference = self._reference or mean_force
            of_run = np.empty((2, 3))
            self._run = run = _lengthen(self._rates, self._run, rate, of_run)
            if run > 1:
                run_rate, scatter = of_run[0], of_run[1]
        return Window(end_ns, end - first, rate, force, quiet, run, run_rate, scatter)
