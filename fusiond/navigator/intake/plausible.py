"""Plausibility of device measurements: each is checked here once, before anything uses it.

Outcomes: `not_finite`; `position_implausible` (no place on the Earth, too near a pole for north and
east to mean anything, or exactly 0 N 0 E), `height_implausible` and `speed_implausible` (outside
what the vehicle's class can do, `fusiond.configuration.plausibility`), `sigma_implausible` (larger
than anything that still says something, negative, or smaller than the best device's).

What is not stated (None; of a sigma, 0 too) is no fault: the section has a value for it, or the
outcome is `no_sigma`. A fix whose sigma is too small to be true is no worse for it:
`fusiond.navigator.intake.gnss` has what is believed instead.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from drivers.measurements import (
    Attitude,
    Bearing,
    DelayedFix,
    Heading,
    Height,
    MagneticHeading,
    Measurement,
    PositionFix,
    WheelSpeed,
)
from drivers.plausible import SIGMA_M, within
from drivers.raw.messages import RawGnssEpoch
from fusiond.configuration.plausibility import Plausibility

LATITUDE_RAD = (-math.radians(89.9), math.radians(89.9))
"""Largest latitude, 11 km from a pole, where north turns by a degree each 200 m: the navigation
frame ends there."""
LONGITUDE_RAD = (-math.pi, 2.0 * math.pi)
"""Devices count from -180 to 180 or from 0 to 360 deg."""

SIGMA_RAD = (1e-6, math.pi)
"""0.2 arcsec: the best star trackers state one arcsecond; beyond a half turn nothing is said."""
LEAST_SPEED_SD_M_S = 1e-3
"""Least credible sigma: a hundredth of a good receiver's or wheel sensor's."""
LEAST_CLASS_M = 1.0
"""The precision classes of RDSS are 20 and 100 m."""


def refusal(m: Measurement | RawGnssEpoch, limits: Plausibility) -> str | None:
    """Name of the implausible value in `m`; None if plausible. Raw ranges are checked satellite by
    satellite, by their decoder and by the range model."""
    match m:
        case PositionFix():
            return (
                _place(m.lat_rad, m.lon_rad, m.height_m, limits)
                or _speed(m.v_ned_m_s or (), limits)
                or _sigma(m.sd_ned_m or (), (0.0, SIGMA_M[1]))
                or _sigma(m.sd_v_ned_m_s or (), (0.0, limits.max_speed_m_s))
            )
        case DelayedFix():
            return _place(m.lat_rad, m.lon_rad, m.height_m, limits) or _sigma(
                (m.precision_class_m,), (LEAST_CLASS_M, SIGMA_M[1])
            )
        case Attitude():
            given = [a for a in m.rpy_rad if not math.isnan(a)]
            stated = [s for s in m.sd_rpy_rad if not math.isnan(s)]
            return _finite(given) or _sigma(stated, SIGMA_RAD)
        case Bearing():
            target = m.point and _place(*m.point, limits=None)
            return (
                _finite((m.azimuth_rad, m.elevation_rad))
                or target
                or _sigma(m.sd_rad or (), SIGMA_RAD)
            )
        case Heading():
            return _finite((m.yaw_rad,)) or _sigma((m.sd_rad,), SIGMA_RAD)
        case MagneticHeading():
            return _finite((m.yaw_rad,))
        case Height():
            return _height(m.height_m, limits) or _sigma((m.sd_m,), SIGMA_M)
        case WheelSpeed():
            range_m_s = (LEAST_SPEED_SD_M_S, limits.max_speed_m_s)
            return _speed((m.speed_m_s,), limits) or _sigma((m.sd_m_s,), range_m_s)
        case _:
            return None


def _finite(values: Iterable[float]) -> str | None:
    return None if all(map(math.isfinite, values)) else "not_finite"


def _place(
    lat_rad: float, lon_rad: float, height_m: float | None, limits: Plausibility | None
) -> str | None:
    # What devices send that have no position: nobody is there to the last digit.
    nowhere = lat_rad == 0.0 == lon_rad
    if nowhere or not (within(lat_rad, LATITUDE_RAD) and within(lon_rad, LONGITUDE_RAD)):
        return _finite((lat_rad, lon_rad)) or "position_implausible"
    # Within limits is nothing that is not finite.
    if height_m is None or (limits is not None and within(height_m, limits.height_m)):
        return None
    return _finite((height_m,)) if limits is None else _height(height_m, limits)


def _height(height_m: float, limits: Plausibility) -> str | None:
    if within(height_m, limits.height_m):
        return None
    return _finite((height_m,)) or "height_implausible"


def _speed(velocity: Iterable[float | None], limits: Plausibility) -> str | None:
    known = [v for v in velocity if v is not None]
    if math.hypot(*known) <= limits.max_speed_m_s:  # which what is not finite is not
        return None
    return _finite(known) or "speed_implausible"


def _sigma(stated: Iterable[float | None], limits: tuple[float, float]) -> str | None:
    """Check a sigma, of which 0 means unknown on many devices."""
    refused, (least, most) = None, limits
    for s in stated:
        if s and not least <= s <= most:
            if math.isnan(s):
                return "not_finite"
            refused = "sigma_implausible"
    return refused
