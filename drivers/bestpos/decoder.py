"""Decoder of NovAtel's and Unicore's BESTPOS logs into measurements: no I/O, no clock.

    BESTPOS, BESTGNSSPOS, RTKPOS, PSRPOS   height above the sea + undulation = ellipsoidal height
    BESTVEL, BESTGNSSVEL, RTKVEL, PSRVEL   speed over ground, track, vertical speed upwards
    BESTNAV, ADRNAV, SPPNAV                position, its sigmas, velocity and its two, in one log
    PPPNAV                                 the same without a velocity
    HEADING, HEADING2, UNIHEADING, DUALANTENNAHEADING    with a sigma
    TIME                                   UTC offset, where the header does not say leap seconds

An epoch's position is the first one of `POSITIONS` that the receiver marks as solved. Status and
type are words; an unknown type is refused by name. Sources: NovAtel OEM7 Commands and Logs
Reference Manual; Unicore Reference Commands Manual for N4 High Precision Products.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from drivers.bestpos.framing import Log, LogSplitter
from drivers.measurements import Measurement
from drivers.nmea.reasons import count_name
from drivers.plausible import LEAP_SECONDS, within
from drivers.raw.weeks import utc_as_reported
from drivers.solution import Solution
from drivers.solution_decoder import SolutionDecoder

POSITIONS = (
    *("BESTGNSSPOS", "BESTNAV", "BESTPOS", "ADRNAV", "RTKPOS"),
    *("PPPNAV", "PPPPOS", "SPPNAV", "PSRPOS"),
)
"""Best first: BESTPOS of a receiver with an IMU is its inertial solution, BESTGNSSPOS is not."""
VELOCITIES = (
    *("BESTGNSSVEL", "BESTNAV", "BESTVEL", "ADRNAV", "RTKVEL", "PPPVEL", "SPPNAV", "PSRVEL"),
)
_WITH_BOTH = frozenset(POSITIONS) & frozenset(VELOCITIES)
HEADINGS = frozenset({"HEADING", "HEADING2", "UNIHEADING", "DUALANTENNAHEADING"})
TYPES: dict[str, int | str] = {
    "SINGLE": 1,
    "FIXEDHEIGHT": 1,
    "OPERATIONAL": 1,
    "WARNING": 1,
    "PSRDIFF": 2,
    "WAAS": 2,
    "SBAS": 2,
    "CDGPS": 2,
    "OMNISTAR": 2,
    "OMNISTAR_HP": 2,
    "OMNISTAR_XP": 2,
    "PPP_BASIC_CONVERGING": 2,
    "PPP_BASIC": 2,
    "PPP_CONVERGING": 2,
    "PPP": 2,
    "L1_FLOAT": 5,
    "IONOFREE_FLOAT": 5,
    "NARROW_FLOAT": 5,
    "L1_INT": 4,
    "WIDE_INT": 4,
    "NARROW_INT": 4,
    "NONE": "no_fix",
    "OUT_OF_BOUNDS": "no_fix",
    "FIXEDPOS": "manual_refused",
    "PROPAGATED": "dead_reckoning_refused",
    "RTK_DIRECT_INS": "inertial_refused",
}
"""Position type: quality by NMEA, or the counter of its refusal. INS_... are inertial. Without
ambiguities fixed PPP is as good as its sigma says."""
DATUMS = frozenset({"WGS84", "61", "CGCS2000", "GTRF", "ITRF2008", "ITRF2014", "ITRF2020"})
"""Names (61: WGS 84 by number) that agree with WGS 84 to some centimetres."""
_POSITION, _BOTH, _VELOCITY_AT = 10, 28, 21


class BadFieldError(ValueError):
    """Error: an implausible field in a verified log."""


@dataclass(slots=True)
class _Epoch:
    week: int
    tow_s: float
    believed: bool
    leap_seconds: int | None
    t_seen_ns: int = 0
    places: dict[str, Solution] = field(default_factory=dict)
    velocities: dict[str, tuple[_Velocity, _VelocitySd | None]] = field(default_factory=dict)


_Velocity = tuple[float, float, float]
_VelocitySd = tuple[float, float, float]


class BestposDecoder(SolutionDecoder[Log, _Epoch]):
    """See `SolutionDecoder`.

    Beside those of `LogSplitter`, `Cycle` and `SolutionJudge` it counts `logs_used`,
    `logs_not_used`, `bad_field`, `heading_not_valid`, `heading_not_fixed`,
    `position_type_unknown`, `velocity_latent`.
    """

    _leap_seconds: int | None = None
    """Leap seconds from TIME."""

    def _make_splitter(self) -> LogSplitter:
        return LogSplitter(self.counters)

    # ----------------------------------------------------------------- logs to epochs

    def _take(self, log: Log, found: list[Measurement]) -> None:
        name = log.name
        try:
            if name in HEADINGS:
                self._heading(log, found)
            elif name == "TIME":
                self._time(log)
            elif name in POSITIONS or name in VELOCITIES:
                self._group(log, found)
            else:
                self.counters["logs_not_used"] += 1
                count_name(self.left_out, name)
                return
        except BadFieldError:
            self.counters["bad_field"] += 1
            return
        self.counters["logs_used"] += 1

    def _group(self, log: Log, found: list[Measurement]) -> None:
        key = log.week, log.tow_s
        if not self._belongs(key, log.name, found):
            return
        epoch = self._epoch
        place = self._place(log) if log.name in POSITIONS else None
        velocity = self._velocity(log) if log.name in VELOCITIES else None
        if epoch is None:
            leap = log.leap_seconds if log.leap_seconds is not None else self._leap_seconds
            epoch = self._epoch = _Epoch(log.week or 0, log.tow_s, log.believed, leap)
        epoch.t_seen_ns = self._t_seen_ns
        if place is not None:
            epoch.places[log.name] = place
        if velocity is not None:
            epoch.velocities[log.name] = velocity
        if self._cycle.add(key, log.name):
            self._close(found, learn=False, at_once=True)

    def _solution(self, epoch: _Epoch) -> Solution | None:
        there = [epoch.places[name] for name in POSITIONS if name in epoch.places]
        if not there:
            return None
        best = next((s for s in there if s.refusal is None), there[0])
        best.t_seen_ns = epoch.t_seen_ns
        if epoch.week:
            best.utc_ns = utc_as_reported(epoch.week, epoch.tow_s, epoch.leap_seconds)
        best.utc_known = epoch.believed
        moving = [epoch.velocities[name] for name in VELOCITIES if name in epoch.velocities]
        if moving:
            best.v_ned_m_s, best.sd_v_ned_m_s = moving[0]
        return best

    # ----------------------------------------------------------------- fields

    def _place(self, log: Log) -> Solution:
        f = log.fields
        if len(f) < _POSITION:
            raise BadFieldError("too few fields")
        status, kind, datum = f[0], f[1], f[6].strip('"')
        found = TYPES.get(kind, "inertial_refused" if kind.startswith("INS") else None)
        if found is None:
            self.counters["position_type_unknown"] += 1
            found = "no_fix"
        if found == "manual_refused" and self._decoding.allow_simulator:
            found = 1
        refusal = found if isinstance(found, str) else None
        if status != "SOL_COMPUTED":
            refusal = "no_fix"
        elif refusal is None and datum not in DATUMS:
            refusal = "datum_refused"
        lat, lon, height, undulation, sd_n, sd_e, sd_d = (
            _number(f[at]) for at in (2, 3, 4, 5, 7, 8, 9)
        )
        return Solution(
            self._t_seen_ns,
            refusal=refusal,
            quality=found if isinstance(found, int) else 1,
            lat_rad=math.radians(lat),
            lon_rad=math.radians(lon),
            height_m=None if kind == "FIXEDHEIGHT" else height + undulation,
            sd_ned_m=(sd_n, sd_e, sd_d),
            satellites=int(f[14]) if len(f) > 14 and f[14].isdecimal() else None,
        )

    def _velocity(self, log: Log) -> tuple[_Velocity, _VelocitySd | None] | None:
        """Velocity; None if the receiver has none, or its firmware's log lacks one."""
        f = log.fields
        if log.name in _WITH_BOTH:
            if len(f) < _BOTH:
                return None
            f = f[_VELOCITY_AT:]
        if len(f) < 7:
            raise BadFieldError("too few fields")
        kind = f[1]
        if f[0] != "SOL_COMPUTED" or kind in ("NONE", "PROPAGATED") or kind.startswith("INS"):
            return None
        latency, speed, track, up = (_number(f[at]) for at in (2, 4, 5, 6))
        if latency:
            # The filter estimates the error of the velocity's instant (time_offset_sd_s).
            self.counters["velocity_latent"] += 1
        course = math.radians(track)
        v = speed * math.cos(course), speed * math.sin(course), -up
        if log.name not in _WITH_BOTH or len(f) < 9:
            return v, None
        level, vertical = _number(f[7]), _number(f[8])
        return v, (level, level, vertical)

    def _heading(self, log: Log, found: list[Measurement]) -> None:
        f = log.fields
        if len(f) < 8:
            raise BadFieldError("too few fields")
        if f[0] != "SOL_COMPUTED" or f[1] == "NONE":
            self.counters["heading_not_valid"] += 1
            return
        if not f[1].endswith("_INT"):
            self.counters["heading_not_fixed"] += 1
            return
        heading, sd = _number(f[3]), _number(f[6])
        at_ns = None
        if log.week is not None:
            leap = log.leap_seconds if log.leap_seconds is not None else self._leap_seconds
            at_ns = utc_as_reported(log.week, log.tow_s, leap)
        yaw_rad, sd_rad = math.radians(heading), math.radians(sd)
        found += self._judge.heading(self._t_seen_ns, at_ns, yaw_rad, sd_rad)

    def _time(self, log: Log) -> None:
        f = log.fields
        if len(f) < 11 or f[0] != "VALID" or f[10] != "VALID":
            return
        leap = -round(_number(f[3]))
        if within(leap, LEAP_SECONDS):
            self._leap_seconds = leap


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise BadFieldError(str(error)) from None
    if not math.isfinite(value) or "_" in text:
        raise BadFieldError(text)
    return value
