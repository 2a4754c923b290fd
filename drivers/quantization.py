r"""Distribution of a quantity that a device has rounded to steps.

    to the nearest   x in value + q [-1/2, 1/2]    mean value             sd q / sqrt(12)
    downwards        x in value + q [0, 1]         mean value + q / 2     sd q / sqrt(12)
    not known which  one as likely as the other    mean value + q / 4     sd q sqrt(1/12 + 1/16)

q the step, x the quantity, uniform within: Bennett, Spectra of quantized signals, BSTJ 27 (1948).
In the last case all readings share an error of sigma q / 4, since the device always rounds the same
way.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

Rounding = Literal["nearest", "down", "unknown"]

NEAREST_SD = 1.0 / math.sqrt(12.0)
"""One sigma of rounding to the nearest, in steps."""
SHARED_SD = 0.25
"""One sigma, in steps, of an unknown rounding's common part."""
_MEAN_SD: dict[Rounding, tuple[float, float]] = {
    "nearest": (0.0, NEAREST_SD),
    "down": (0.5, NEAREST_SD),
    "unknown": (0.25, math.hypot(NEAREST_SD, SHARED_SD)),
}
ZERO_SD = 1.0 / math.sqrt(3.0)
"""One sigma of a speed that reads 0, in steps: it is below one step, forward or backward."""


class RoundedSpeed(NamedTuple):
    """Mean, one sigma and step (m/s) of a speed that was rounded.

    All readings share an error of sigma `SHARED_SD` steps, which is a part of that sigma; the step
    is 0 if they share none."""

    mean_m_s: float
    sd_m_s: float
    shared_step_m_s: float


def rounded_speed(
    value_m_s: float, step_m_s: float, rounding: Rounding = "nearest"
) -> RoundedSpeed:
    """Expected speed for a rounded value of a device with steps of `step_m_s`.

    A 0 does not mean standstill: the speed is below one step, however the device rounds, since
    wheel sensors give no pulses below a least speed.
    """
    if abs(value_m_s) < 0.5 * step_m_s:
        return RoundedSpeed(0.0, ZERO_SD * step_m_s, 0.0)
    mean, sd = _MEAN_SD[rounding]
    shared = step_m_s if rounding == "unknown" else 0.0
    mean_m_s = value_m_s + math.copysign(mean * step_m_s, value_m_s)
    return RoundedSpeed(mean_m_s, sd * step_m_s, shared)
