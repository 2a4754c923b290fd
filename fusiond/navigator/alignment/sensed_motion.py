r"""Preintegrated motion with measurements, since the first of several fixes.

Integrals of the gyros and accelerometers in the axes of the first fix, with their slopes by the
sensors' biases, for fusiond.navigator.alignment.motion_fit.

Source: Wu and Pan, Velocity/position integration formula part I, IEEE T-AES 49 (2013).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.aiding.initialisation_candidates import VelocityCandidate
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.preintegration import integrate_sensed
from fusiond.navigator.alignment.start import velocity_of

Array = NDArray[np.float64]

# A rate or a force at an instant is the mean of so much (ns) to each side.
AROUND_NS = 100_000_000
# A velocity below so many of its sigmas is none.
STILL_SIGMAS = 3.0
MOST_FIXES = 20
"""Most fixes of a fit, evenly spaced; nearby ones add little."""


class Past(Protocol):
    """IMU samples of some seconds: times (m,) ns, rate and force (m, 6), the row of the first
    later than an instant."""

    @property
    def times(self) -> NDArray[np.int64]: ...

    @property
    def samples(self) -> Array: ...

    def index_after(self, t_ns: int) -> int: ...


@immutable()
class Span:
    """Immutable `Past`."""

    times: NDArray[np.int64]
    samples: Array

    def index_after(self, t_ns: int) -> int:
        """Row of the first sample later than `t_ns`."""
        return int(np.searchsorted(self.times, t_ns, side="right"))


class Measured(NamedTuple):
    """Velocities of k fixes: instants (k,) ns, NED (k, 3), one sigma (k, 3), levers (k, 3)."""

    instants: NDArray[np.int64]
    velocity: Array
    sd: Array
    levers: Array


class Stretch(NamedTuple):
    """IMU data from the first of k fixes to the last: times (m + 1,) ns of the first fix and of
    samples (m, 6), their number (k,) until each fix, seconds (k,) from the first fix, and means (k,
    6) of the samples around each fix."""

    times: NDArray[np.int64]
    samples: Array
    counts: NDArray[np.int64]
    t_s: Array
    means: Array

    def sensed(self, biases: Array) -> Sensed:
        """Sensed motion without biases (6,) of force and rate."""
        k = len(self.counts)
        gained, turned, slopes = np.empty((k, 3)), np.empty((k, 3, 3)), np.empty((k, 3, 6))
        integrate_sensed(self.times, self.samples, biases, self.counts, gained, turned, slopes)
        return Sensed(self, gained, turned, slopes, biases)


class Sensed(NamedTuple):
    """Integrals from the first fix to each of k, without biases (6,) of force and rate: gained
    velocity (k, 3) and attitude (k, 3, 3) in the axes of the first, derivatives of the velocity by
    the biases (k, 3, 6)."""

    of: Stretch
    gained: Array
    turned: Array
    slopes: Array
    biases: Array

    @property
    def rates(self) -> Array:
        """Rates (k, 3) at the fixes, without biases."""
        rates: Array = self.of.means[:, :3] - self.biases[3:]
        return rates

    @property
    def turns(self) -> Array:
        """Derivatives (3, 3) of the last attitude, a rotation vector in the axes of the first, by
        rate bias: those of the velocity by force bias."""
        turns: Array = self.slopes[-1][:, :3]
        return turns


def span_since(imu: ImuBuffer, t_ns: int) -> Span:
    """Copy of the samples from an instant on, and of the input of `samples_at`."""
    first = max(0, imu.index_after(t_ns - AROUND_NS) - 1)
    return Span(imu.times[first : imu.end].copy(), imu.samples[first : imu.end].copy())


def measured(fixes: Sequence[VelocityCandidate], most: int) -> Measured:
    """Measurements of fixes, evenly thinned to at most `most`, the last included."""
    every = math.ceil(len(fixes) / most)
    fixes = fixes[::-1][::every][::-1]
    found = [velocity_of(x) for x in fixes]
    return Measured(
        np.array([x.t_ns for x in fixes]),
        np.array([v for v, _ in found]),
        np.array([sd for _, sd in found]),
        np.array([x.lever for x in fixes]),
    )


def rate_before_motion(past: Past, m: Measured) -> Array:
    """Mean rate (3,) over the first fixes at rest; zero without a rest. A linearisation about zero
    bias would not converge: 3 deg/s turn by 60 deg in 20 s."""
    beyond = np.abs(m.velocity) > STILL_SIGMAS * m.sd
    moves = beyond[:, 0] | beyond[:, 1]
    stood = int(np.argmax(moves)) if moves.any() else len(moves)
    first, end = past.index_after(int(m.instants[0])), past.index_after(int(m.instants[stood - 1]))
    if stood < 2 or end <= first:
        return np.zeros(3)
    mean: Array = past.samples[first:end, :3].mean(axis=0)
    return mean


def samples_at(past: Past, t_ns: int) -> Array:
    """Mean (6,) of the available samples around an instant."""
    first = max(0, past.index_after(t_ns - AROUND_NS) - 1)
    end = max(first + 1, past.index_after(t_ns + AROUND_NS))
    mean: Array = past.samples[first:end].mean(axis=0)
    return mean


def stretch(past: Past, instants: NDArray[np.int64]) -> Stretch:
    """Sensed motion from the first of instants (k,) to the last."""
    first, end = past.index_after(int(instants[0])), past.index_after(int(instants[-1]))
    times = np.concatenate((instants[:1], past.times[first:end]))
    counts = np.searchsorted(times[1:], instants, side="right")
    t_s = (instants - instants[0]) * 1e-9
    return Stretch(times, past.samples[first:end], counts, t_s, _samples_at(past, instants))


def sensed(past: Past, instants: NDArray[np.int64], rate: Array) -> Sensed:
    """Sensed motion from the first of instants (k,) to each, without a rate bias (3,)."""
    return stretch(past, instants).sensed(np.concatenate((np.zeros(3), rate)))


def _samples_at(past: Past, instants: NDArray[np.int64]) -> Array:
    """`samples_at` (k, 6) of instants (k,) in their order."""
    low = max(0, past.index_after(int(instants[0]) - AROUND_NS) - 1)
    end = past.index_after(int(instants[-1]) + AROUND_NS)
    times = past.times[low:end]
    before = np.maximum(0, np.searchsorted(times, instants - AROUND_NS, side="right") - 1)
    after = np.maximum(before + 1, np.searchsorted(times, instants + AROUND_NS, side="right"))
    sums = np.zeros((end - low + 1, 6))
    np.cumsum(past.samples[low:end], axis=0, out=sums[1:])
    means: Array = (sums[after] - sums[before]) / (after - before)[:, None]
    return means
