"""One epoch of a GNSS receiver, put together from its sentences: no I/O, no clock.

`drivers.nmea.fields` makes typed fields of a sentence; an `Epoch` takes those that matter. A
sentence with a field that cannot be true is refused whole (`BadFieldError`) and leaves the epoch as
it was. Empty fields are normal and become None.

Quality comes from GGA; NovAtel's 9 is a fix with corrections of a satellite (2). Where only GNS is
sent it comes from its mode string, one letter a system: the worst letter of the systems in use
counts, in the order A (1), D (2), P (3), F (5), R (4), and E, M or S in any of them marks the whole
epoch as estimated, manual or simulated. Where only RMC or GLL is sent it comes from its mode, or
from RMC's status in receivers that put the mode there (Unicore: D beside mode R):

    A  D  F  P  R    valid: autonomous, differential, float RTK, precise, fixed RTK
    E  M  S          valid for the receiver: estimated, manual, simulated
    V  N             not valid

Source: NMEA 0183 4.11, RMC and the table of mode indicators; u-blox ZED-F9P interface description,
"Position fix flags in NMEA"; NovAtel OEM7 commands and logs, GPGGA.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date
from typing import NamedTuple

from drivers.measurements import Vector3
from drivers.nmea.fields import Fields, typed
from drivers.nmea.framing import Sentence
from drivers.nmea.time import parse_time_of_day, printed_time
from drivers.plausible import HEIGHT_M, SIGMA_M, SPEED_M_S, within
from drivers.rounding import NEAREST_SD

INTEGRATED = frozenset({"II", "IN"})
"""Integrated instrumentation and navigation: a plotter or an adapter tells what it got, computed or
smoothed, in the receiver's own sentences."""
TALKERS = frozenset({"GP", "GN", "BD", "GB", "GL", "GA", "GI", "GQ", "QZ"}) | INTEGRATED
"""Satellites: GPS, several, BeiDou (two names), GLONASS, Galileo, NavIC, QZSS (two names)."""
MAX_CYCLE = 24
"""Sentences that one epoch may hold; a receiver sends at most nine formatters and some GSA."""

KNOT_M_S = 1852.0 / 3600.0
KM_H_M_S = 1.0 / 3.6
STANDSTILL_M_S = 0.05
"""Below it an absent course means standing still: the Doppler velocity noise of a receiver
(u-blox ZED-F9P data sheet: 0.05 m/s)."""
NO_DOP = 99.0
"""Receivers without a solution print 99.99."""

_MODE_QUALITY = {"A": 1, "D": 2, "P": 3, "F": 5, "R": 4}  # worst first
_ESTIMATED = frozenset("EMS")
_NOT_VALID = frozenset(("V", "N", ""))
NOVATEL_SBAS = 9
"""GGA quality of NovAtel for a fix with the corrections of a satellite (WAAS)."""
OVERDETERMINED = 5
"""Satellites with which a fix is three-dimensional whatever GSA says, if it has an altitude and
VDOP: four give place and clock, one more than that checks them (modules of Quectel and Telit say 2
beside 8 to 14)."""
MINUTE_M = 1852.0
"""Of latitude."""
_PRINTED_POSITION = re.compile(r"\d\d[0-5]\d\.\d*,[NS],\d{2,3}[0-5]\d\.\d*,[EW]\Z")


class Printed(NamedTuple):
    """Latitude and longitude (deg) of a sentence, and one step of their last digits (m), that of
    the longitude at the equator."""

    lat_deg: float
    lon_deg: float
    lat_step_m: float
    lon_step_m: float


class BadFieldError(ValueError):
    """A sentence verified, but a field of it cannot be true."""


@dataclass(slots=True)
class Epoch:
    """Contents of the sentences of one instant; None where none did. Degrees as printed, SI
    else."""

    time_of_day_ns: int | None = None
    time_step_ns: int = 0
    """Of its last digit."""
    t_seen_ns: int = 0
    """Instant when the last sentence that counts came in."""
    cycle: list[str] = field(default_factory=list)
    """Formatters in the order they came."""
    addresses: set[str] = field(default_factory=set)
    """The same with their talkers."""
    raws: set[bytes] = field(default_factory=set)
    """Sentences of the epoch, which may come twice."""
    day: date | None = None
    no_date: str = ""
    """A date that is printed and is none."""
    t_day_seen_ns: int = 0
    rmc_valid: bool | None = None
    unknown_status: str = ""
    """A status of RMC that is none: it says nothing of the others, and RMC counts for nothing."""
    gll_valid: bool | None = None
    plain: Printed | None = None
    """The place in RMC or GLL, which say nothing of its quality but a mode."""
    by_plain: str = ""
    """Source of place and quality where there is neither GGA nor GNS: RMC or GLL."""
    place: Printed | None = None
    altitude_m: float | None = None
    height_step_m: float = 0.0
    separation_m: float | None = None
    quality: int | None = None
    modes: set[str] = field(default_factory=set)
    """Mode letters of RMC, VTG and the systems in use in GNS."""
    satellites: int | None = None
    counted: int = 0
    """Satellites that GGA and GNS say were used; of several systems GGA may count one."""
    listed: set[tuple[str, str]] = field(default_factory=set)
    """Those that GSA lists, with the number of their system where it says it."""
    hdop: float | None = None
    vdop: float | None = None
    nav_modes: set[int] = field(default_factory=set)
    """Fix mode of GSA: 1 no fix, 2 two-dimensional, 3 three-dimensional."""
    sd_ned_m: Vector3 | None = None
    """As printed; `implausible` judges it."""
    speed_m_s: float | None = None
    course_deg: float | None = None
    heading_deg: float | None = None
    heading_mode: str | None = None

    def take(self, sentence: Sentence, t_seen_ns: int) -> None:
        """Add a sentence of `FORMATTERS`. BadFieldError when a field of it cannot be true."""
        formatter = sentence.formatter
        try:
            fields = typed(formatter, sentence.fields)
        except ValueError as error:
            raise BadFieldError(str(error)) from None
        FORMATTERS[formatter](self, fields)
        self.t_seen_ns = t_seen_ns
        if formatter in ("RMC", "ZDA") and not self.t_day_seen_ns:
            self.t_day_seen_ns = t_seen_ns
        self.cycle.append(formatter)
        self.addresses.add(sentence.address)
        self.raws.add(sentence.raw)

    def position(self) -> tuple[float, float, int] | None:
        """Latitude, longitude (deg) and quality, where the epoch has them."""
        if self.place is None or self.quality is None:
            return None
        return self.place.lat_deg, self.place.lon_deg, self.quality

    @property
    def plain_valid(self) -> bool | None:
        """Place and time of RMC, or else GLL; None where neither does."""
        return self.gll_valid if self.rmc_valid is None else self.rmc_valid

    def take_plain(self) -> None:
        """RMC or GLL is all that the receiver says of its place."""
        if self.plain is None or not self.plain_valid:
            return
        known = [quality for mode, quality in _MODE_QUALITY.items() if mode in self.modes]
        if "N" in self.modes:
            known = [0]
        self.place, self.quality = self.plain, (known or [1])[0]
        self.by_plain = "RMC" if self.rmc_valid else "GLL"

    @property
    def two_dimensional(self) -> bool:
        """True if the height is none that was measured: GSA says so, and may be right."""
        if 2 not in self.nav_modes or 3 in self.nav_modes:
            return False
        return max(self.counted, len(self.listed)) < OVERDETERMINED or self.vdop is None

    @property
    def rounding_sd_ned_m(self) -> Vector3:
        """One sigma of what the printed digits leave out."""
        place = self.place
        if place is None:
            return 0.0, 0.0, 0.0
        east = place.lon_step_m * math.cos(math.radians(place.lat_deg))
        steps = place.lat_step_m, east, self.height_step_m
        north, east, down = (NEAREST_SD * step for step in steps)
        return north, east, down

    def implausible(self) -> str | None:
        """The counter of what no receiver can mean, None where all can be."""
        height = (self.altitude_m or 0.0) + (self.separation_m or 0.0)
        if not within(height, HEIGHT_M):
            return "height_implausible"
        if self.speed_m_s is not None and self.speed_m_s > SPEED_M_S:
            return "speed_implausible"
        if self.sd_ned_m is not None and max(self.sd_ned_m) > SIGMA_M[1]:
            return "sigma_too_large"
        return None

    def v_ned_m_s(self) -> tuple[float, float, None] | None:
        """Horizontal velocity; None when the receiver gives no course though it moves."""
        if self.speed_m_s is None:
            return None
        if self.course_deg is None:
            return (0.0, 0.0, None) if self.speed_m_s < STANDSTILL_M_S else None
        course = math.radians(self.course_deg)
        return (self.speed_m_s * math.cos(course), self.speed_m_s * math.sin(course), None)


def time_of_day_ns(sentence: Sentence) -> int | None:
    """Its time of day; None where this kind has none or the field is empty. BadFieldError."""
    try:
        return parse_time_of_day(printed_time(sentence))
    except ValueError as error:
        raise BadFieldError(str(error)) from None


# --------------------------------------------------------------------------- fields


def _number(fields: Fields, name: str, least: float = -math.inf) -> float | None:
    value = fields.get(name, "")
    if not isinstance(value, float | int):
        return None
    if not math.isfinite(value) or value < least:
        raise BadFieldError(f"{name} = {value}")
    return float(value)


def _count(fields: Fields, name: str) -> int | None:
    number = _number(fields, name, 0.0)
    return None if number is None else int(number)


def _sigma(fields: Fields, name: str) -> float | None:
    """A sigma that is no number is as large as can be: it must not pass for one not given."""
    value = fields.get(name, "")
    if isinstance(value, float) and not math.isfinite(value):
        return math.inf
    return _number(fields, name, 0.0)


def _letter(fields: Fields, name: str) -> str:
    return str(fields.get(name, ""))


def _dop(fields: Fields, name: str) -> float | None:
    dop = _number(fields, name, 0.0)
    return dop if dop is not None and 0.0 < dop < NO_DOP else None


def _angle(fields: Fields, name: str) -> float | None:
    angle = _number(fields, name, 0.0)
    if angle is not None and angle > 360.0:
        raise BadFieldError(f"{name} = {angle} deg")
    return angle


def _step(printed: str) -> float:
    """Of the last digit."""
    return 10.0 ** -len(printed.partition(".")[2])


def _position(fields: Fields, first: int = 1) -> Printed | None:
    """From the fields `lat`, `NS`, `lon`, `EW`, which follow one another from number `first` on."""
    lat, lon = _number(fields, "lat"), _number(fields, "lon")
    if lat is None or lon is None:
        return None
    parts = fields["printed"][first : first + 4]
    printed = ",".join(parts)
    if not _PRINTED_POSITION.match(printed):  # no hemisphere, 60 minutes, signs
        raise BadFieldError(f"not a position: {printed}")
    if abs(lat) > 90.0 or abs(lon) > 180.0:
        raise BadFieldError(f"no such place: {lat} {lon}")
    return Printed(lat, lon, MINUTE_M * _step(parts[0]), MINUTE_M * _step(parts[2]))


def _take_height(epoch: Epoch, fields: Fields) -> None:
    epoch.altitude_m, epoch.separation_m = _number(fields, "alt"), _number(fields, "sep")
    if epoch.altitude_m is not None:
        epoch.height_step_m = _step(fields["printed"][8])


def _take_gga(epoch: Epoch, fields: Fields) -> None:
    place = _position(fields)
    quality, satellites = _count(fields, "quality"), _count(fields, "numSV")
    hdop = _dop(fields, "HDOP")
    _take_height(epoch, fields)
    epoch.place, epoch.quality = place, 2 if quality == NOVATEL_SBAS else quality or 0
    epoch.satellites = satellites or epoch.satellites or satellites  # GNS may have counted some
    epoch.hdop = hdop if hdop is not None else epoch.hdop
    epoch.counted = max(epoch.counted, satellites or 0)


def _take_gns(epoch: Epoch, fields: Fields) -> None:
    place = _position(fields)
    satellites, hdop = _count(fields, "numSV"), _dop(fields, "HDOP")
    used = set(_letter(fields, "posMode")) - {"N"}
    epoch.modes |= used
    epoch.counted = max(epoch.counted, satellites or 0)
    if "GGA" in epoch.cycle:
        return
    _take_height(epoch, fields)
    epoch.place = place
    worst = [quality for mode, quality in _MODE_QUALITY.items() if mode in used]
    epoch.quality = worst[0] if worst else 0
    epoch.satellites, epoch.hdop = satellites, hdop if hdop is not None else epoch.hdop


_DATE_AT = 8
"""Of RMC's fields, printed."""


def _take_rmc(epoch: Epoch, fields: Fields) -> None:
    speed, course = _number(fields, "spd", 0.0), _angle(fields, "cog")
    status, mode = _letter(fields, "status"), _letter(fields, "posMode")
    place = _position(fields, 2)
    if status in _MODE_QUALITY or status in _ESTIMATED:
        epoch.rmc_valid, epoch.plain = True, place
        # Who sends D beside R means R; who sends E beside it means that, too.
        mode = mode + status if status in _ESTIMATED else mode or status
    elif status in _NOT_VALID:
        epoch.rmc_valid = False
    else:
        epoch.unknown_status = status
    epoch.modes |= set(mode)
    day = fields.get("date", "")
    if not isinstance(day, date):
        epoch.no_date = "".join(fields["printed"][_DATE_AT : _DATE_AT + 1]).strip()
    else:
        epoch.day = day  # two digits: 69 to 99 are 1969 to 1999, a cold receiver's 1980
    if speed is not None and epoch.rmc_valid:
        epoch.speed_m_s, epoch.course_deg = speed * KNOT_M_S, course


def _take_gll(epoch: Epoch, fields: Fields) -> None:
    place, status = _position(fields, 0), _letter(fields, "status")
    epoch.modes |= set(_letter(fields, "posMode"))
    if status:  # before NMEA 2.0 it has neither time nor status, and says nothing
        epoch.gll_valid = status == "A"
    if epoch.gll_valid and epoch.plain is None:
        epoch.plain = place


def _take_vtg(epoch: Epoch, fields: Fields) -> None:
    course = _angle(fields, "cogt")
    knots, km_h = _number(fields, "sogn", 0.0), _number(fields, "sogk", 0.0)
    mode = _letter(fields, "posMode")
    epoch.modes |= set(mode)
    if mode == "N":
        return
    if epoch.speed_m_s is not None:
        epoch.course_deg = course if epoch.course_deg is None else epoch.course_deg
    elif knots is not None:
        epoch.speed_m_s, epoch.course_deg = knots * KNOT_M_S, course
    elif km_h is not None:
        epoch.speed_m_s, epoch.course_deg = km_h * KM_H_M_S, course


def _take_gsa(epoch: Epoch, fields: Fields) -> None:
    hdop, vdop = _dop(fields, "HDOP"), _dop(fields, "VDOP")
    nav_mode = _count(fields, "navMode")
    if nav_mode is not None:
        epoch.nav_modes.add(nav_mode)
    system = _letter(fields, "systemId")
    epoch.listed.update((number, system) for number in fields["printed"][2:14] if number)
    epoch.hdop = epoch.hdop if epoch.hdop is not None else hdop
    epoch.vdop = epoch.vdop if epoch.vdop is not None else vdop


def _take_gst(epoch: Epoch, fields: Fields) -> None:
    north, east, down = (_sigma(fields, name) for name in ("stdLat", "stdLong", "stdAlt"))
    if north is not None and east is not None and down is not None:
        epoch.sd_ned_m = (north, east, down)


def _take_zda(epoch: Epoch, fields: Fields) -> None:
    parts = [_count(fields, name) for name in ("year", "month", "day")]
    if parts[0] is None or parts[1] is None or parts[2] is None:
        return
    try:
        day = date(parts[0], parts[1], parts[2])
    except (ValueError, OverflowError) as error:
        raise BadFieldError(str(error)) from None
    epoch.day = epoch.day or day


def _take_hdt(epoch: Epoch, fields: Fields) -> None:
    heading = _angle(fields, "headingT")
    if epoch.heading_deg is None:
        epoch.heading_deg = heading


def _take_ths(epoch: Epoch, fields: Fields) -> None:
    heading, mode = _angle(fields, "headt"), _letter(fields, "mi")
    epoch.heading_deg, epoch.heading_mode = heading, mode


FORMATTERS: dict[str, Callable[[Epoch, Fields], None]] = {
    "GGA": _take_gga,
    "GNS": _take_gns,
    "RMC": _take_rmc,
    "GLL": _take_gll,
    "VTG": _take_vtg,
    "GSA": _take_gsa,
    "GST": _take_gst,
    "ZDA": _take_zda,
    "HDT": _take_hdt,
    "THS": _take_ths,
}
"""The sentences that count, and how an epoch takes them."""
