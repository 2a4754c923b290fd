"""Derived figures for clients: speed, course and 95 % errors.

    speed  = hypot(v_n, v_e)
    course = atan2(v_e, v_n)
    along  = sqrt((v_n sd_n)^2 + (v_e sd_e)^2) / speed     sigma of the speed
    across = sqrt((v_e sd_n)^2 + (v_n sd_e)^2) / speed     sigma of the velocity's other part

North and east velocity errors are assumed uncorrelated, since `nav` has no correlation.
"""

from __future__ import annotations

from math import atan2, degrees, hypot, isfinite
from typing import NamedTuple

from fusiond.navigation.solution import Mode
from fusiond.outputs.messages.nav import NavMessage

TWO_SIDED_95 = 1.959964
"""Two-sided 95 % quantile of a Gaussian, in sigmas."""


class Motion(NamedTuple):
    """Speed over ground (m/s) and course (degrees from true north; None if too slow for a
    direction), with their 95 % errors."""

    speed_m_s: float
    speed_error_m_s: float
    course_deg: float | None
    course_error_deg: float


def usable(nav: NavMessage) -> bool:
    """True if position and velocity may be used."""
    return nav.mode in (Mode.NAVIGATING, Mode.COASTING)


def known(value: float | None) -> float | None:
    """Value, or None if unknown: NaN in messages built here, null in messages read back."""
    return value if value is not None and isfinite(value) else None


def motion(nav: NavMessage) -> Motion | None:
    """Speed and course over the ground; None without a velocity.

    The course is None below the speed's 95 % error: the vehicle may as well move the opposite way.
    """
    figures = [known(x) for x in (nav.v_n_m_s, nav.v_e_m_s, nav.sd_vn_m_s, nav.sd_ve_m_s)]
    if any(x is None for x in figures):
        return None
    north, east, sd_north, sd_east = (x for x in figures if x is not None)
    speed = hypot(north, east)
    if speed == 0.0:
        return Motion(0.0, TWO_SIDED_95 * max(sd_north, sd_east), None, 180.0)
    along = TWO_SIDED_95 * hypot(north * sd_north, east * sd_east) / speed
    across = TWO_SIDED_95 * hypot(east * sd_north, north * sd_east) / speed
    course = degrees(atan2(east, north)) % 360.0
    slow = speed < max(along, across)
    return Motion(speed, along, None if slow else course, degrees(atan2(across, speed)))


def horizontal_rms_m(nav: NavMessage) -> float | None:
    """Root of the sum of the horizontal variances. By the ellipse's shape 63 to 68 % of errors are
    smaller than it, and 95 to 98 % smaller than twice it."""
    north, east = known(nav.sd_n_m), known(nav.sd_e_m)
    return None if north is None or east is None else hypot(north, east)
