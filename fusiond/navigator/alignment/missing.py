"""Reasons why navigation has not started: the missing condition and the remedy.

One sentence: the missing condition, then what each allowed heading source waits for. It is
published as `why`. A change that lasts for `SETTLED_NS` is an event, `not_aligned`; a counting
number is no change.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from fusiond.navigation.alignment import gyrocompass_sd
from fusiond.navigation.earth import EARTH_RATE_RAD_S
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.alignment.heading_at_rest import HEADING_AGE_NS, ON_THE_WAY
from fusiond.navigator.alignment.heading_source_data import Basis
from fusiond.navigator.mode_reasons import joined, reason

# What a traffic light or a short rest changes back is not worth a line.
SETTLED_NS = 5_000_000_000
# The IMU's rate is counted over the last seconds, from so many on.
COUNTED_NS, LEAST_COUNTED_NS = 5_000_000_000, 2_000_000_000
# A rate that differs by more is another setting of the unit, not its clock or a loaded bus: units
# offer rates in steps of a factor of 1.25 and more.
RATE_FACTOR = 1.2
DEG_H = math.radians(1.0) / 3600.0
_NUMBER = re.compile(r"\d+(\.\d+)?")


class Journal:
    """Reporter of changes of the reason, through `on_event(code, text)`."""

    def __init__(self, on_event: Callable[[str, str], None]) -> None:
        self._event = on_event
        self._reason = self._kind = self._reported = ""
        self._since_ns = 0

    def keep(self, reason: str, t_ns: int) -> None:
        """Report the reason at `t_ns`."""
        if reason != self._reason:
            self._reason, kind = reason, _NUMBER.sub("#", reason)
            if kind != self._kind:
                self._kind, self._since_ns = kind, t_ns
        if self._kind != self._reported and t_ns - self._since_ns >= SETTLED_NS:
            self._reported = self._kind
            self._event("not_aligned", reason)


def why_not(by: Basis, imu: ImuBuffer, latitude: float | None) -> str:
    """Reason as a sentence; `latitude` (rad) is None without a position."""
    said = []
    allowed = by.options.heading
    level = bool(by.known.fixes) or by.track.running or by.known.levelled() is not None
    if latitude is None:
        said.append(reason("no_position"))
    elif not level:
        said.append(reason("no_level"))
    else:
        said.append(_no_heading(by))
    said += _rate(by, imu)
    if latitude is not None:
        said += [] if level else _rest(by, imu)
        for source in allowed:
            said += _of_source(source, by, imu, latitude)
        said += by.known.poor_claims.values()
        if by.known.why:
            said.append(by.known.why)
        if level:
            said.append(reason("allowed", sources=", ".join(allowed)))
    return joined(said)


def _no_heading(by: Basis) -> str:
    """Step towards a heading by the allowed sources, the quickest first."""
    allowed = by.options.heading
    if "gnss_course" in allowed:
        return reason("no_heading_course", speed=by.options.course_speed_m_s)
    if "positions" in allowed:
        return reason("no_heading_path")
    if allowed == ("gyrocompass",):
        return reason("no_heading_rest")
    return reason("no_heading", sources=", ".join(allowed))


def _rate(by: Basis, imu: ImuBuffer) -> list[str]:
    """Reason for samples at a different rate than configured."""
    first = imu.index_after(imu.latest_ns - COUNTED_NS)
    span_ns = imu.latest_ns - int(imu.times[first]) if first < imu.end else 0
    if span_ns < LEAST_COUNTED_NS:
        return []
    seen, reported = (imu.end - 1 - first) / (span_ns * 1e-9), by.options.rate_hz
    if max(seen / reported, reported / seen) < RATE_FACTOR:
        return []
    return [reason("imu_rate", seen=seen, configured=reported)]


def _rest(by: Basis, imu: ImuBuffer) -> list[str]:
    """Missing conditions of a rest for levelling."""
    o, s = by.options, by.known.standstill
    if s is not None:
        if s.seconds >= o.levelling_s:
            return []
        code = "levelling" if by.known.resting else "levelling_moved"
        return [reason(code, seconds=s.seconds, needed=o.levelling_s)]
    rows = imu.samples[imu.index_after(imu.latest_ns - round(o.window_s * 1e9)) : imu.end]
    rate, force = float(rows[:, :3].std(axis=0).max()), float(rows[:, 3:].std(axis=0).max())
    if rate < o.quiet_rad_s and force < o.quiet_m_s2:
        return []
    return [
        reason(
            "shaken",
            rate=math.degrees(rate),
            force=force,
            rate_limit=math.degrees(o.quiet_rad_s),
            force_limit=o.quiet_m_s2,
        )
    ]


def _of_source(source: str, by: Basis, imu: ImuBuffer, latitude: float) -> list[str]:
    o, known = by.options, by.known
    match source:
        case "saved" if by.saved is not None and known.ever_moved:
            return [reason("saved_moved")]
        case "config" if known.ever_moved:
            return [reason("configured_moved")]
        case "dual_antenna" if known.heading is not None:
            age_ns = imu.latest_ns - known.heading.t_ns
            if age_ns > HEADING_AGE_NS:
                return [reason("heading_old", seconds=age_ns * 1e-9)]
        case "dual_antenna" if not ON_THE_WAY.intersection(o.heading):
            return [reason("no_two_antennas")]
        case "compass" if known.compass is None:
            return [reason("no_compass")]
        case "gyrocompass":
            return _gyrocompass(by, latitude)
        case "gnss_course" if not known.fixes:
            return [reason("no_velocity")]
        case "positions" if not known.fixes and not by.track.running:
            return [reason("no_path")]
    return []


def _gyrocompass(by: Basis, latitude: float) -> list[str]:
    """Reason for gyrocompassing: the duration of the rest, or why resting does not help."""
    o, n, s = by.options, by.noise, by.known.standstill
    bias = math.hypot(n.rate_bias_initial, n.rate_bias_instability)
    sd = gyrocompass_sd(latitude, bias, n.rate_noise, o.gyrocompass_s)
    if sd > o.gyrocompass_max_sd_rad:
        if ON_THE_WAY.intersection(o.heading):
            return []
        return [
            reason(
                "gyrocompass_poor",
                bias=bias / DEG_H,
                limit=math.degrees(o.gyrocompass_max_sd_rad),
                needed=o.gyrocompass_max_sd_rad * EARTH_RATE_RAD_S * math.cos(latitude) / DEG_H,
            )
        ]
    resting = by.known.resting
    if s is None or not by.known.rested(s):
        s, resting = by.known.left, False
    if s is None:
        return [reason("gyrocompass_stand", seconds=o.gyrocompass_s)]
    code = "gyrocompassing" if resting else "gyrocompassing_moved"
    return [reason(code, seconds=s.seconds, needed=o.gyrocompass_s)]
