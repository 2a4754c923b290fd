r"""Input of the navigator: aiding measurements of a device measurement, or the name of its
rejection.

Each measurement is checked here once, before any use. The configuration is applied: lever arm,
sigma if the device states none, floors and gates. The results are in SI units with a settled
instant. Each kind of measurement has a module of its own, listed in `KINDS`.

Plausibility, by the limits of the vehicle's class (fusiond.configuration.vehicle_class):

    not_finite              NaN or infinity
    position_implausible    not on the Earth, too near a pole for north and east, or exactly 0 N 0 E
    height_implausible      outside the limits of the vehicle's class
    speed_implausible       likewise
    sigma_implausible       negative, too large to be of use, or smaller than the best device's

A value that is not stated (None; for a sigma also 0) is no fault: the section has one, or the
outcome is `no_sigma`. A fix with a sigma too small to be true is kept;
`fusiond.navigator.intake.gnss` replaces the sigma.

Rate, by a bucket of tokens for a source and kind of measurement:

    tokens <- min(BURST, tokens + |t - t_before| rate) - 1

Below 0 the source is too fast: that measurement, and all others until none was too fast for
`CALM_NS`, are `too_often`. A source that sends false data at a high rate mixes them with true ones,
which cannot be distinguished, and the mean of repetitions has no smaller error than one.

t is the instant of validity, so that a backlog with stamps of its own counts as received in time;
the sign of the difference is ignored, as delayed measurements come out of order.

A backlog that arrives before the source's UTC is known has one instant, that of its arrival,
although its stamps advance. Its instants remain unknown: all beyond the burst is rejected as
`backlog`, and the source is not too fast.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from drivers.measurements import (
    Attitude,
    Bearing,
    DelayedFix,
    Heading,
    Height,
    MagneticHeading,
    Measurement,
    PositionFix,
    TimeOfDayStamp,
    UtcStamp,
    WheelSpeed,
)
from drivers.plausible import SIGMA_M
from drivers.raw.messages import RawGnssEpoch
from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.aiding import AnyAiding
from fusiond.configuration.vehicle_class import PLAUSIBILITY, Plausibility
from fusiond.models.blocks import Block
from fusiond.navigator.intake import (
    attitude,
    compass,
    gnss,
    heading,
    height,
    landmark_bearing,
    raw,
    rdss,
    wheel,
)
from fusiond.navigator.intake.kind import (
    LEAST_SPEED_SD_M_S,
    Instants,
    Kind,
    Sections,
    shown_as,
)

if TYPE_CHECKING:
    from fusiond.navigator.aiding_drift_sigma_estimation import DriftLevels

KINDS: tuple[Kind, ...] = (
    gnss.KIND,
    raw.KIND,
    rdss.KIND,
    wheel.KIND,
    heading.KIND,
    compass.KIND,
    attitude.KIND,
    height.KIND,
    landmark_bearing.KIND,
)

LATITUDE_RAD = (-math.radians(89.9), math.radians(89.9))
"""Largest latitude, 11 km from a pole, where north turns by a degree each 200 m: the navigation
frame ends there."""
LONGITUDE_RAD = (-math.pi, 2.0 * math.pi)
"""Devices count from -180 to 180 or from 0 to 360 deg."""

SIGMA_RAD = (1e-6, math.pi)
"""0.2 arcsec: the best star trackers state one arcsecond; beyond a half turn nothing is said."""
LEAST_CLASS_M = 1.0
"""The precision classes of RDSS are 20 and 100 m."""

RATES: Mapping[type, tuple[float, str]] = {
    # Receivers offer 10 to 25 Hz (u-blox ZED-F9P: 20 Hz), those for machines 50, and 100 only from
    # extrapolated phase: more than 50 in a second say nothing that the inertial unit does not.
    PositionFix: (50.0, "fixes"),
    RawGnssEpoch: (50.0, "epochs"),
    Heading: (50.0, "headings"),
    MagneticHeading: (50.0, "headings"),
    # The fastest cards may be asked once a second (docs/rdss-terminal.md).
    DelayedFix: (2.0, "fixes"),
    # CAN carries wheel speeds every 10 or 20 ms; attitude units and altimeters reach 200 Hz.
    WheelSpeed: (200.0, "speeds"),
    Attitude: (200.0, "attitudes"),
    Height: (200.0, "heights"),
    Bearing: (50.0, "bearings"),
}
"""Largest rate (measurements a second) and description of a source's kind."""
BURST = 5.0
"""Measurements allowed at once: arrival stamps jitter, and a line that paused delivers a burst."""
STAMPED = 0.99
"""Least advance of a device's own stamps in intervals of the rate; seconds since 1970 are known to
a quarter of a microsecond."""
CALM_NS = 1_000_000_000


class Intake:
    """Intake of measurements, with `aiding` by source name; a source without a section has its
    kind's defaults.

    `limits` are those of the vehicle's class; `report(code, text)` receives a source that is too
    fast.
    """

    def __init__(
        self,
        aiding: Mapping[str, AnyAiding],
        limits: Plausibility = PLAUSIBILITY["aircraft"],
        report: Callable[[str, str], None] = lambda code, text: None,
    ) -> None:
        self._sections = Sections(aiding)
        self._limits, self._report = limits, report
        self._buckets: dict[tuple[str, type], tuple[float, int, float]] = {}
        self._fast_ns: dict[tuple[str, type], int] = {}
        self.receivers = self._sections.receivers

    def set_gates(self, gates: Mapping[str, float]) -> None:
        """`gate_probability` by section."""
        self._sections.set_gates(gates)

    def measurements_of(
        self, m: Measurement | RawGnssEpoch, t_ns: int, sd_time_s: float, seen_ns: int = 0
    ) -> Sequence[AidingMeasurement] | str:
        """Aiding measurements of `m`, valid at `t_ns`, or the name of its refusal."""
        when = Instants(t_ns, sd_time_s, seen_ns)
        for kind in KINDS:
            if isinstance(m, kind.reported):
                if (refused := self._refusal(m, kind.reported, t_ns)) is not None:
                    return refused
                sections = self._sections
                if isinstance(m, (PositionFix, DelayedFix)):
                    sections.place = m.lat_rad, m.lon_rad
                    if isinstance(m.stamp, UtcStamp):
                        sections.utc_ns = m.stamp.utc_ns
                found = kind.measurements_of(m, sections, when)
                if isinstance(found, str) or not sections.any_robust:
                    return found
                if not sections.robust(m.source):
                    return found
                return [replace(measurement, robust=True) for measurement in found]
        return "not_a_measurement"

    def _refusal(self, m: Measurement | RawGnssEpoch, kind: type, t_ns: int) -> str | None:
        """Name of what is implausible in `m`, valid at `t_ns`, `too_often` or `backlog`; None if
        admitted."""
        implausible = _implausible(m, self._limits)
        if implausible is not None:
            return implausible
        rate_hz, what = RATES[kind]
        key = m.source, kind
        match getattr(m, "stamp", None):
            case UtcStamp(utc_ns):
                said_s = utc_ns * 1e-9
            case TimeOfDayStamp(time_of_day_s):
                said_s = time_of_day_s
            case _:
                said_s = math.inf
        tokens, before_ns, said_before_s = self._buckets.get(key, (BURST, t_ns, math.inf))
        tokens = min(BURST, tokens + abs(t_ns - before_ns) * 1e-9 * rate_hz) - 1.0
        self._buckets[key] = max(tokens, 0.0), t_ns, said_s
        fast_ns = self._fast_ns.get(key)
        advanced = math.isfinite(said_s) and (said_s - said_before_s) * rate_hz >= STAMPED
        if tokens < 0.0 and fast_ns is None and advanced:
            return "backlog"
        if tokens >= 0.0 and (fast_ns is None or abs(t_ns - fast_ns) >= CALM_NS):
            self._fast_ns.pop(key, None)
            return None
        if tokens < 0.0:
            self._fast_ns[key] = t_ns
            if fast_ns is None:
                self._report(
                    "source_too_fast",
                    f"{m.source} sends more than {rate_hz:g} {what} a second: it is left out until "
                    "it does not",
                )
        return "too_often"

    @property
    def fixes_shown(self) -> dict[str, tuple[float, ...]]:
        """Sums of each receiver's fixes about their errors, for the next start."""
        return {shown_as(*key): each.shown for key, each in self._sections.fix_errors.items()}

    def take_up(self, fixes_shown: Mapping[str, tuple[float, ...]]) -> None:
        """Resume from these sums, for receivers without a fix so far."""
        self._sections.fixes_shown = fixes_shown

    def count_drifts(self, drifts: DriftLevels) -> None:
        """Set the weights of the configured drifts from now on."""
        self._sections.drifts = drifts

    def extra_blocks(self) -> list[Block]:
        """Blocks of the model for the measurements: errors that successive measurements share. The
        first source determines the noise of a common block."""
        blocks: dict[str, Block] = {}
        for source, section in self._sections.aiding.items():
            for kind in KINDS:
                found = kind.blocks.get(type(section))
                if found is not None:
                    for block in found(source, section, self._sections):
                        blocks.setdefault(block.name, block)
        return list(blocks.values())


def _implausible(m: Measurement | RawGnssEpoch, limits: Plausibility) -> str | None:
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
    on_earth = (
        LATITUDE_RAD[0] <= lat_rad <= LATITUDE_RAD[1]
        and LONGITUDE_RAD[0] <= lon_rad <= LONGITUDE_RAD[1]
    )
    if nowhere or not on_earth:
        return _finite((lat_rad, lon_rad)) or "position_implausible"
    # Within limits is nothing that is not finite.
    if height_m is None:
        return None
    return _finite((height_m,)) if limits is None else _height(height_m, limits)


def _height(height_m: float, limits: Plausibility) -> str | None:
    least_m, most_m = limits.height_m
    if least_m <= height_m <= most_m:
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
