"""Navigation solution as published by the navigator: frozen, in SI units and radians."""

from __future__ import annotations

from enum import StrEnum
from math import nan
from typing import NamedTuple

from drivers.immutable import immutable

Vector3 = tuple[float, float, float]
HEIGHT_KNOWN_SD_M = 200.0
"""A height with a larger sigma is not known, and not published. The poorest that anything measures
are altitudes above the sea without a geoid (62 m) and pressures without the weather (85 m); what
nothing has measured starts at 3,464 m, and gravity alone makes 700 m of that in minutes."""
HELD_UNKNOWN_M = 0.5
"""Tolerance of a held height of 0, for a start without height: rounding of updates, and the
displacement of the first step."""
_UNKNOWN: Vector3 = (nan, nan, nan)


class Mode(StrEnum):
    """Mode of the solution.

    WAITING: no IMU data yet. ALIGNING: levelling, or heading or position not known yet. NAVIGATING:
    aided within the last `coast_after_s`. COASTING: inertial alone for longer than that, or not
    confirmed. INVALID: sigma beyond what the configuration allows, or the IMU has stopped.
    """

    WAITING = "waiting"
    ALIGNING = "aligning"
    NAVIGATING = "navigating"
    COASTING = "coasting"
    INVALID = "invalid"


class BoundState(StrEnum):
    """Status of the protection levels. OFF: no alert limit is configured. UNKNOWN: no solution to
    bound. WITHIN, BEYOND: against the alert limits."""

    OFF = "off"
    UNKNOWN = "unknown"
    WITHIN = "within"
    BEYOND = "beyond"


@immutable()
class Bound:
    """Protection levels of a solution: horizontal and vertical, NaN if not computed, infinite
    without a bound (fusiond.integrity.protection)."""

    state: BoundState = BoundState.OFF
    hpl_m: float = nan
    vpl_m: float = nan


class Solution(NamedTuple):
    """Navigation state of the body origin at one instant, with one sigma each.

    `t_ns` host monotonic. Position geodetic (rad, rad, m, WGS 84); velocity NED (m/s); attitude
    roll, pitch, yaw (rad, NED to body, 3-2-1). `sd_ned_m` metres north, east, down. Every figure is
    NaN while unknown: while `mode` is WAITING or ALIGNING, and for an instant before the stored
    history; height and its sigma before any measured height (`HEIGHT_KNOWN_SD_M`); a sigma also if
    the model holds the figure.
    """

    t_ns: int
    mode: Mode
    reason: str
    lat_rad: float = nan
    lon_rad: float = nan
    height_m: float = nan
    v_ned_m_s: Vector3 = _UNKNOWN
    rpy_rad: Vector3 = _UNKNOWN
    sd_ned_m: Vector3 = _UNKNOWN
    sd_v_ned_m_s: Vector3 = _UNKNOWN
    sd_rpy_rad: Vector3 = _UNKNOWN
    gyro_bias_rad_s: Vector3 = _UNKNOWN
    accel_bias_m_s2: Vector3 = _UNKNOWN
    bound: Bound = Bound()
