"""Faults of the inertial unit's samples and of their stamps; all in sensor axes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from fusiond.configuration.si_units import DEG
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.studies.faults.sensor_data import Recording

RATE_RANGE_RAD_S = 2000.0 * DEG
FORCE_RANGE_M_S2 = 10.0 * STANDARD_GRAVITY_M_S2
"""Full scale, chosen as usual for a MEMS unit on a vehicle."""
SPIKE_RAD_S = 99.0
SMALL_SPIKE_RAD_S = 0.85
STAMP_AHEAD_S = 0.7
BIAS_STEP_RAD_S = 1.0 * DEG
TURNED_RAD = 30.0 * DEG
YAW_AXIS = 2


def saturated(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Saturate every axis at its full scale."""
    samples = r.samples.copy()
    samples[r.window(begin_s, length_s)] = [RATE_RANGE_RAD_S] * 3 + [FORCE_RANGE_M_S2] * 3
    return replace(r, samples=samples)


def stuck(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Repeat the first sample of the window."""
    samples, window = r.samples.copy(), r.window(begin_s, length_s)
    samples[window] = samples[np.flatnonzero(window)[0]]
    return replace(r, samples=samples)


def all_zero(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set all six axes to zero."""
    samples = r.samples.copy()
    samples[r.window(begin_s, length_s)] = 0.0
    return replace(r, samples=samples)


def dead_axis(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set the gyro of the yaw axis to zero."""
    samples = r.samples.copy()
    samples[r.window(begin_s, length_s), YAW_AXIS] = 0.0
    return replace(r, samples=samples)


def bias_step(
    r: Recording,
    begin_s: float,
    length_s: float,
    size: float = BIAS_STEP_RAD_S,
    axis: int = YAW_AXIS,
) -> Recording:
    """Offset a gyro (axis 0 to 2, rad/s) or an accelerometer (3 to 5, m/s^2) by `size`; default: 1
    deg/s on the yaw axis."""
    samples = r.samples.copy()
    samples[r.window(begin_s, length_s), axis] += size
    return replace(r, samples=samples)


def scaled_axis(
    r: Recording, begin_s: float, length_s: float, axis: int, factor: float
) -> Recording:
    """Multiply an axis, numbered as in `bias_step`, by `factor`."""
    samples = r.samples.copy()
    samples[r.window(begin_s, length_s), axis] *= factor
    return replace(r, samples=samples)


def noisy(r: Recording, begin_s: float, length_s: float, times: float) -> Recording:
    """Add white noise, `times` the sample-to-sample noise, in the window."""
    samples, window = r.samples.copy(), r.window(begin_s, length_s)
    sd = np.diff(samples[window], axis=0).std(axis=0) / math.sqrt(2.0)
    noise = np.random.default_rng(0).standard_normal((int(window.sum()), 6))
    samples[window] += times * sd * noise
    return replace(r, samples=samples)


def half_rate(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Halve the rate; each sample is the mean of two."""
    samples, window = r.samples.copy(), r.window(begin_s, length_s)
    second = np.flatnonzero(window)[1::2]
    samples[second] = 0.5 * (samples[second] + samples[second - 1])
    lost = np.zeros_like(window)
    lost[second - 1] = True
    return replace(r, samples=samples).without(lost)


def stamps_off(r: Recording, begin_s: float, length_s: float, off_s: float) -> Recording:
    """Shift all stamps of the window ahead, or back if negative."""
    stamps = r.stamps.copy()
    stamps[r.window(begin_s, length_s)] += round(off_s * 1e9)
    return replace(r, stamps=stamps)


def clock_fast(r: Recording, begin_s: float, length_s: float, ppm: float) -> Recording:
    """Speed up the clock of the stamps from the window's start."""
    stamps, window = r.stamps.copy(), r.window(begin_s, length_s)
    stamps[window] += np.rint((stamps[window] - begin_s * 1e9) * ppm * 1e-6).astype(np.int64)
    return replace(r, stamps=stamps)


def mount_turned(
    r: Recording, begin_s: float, length_s: float, angle_rad: float = TURNED_RAD
) -> Recording:
    """Rotate the unit about its vertical axis by 30 deg."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    samples, window = r.samples.copy(), r.window(begin_s, length_s)
    samples[window] = np.hstack((samples[window, :3] @ turn.T, samples[window, 3:] @ turn.T))
    return replace(r, samples=samples)


def silent(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Remove all samples of the window."""
    return r.without(r.window(begin_s, length_s))


def gyro_spike(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set one sample of the yaw gyro far out of range."""
    samples = r.samples.copy()
    samples[np.flatnonzero(r.window(begin_s, length_s))[0], YAW_AXIS] = SPIKE_RAD_S
    return replace(r, samples=samples)


def small_spike(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Offset one sample of the yaw gyro by a shock's size."""
    samples = r.samples.copy()
    samples[np.flatnonzero(r.window(begin_s, length_s))[0], YAW_AXIS] += SMALL_SPIKE_RAD_S
    return replace(r, samples=samples)


def not_numbers(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set all values of the window to NaN."""
    samples = r.samples.copy()
    samples[r.window(begin_s, length_s)] = np.nan
    return replace(r, samples=samples)


def stamp_ahead(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Shift one sample's stamp ahead."""
    stamps = r.stamps.copy()
    stamps[np.flatnonzero(r.window(begin_s, length_s))[0]] += round(STAMP_AHEAD_S * 1e9)
    return replace(r, stamps=stamps)


def stamps_reversed(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Reverse the stamps of the window."""
    stamps, window = r.stamps.copy(), r.window(begin_s, length_s)
    stamps[window] = stamps[window][::-1]
    return replace(r, stamps=stamps)


def force_in_g(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Express specific force in standard gravities."""
    samples = r.samples.copy()
    samples[r.window(begin_s, length_s), 3:] /= STANDARD_GRAVITY_M_S2
    return replace(r, samples=samples)


def rate_in_deg_s(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Express rates in degrees a second."""
    samples = r.samples.copy()
    samples[r.window(begin_s, length_s), :3] /= DEG
    return replace(r, samples=samples)
