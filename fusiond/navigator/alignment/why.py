"""Why there is no start yet, in words that say what to do.

One sentence: what is missing, then what each allowed source of a heading waits for. It goes out as
`why`; a change of it is an event, `not_aligned`, once it has lasted for `SETTLED_NS`. Numbers that
count up are no change.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from fusiond.navigation.alignment import gyrocompass_sd
from fusiond.navigation.earth import EARTH_RATE_RAD_S
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.alignment.basis import Basis
from fusiond.navigator.alignment.headings import HEADING_AGE_NS, ON_THE_WAY

NO_POSITION = "no position yet: no fix, none configured"
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
    """Tells changes of the reason; `on_event(code, text)` hears them."""

    def __init__(self, on_event: Callable[[str, str], None]) -> None:
        self._event = on_event
        self._reason = self._kind = self._told = ""
        self._since_ns = 0

    def keep(self, reason: str, t_ns: int) -> None:
        """What is said at `t_ns`."""
        if reason != self._reason:
            self._reason, kind = reason, _NUMBER.sub("#", reason)
            if kind != self._kind:
                self._kind, self._since_ns = kind, t_ns
        if self._kind != self._told and t_ns - self._since_ns >= SETTLED_NS:
            self._told = self._kind
            self._event("not_aligned", reason)


def why_not(by: Basis, imu: ImuBuffer, latitude: float | None) -> str:
    """The sentence; `latitude` (rad) is None where no position is known."""
    said = []
    allowed = by.options.heading
    level = bool(by.known.fixes) or by.track.running or by.known.levelled() is not None
    if latitude is None:
        said.append(NO_POSITION)
    elif not level:
        said.append("not at rest: no level yet")
    else:
        said.append(f"no heading yet (allowed: {', '.join(allowed)})")
    said += _rate(by, imu)
    if latitude is not None:
        said += [] if level else _rest(by, imu)
        for source in allowed:
            said += _of_source(source, by, imu, latitude)
        said += by.known.poor_claims.values()
        if by.known.why:
            said.append(by.known.why)
    return "; ".join(dict.fromkeys(said))


def _rate(by: Basis, imu: ImuBuffer) -> list[str]:
    """Samples that come at another rate than configured."""
    first = imu.index_after(imu.latest_ns - COUNTED_NS)
    span_ns = imu.latest_ns - int(imu.times[first]) if first < imu.end else 0
    if span_ns < LEAST_COUNTED_NS:
        return []
    seen, told = (imu.end - 1 - first) / (span_ns * 1e-9), by.options.rate_hz
    if max(seen / told, told / seen) < RATE_FACTOR:
        return []
    return [f"samples come at {seen:.0f} Hz, the configuration says {told:g}: correct imu.rate_hz"]


def _rest(by: Basis, imu: ImuBuffer) -> list[str]:
    """What a vehicle that must stand lacks to be level."""
    o, s = by.options, by.known.standing
    if s is not None:
        if s.seconds >= o.levelling_s:
            return []
        moved = "" if by.known.resting else "; then moved"
        return [
            f"at rest for {s.seconds:.0f} s of the {o.levelling_s:g} that levelling needs{moved}"
        ]
    rows = imu.samples[imu.index_after(imu.latest_ns - round(o.window_s * 1e9)) : imu.end]
    rate, force = float(rows[:, :3].std(axis=0).max()), float(rows[:, 3:].std(axis=0).max())
    if rate < o.quiet_rad_s and force < o.quiet_m_s2:
        return []
    return [
        f"shaken by {math.degrees(rate):.2g} deg/s and {force:.2g} m/s^2, rest is below "
        f"{math.degrees(o.quiet_rad_s):.2g} and {o.quiet_m_s2:.2g} ([constraints.zero_velocity])"
    ]


def _of_source(source: str, by: Basis, imu: ImuBuffer, latitude: float) -> list[str]:
    o, known = by.options, by.known
    match source:
        case "saved" if by.saved is not None and known.ever_moved:
            return ["the saved heading counts until the vehicle moves; it has moved"]
        case "config" if known.ever_moved:
            return ["the configured heading counts until the vehicle moves; it has moved"]
        case "dual_antenna" if known.heading is not None:
            age_ns = imu.latest_ns - known.heading.t_ns
            if age_ns > HEADING_AGE_NS:
                return [f"the last heading of two antennas is {age_ns * 1e-9:.0f} s old"]
        case "dual_antenna" if not ON_THE_WAY.intersection(o.heading):
            return ["no heading of two antennas has come"]
        case "compass" if known.compass is None:
            return ["no heading of a compass has come"]
        case "gyrocompass":
            return _gyrocompass(by, latitude)
        case "gnss_course" if not known.fixes:
            return ["no velocity has come, for a course"]
        case "positions" if not known.fixes and not by.track.running:
            return ["drive off: the fixes will show the heading"]
    return []


def _gyrocompass(by: Basis, latitude: float) -> list[str]:
    """How long the vehicle has stood, or that standing does not help."""
    o, n, s = by.options, by.noise, by.known.standing
    bias = math.hypot(n.rate_bias_initial, n.rate_bias_instability)
    sd = gyrocompass_sd(latitude, bias, n.rate_noise, o.gyrocompass_s)
    if sd > o.gyrocompass_max_sd_rad:
        if ON_THE_WAY.intersection(o.heading):
            return []
        return [
            f"a gyro of {bias / DEG_H:.3g} deg/h is too poor to gyrocompass: "
            f"{math.degrees(o.gyrocompass_max_sd_rad):.2g} deg take "
            f"{o.gyrocompass_max_sd_rad * EARTH_RATE_RAD_S * math.cos(latitude) / DEG_H:.2g} deg/h"
        ]
    resting = by.known.resting
    if s is None or not by.known.rested(s):
        s, resting = by.known.left, False
    if s is None:
        return [f"stand still for {o.gyrocompass_s:g} s to gyrocompass"]
    moved = "" if resting else "; then moved"
    return [
        f"at rest for {s.seconds:.0f} s of the {o.gyrocompass_s:g} that gyrocompassing needs{moved}"
    ]
