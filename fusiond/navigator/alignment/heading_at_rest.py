"""Headings of a vehicle that stands: saved, configured, of two antennas, of the Earth's rate.

Also the heading from positions (fusiond.navigator.alignment.heading_from_positions).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from fusiond.aiding.initialisation_candidates import HeadingCandidate
from fusiond.navigation.alignment import gyrocompass, gyrocompass_sd, level
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_from_rpy
from fusiond.navigator.alignment.evidence import CONTRADICTION_SIGMAS, FIXES_NS
from fusiond.navigator.alignment.heading_source_data import Basis
from fusiond.navigator.alignment.rate_bias_at_rest import REST_VELOCITY_SD, rest_bias
from fusiond.navigator.alignment.start import (
    Levelled,
    Place,
    Start,
    as_geodetic,
    build_start,
)
from fusiond.navigator.mode_reasons import reason

# A heading that came this long ago no longer describes a body at rest that may have been moved.
HEADING_AGE_NS = 2_000_000_000
SAVED, CONFIGURED, COMPASS = "saved state", "configured heading", "compass"
CLAIMS = (SAVED, CONFIGURED, COMPASS)
"""Headings without a measurement at the start, or exposed to magnetic disturbance."""
# A claim that is poorer than this is no start where driving tells the heading: the filter would
# find it as well, but what it says until then helps nobody.
POOR_SD_RAD = math.radians(15.0)
# Up to 5 deg plain coordinates are as honest (NEES 10.0 of 9, docs/estimators.md); beyond, the
# filter's updates turn with the heading.
PLAIN_CLAIM_RAD = math.radians(6.0)
ON_THE_WAY = frozenset({"gnss_course", "positions"})
"""Sources that give a heading as the vehicle drives."""


def _at_standstill(
    by: Basis,
    place: Place,
    yaw: float,
    sd: float,
    how: str,
    candidate: HeadingCandidate | None = None,
) -> Start | None:
    standstill = by.known.levelled()
    if standstill is None:
        return None
    if sd > POOR_SD_RAD and ON_THE_WAY.intersection(by.options.heading):
        by.known.poor_claims[how] = reason("poor_heading", heading=how, sd=math.degrees(sd))
        return None
    roll, pitch = level(standstill.mean_force)
    dcm = dcm_from_rpy(roll, pitch, yaw)
    lat, wide = float(place[1][0]), sd > PLAIN_CLAIM_RAD
    bias = rest_bias(by.noise, standstill, dcm, lat, sd if wide else 0.0)
    start = build_start(
        by.model,
        standstill.end_ns,
        place,
        dcm,
        sd,
        np.zeros(3),
        REST_VELOCITY_SD,
        how,
        bias=bias,
        levelled=Levelled(dcm),
        heading=candidate,
        grades=by.known.unit.grades(standstill, *bias, gravity(lat, float(place[1][2]))),
    )
    return replace(start, turns=wide)


def from_saved(by: Basis, imu: ImuBuffer, place: Place) -> Start | None:
    """Start by the saved heading of a parked vehicle, unless motion or the first fix shows that it
    has moved since."""
    if by.saved is None or by.known.ever_moved:
        return None
    fix, where, sd, _ = place
    if fix is not None:
        moved = where[:2] - np.array(by.saved.position[:2])
        moved[1] = math.remainder(float(moved[1]), 2.0 * math.pi)
        metres = moved / as_geodetic(np.ones(3), float(where[0]))[:2]
        away = math.hypot(*metres.tolist())
        if away > CONTRADICTION_SIGMAS * math.hypot(sd, by.saved.sd_position_m):
            text = reason("parked_elsewhere", distance=away)
            by.known.poor_claims[SAVED] = text
            by.known.report("saved_elsewhere", text)
            return None
    start = _at_standstill(by, place, by.saved.yaw_rad, by.saved.sd_yaw_rad, SAVED)
    return start and replace(start, confirmed=by.saved.confirmed)


def from_config(by: Basis, imu: ImuBuffer, place: Place) -> Start | None:
    """Start by the configured heading, before the vehicle has moved."""
    o = by.options
    if o.heading_rad is None or by.known.ever_moved:
        return None
    start = _at_standstill(by, place, o.heading_rad, o.heading_sd_rad, CONFIGURED)
    return start and replace(start, confirmed=False)


def from_dual_antenna(by: Basis, imu: ImuBuffer, place: Place) -> Start | None:
    """Start by the latest heading of a dual antenna, while fresh."""
    if by.known.heading is None or imu.latest_ns - by.known.heading.t_ns > HEADING_AGE_NS:
        return None
    return _at_standstill(
        by, place, by.known.heading.yaw_rad, by.known.heading.sd_rad, "dual antenna"
    )


def from_compass(by: Basis, imu: ImuBuffer, place: Place) -> Start | None:
    """Start by a compass heading, while fresh, unless motion has refuted it."""
    candidate = by.known.compass
    if candidate is None or imu.latest_ns - candidate.t_ns > HEADING_AGE_NS:
        return None
    start = _at_standstill(by, place, candidate.yaw_rad, candidate.sd_rad, COMPASS, candidate)
    return start and replace(start, confirmed=False)


def from_gyrocompass(by: Basis, imu: ImuBuffer, place: Place) -> Start | None:
    """Start by the direction of the Earth's rate, after a long enough standstill."""
    standstill = by.known.standstill
    if (
        standstill is None
        or standstill.seconds < by.options.gyrocompass_s
        or not by.known.levelled()
    ):
        return None
    lat = float(place[1][0])
    bias = math.hypot(by.noise.rate_bias_initial, by.noise.rate_bias_instability)
    sd = gyrocompass_sd(lat, bias, by.noise.rate_noise, standstill.seconds)
    if sd > by.options.gyrocompass_max_sd_rad:
        return None
    roll, pitch = level(standstill.mean_force)
    yaw = gyrocompass(standstill.mean_rate, roll, pitch)
    white = by.noise.rate_noise / math.sqrt(standstill.seconds)
    dcm = dcm_from_rpy(roll, pitch, yaw)
    return build_start(
        by.model,
        standstill.end_ns,
        place,
        dcm,
        white / (EARTH_RATE_RAD_S * math.cos(lat)),
        np.zeros(3),
        REST_VELOCITY_SD,
        "gyrocompass",
        levelled=Levelled(dcm),
        compassed=True,
        grades=by.known.unit.unrested_grades,
    )


def from_positions(by: Basis, imu: ImuBuffer, place: Place) -> Start | None:
    """Start by the heading from positions alone, if no velocity is received."""
    fixes = by.known.fixes
    if (
        fixes
        and "gnss_course" in by.options.heading
        and imu.latest_ns - fixes[-1].velocity.t_ns < FIXES_NS
    ):
        by.track.give_up()
        return None
    return by.track.start(by.known, by.noise, imu, place)
