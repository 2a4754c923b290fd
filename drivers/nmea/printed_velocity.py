r"""Horizontal velocity of an epoch from printed speed and course, with the variance they leave
open.

    speed s, course c     v = s (cos c, sin c)
    no course             v = 0,   r = max(s^2 / 2 - sd^2, 0)     s <= AT_REST_M_S: else unknown
    a speed held at 0     v = 0,   r = PINNED_M_S^2 / 4

Axes are north and east; r is the variance of an axis in addition to sd^2, the receiver's noise. At
rest receivers leave the course empty: only the amount of the velocity is known. Its direction is
uniform, so each axis has mean 0 and variance s^2 / 2, of which sd^2 is the noise that every
velocity has. The printed speed of a receiver at rest has a Rayleigh distribution:

    P(s > x) = exp(-x^2 / (2 sd^2)),   P(0 printed) = 1 - exp(-(q / 2)^2 / (2 sd^2))

with q the step of the last digit. A run of zeros that a free receiver, with noise LEAST_NOISE_M_S,
would print less often than ODDS shows a receiver that holds its speed at 0 (with steps of 0.1 knots
it cannot be recognised). The velocity is then uniform in the disc of radius PINNED_M_S, with a
quarter of its square as the variance of each axis.

A velocity beyond the noise keeps its direction, so a run of such epochs holds no more information
than one of them. The nth epoch has r n (n + 1), so that all together have the information 1 / r:

    sum 1 / (n (n + 1)) = 1 - 1 / (N + 1)

Source: u-blox MIA-M10Q integration manual, "Freezing the course over ground" (no course below
0.1 m/s, or where the velocity is not accurate enough); SiRF's questions and answers, 93 (static
navigation: speed 0 and place pinned from below 1.2 m/s for 3 s until above 1.4 m/s).
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

NOISE_M_S = 0.1
"""One sigma an axis of a receiver's velocity: the default of `velocity_sd_m_s`."""
LEAST_NOISE_M_S = 0.0026
"""One sigma of the calmest receiver at rest in gpsd's test logs (median speed 0.003 m/s)."""
ODDS = 1e-3
AT_REST_M_S = NOISE_M_S * math.sqrt(-2.0 * math.log(ODDS))
"""Speed (0.37 m/s) that noise at rest exceeds with probability `ODDS`. Receivers of gpsd's test
logs print up to 0.36 m/s without a course."""
PINNED_M_S = 1.4

Velocity = tuple[float, float, float | None]


class PrintedSpeed(NamedTuple):
    """Speed and one step of its last digit (m/s); course (deg) if printed."""

    speed_m_s: float
    step_m_s: float
    course_deg: float | None


class VelocityReader:
    """Reader of printed speeds in order. Counts `course_missing`, `speed_held_at_zero`."""

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self._free = 1.0
        """Probability of the last zeros in a row of a receiver that holds none."""
        self._alike = 0
        """Epochs in a row with motion of unknown direction."""

    def velocity_of(self, printed: PrintedSpeed | None) -> tuple[Velocity | None, float]:
        """Velocity (m/s; None if unknown), and one sigma of an axis that speed and course leave
        open."""
        if printed is None:
            return None, 0.0
        speed, step, course = printed
        self._free = self._free * _zero_by_noise(step) if speed == 0.0 else 1.0
        if self._free < ODDS:
            self._counters["speed_held_at_zero"] += 1
            return (0.0, 0.0, None), self._run(0.25 * PINNED_M_S**2)
        if course is not None:
            self._alike, angle = 0, math.radians(course)
            return (speed * math.cos(angle), speed * math.sin(angle), None), 0.0
        if speed > AT_REST_M_S:
            self._alike = 0
            self._counters["course_missing"] += 1
            return None, 0.0
        return (0.0, 0.0, None), self._run(0.5 * speed**2 - NOISE_M_S**2)

    def _run(self, variance: float) -> float:
        """One sigma of the next epoch of a run."""
        if variance <= 0.0:
            self._alike = 0
            return 0.0
        self._alike += 1
        return math.sqrt(variance * self._alike * (self._alike + 1))


def _zero_by_noise(step_m_s: float) -> float:
    """Probability that a free receiver at rest prints 0."""
    return -math.expm1(-0.125 * (step_m_s / LEAST_NOISE_M_S) ** 2)
