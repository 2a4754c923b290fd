"""Epoch of a GNSS receiver, assembled from its sentences: no I/O, no clock.

`drivers.nmea.fields` makes typed fields of a sentence; an `Epoch` takes those it needs. A sentence
with an impossible field is refused as a whole (`BadFieldError`) and does not change the epoch.
Empty fields are normal and become None.

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
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date

from drivers.measurements import Vector3
from drivers.nmea.fields import (
    BadFieldError,
    Fields,
    PrintedPosition,
    angle,
    count,
    dop,
    letter,
    number,
    position,
    sigma,
    step,
    typed_fields,
)
from drivers.nmea.mixed_framing import Sentence
from drivers.nmea.printed_velocity import PrintedSpeed
from drivers.nmea.time import parse_time_of_day, printed_time
from drivers.plausible import HEIGHT_M, SIGMA_M, SPEED_M_S
from drivers.quantization import NEAREST_SD

INTEGRATED = frozenset({"II", "IN"})
"""Integrated instrumentation and navigation: a plotter or an adapter tells what it got, computed or
smoothed, in the receiver's own sentences."""
TALKERS = frozenset({"GP", "GN", "BD", "GB", "GL", "GA", "GI", "GQ", "QZ"}) | INTEGRATED
"""Talkers of satellite systems: GPS, several, BeiDou (two names), GLONASS, Galileo, NavIC, QZSS
(two names)."""
MAX_CYCLE = 24
"""Most sentences in an epoch; a receiver sends at most nine formatters and some GSA."""

KNOT_M_S = 1852.0 / 3600.0
KM_H_M_S = 1.0 / 3.6
_MODE_QUALITY = {"A": 1, "D": 2, "P": 3, "F": 5, "R": 4}  # worst first
_ESTIMATED = frozenset("EMS")
_METRES = ("M", "")
_NOT_VALID = frozenset(("V", "N", ""))
NOVATEL_SBAS = 9
"""GGA quality of NovAtel for a fix with satellite corrections (WAAS)."""
OVERDETERMINED = 5
"""Number of satellites that makes a fix three-dimensional whatever GSA states, if it has an
altitude and VDOP: four give position and clock, a fifth checks them (modules of Quectel and Telit
state 2 beside 8 to 14)."""


@dataclass(slots=True)
class Epoch:
    """Contents of the sentences of one instant; None for what none of them has. Degrees as printed,
    otherwise SI."""

    time_of_day_ns: int | None = None
    time_step_ns: int = 0
    """Time step of the last digit."""
    t_seen_ns: int = 0
    """Instant when the last sentence that counts came in."""
    cycle: list[str] = field(default_factory=list)
    """Formatters in order of arrival."""
    addresses: set[str] = field(default_factory=set)
    """Formatters with talkers, in order of arrival."""
    whole: bool = False
    """True if the receiver's epochs have been of these sentences and no more."""
    raws: set[bytes] = field(default_factory=set)
    """Raw sentences of the epoch, to detect repetitions."""
    day: date | None = None
    no_date: str = ""
    """Printed date that is invalid."""
    t_day_seen_ns: int = 0
    rmc_valid: bool | None = None
    unknown_status: str = ""
    """Invalid status of RMC, which makes RMC unusable."""
    gll_valid: bool | None = None
    plain: PrintedPosition | None = None
    """Position in RMC or GLL, which state only a mode."""
    by_plain: str = ""
    """Sentence with position and mode where neither GGA nor GNS exists: RMC or GLL."""
    place: PrintedPosition | None = None
    talker: str = ""
    """Talker of the sentence with the place."""
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
    """Satellites in GSA, with their system's number if stated."""
    hdop: float | None = None
    vdop: float | None = None
    nav_modes: set[int] = field(default_factory=set)
    """Fix mode of GSA: 1 no fix, 2 two-dimensional, 3 three-dimensional."""
    sd_ned_m: Vector3 | None = None
    """Printed sigmas; `implausible` checks them."""
    speed: PrintedSpeed | None = None
    heading_deg: float | None = None
    heading_mode: str | None = None

    def take(self, sentence: Sentence, t_seen_ns: int) -> None:
        """Add a sentence of `FORMATTERS`. BadFieldError for an impossible field."""
        formatter = sentence.formatter
        try:
            fields = typed_fields(formatter, sentence.fields)
        except ValueError as error:
            raise BadFieldError(str(error)) from None
        FORMATTERS[formatter](self, fields)
        self.t_seen_ns = t_seen_ns
        if formatter in ("RMC", "ZDA") and not self.t_day_seen_ns:
            self.t_day_seen_ns = t_seen_ns
        if formatter in ("GGA", "GNS"):
            self.talker = self.talker or sentence.talker
        self.cycle.append(formatter)
        self.addresses.add(sentence.address)
        self.raws.add(sentence.raw)

    @property
    def phase_ns(self) -> int | None:
        """Phase within the second, ns; None if no sentence has a time."""
        return None if self.time_of_day_ns is None else self.time_of_day_ns % 1_000_000_000

    def position(self) -> tuple[float, float, int] | None:
        """Latitude, longitude (deg) and quality, if complete."""
        if self.place is None or self.quality is None:
            return None
        return self.place.lat_deg, self.place.lon_deg, self.quality

    @property
    def plain_valid(self) -> bool | None:
        """Place and time of RMC or else GLL; None without either."""
        return self.gll_valid if self.rmc_valid is None else self.rmc_valid

    def take_mode(self) -> None:
        """Use the mode of RMC or GLL for a GGA with a position and an empty quality."""
        self.quality = self._quality_of_mode() if self.plain_valid else 0

    def take_plain(self) -> None:
        """Use RMC or GLL, the receiver's only position."""
        if self.plain is None or not self.plain_valid:
            return
        self.place, self.quality = self.plain, self._quality_of_mode()
        self.by_plain = "RMC" if self.rmc_valid else "GLL"

    def _quality_of_mode(self) -> int:
        """Quality of the worst mode; 1 without a mode (before NMEA 2.3)."""
        if "N" in self.modes:
            return 0
        return next((q for mode, q in _MODE_QUALITY.items() if mode in self.modes), 1)

    @property
    def two_dimensional(self) -> bool:
        """True if GSA credibly marks the height as not measured."""
        if 2 not in self.nav_modes or 3 in self.nav_modes:
            return False
        return max(self.counted, len(self.listed)) < OVERDETERMINED or self.vdop is None

    @property
    def rounding_sd_ned_m(self) -> Vector3:
        """One sigma of rounding to the printed digits."""
        place = self.place
        if place is None:
            return 0.0, 0.0, 0.0
        east = place.lon_step_m * math.cos(math.radians(place.lat_deg))
        steps = place.lat_step_m, east, self.height_step_m
        north, east, down = (NEAREST_SD * step for step in steps)
        return north, east, down

    def implausible(self) -> str | None:
        """Counter of an implausible value; None without one."""
        height = (self.altitude_m or 0.0) + (self.separation_m or 0.0)
        if not HEIGHT_M[0] <= height <= HEIGHT_M[1]:
            return "height_implausible"
        if self.speed is not None and self.speed.speed_m_s > SPEED_M_S:
            return "speed_implausible"
        if self.sd_ned_m is not None and max(self.sd_ned_m) > SIGMA_M[1]:
            return "sigma_too_large"
        return None


def time_of_day_ns(sentence: Sentence) -> int | None:
    """Time of day of a sentence; None without one. BadFieldError."""
    try:
        return parse_time_of_day(printed_time(sentence))
    except ValueError as error:
        raise BadFieldError(str(error)) from None


# --------------------------------------------------------------------------- sentences


def _take_height(epoch: Epoch, fields: Fields) -> None:
    epoch.altitude_m, epoch.separation_m = number(fields, "alt"), number(fields, "sep")
    if letter(fields, "altUnit").upper() not in _METRES:  # some simulators use feet
        epoch.altitude_m = None
    if epoch.altitude_m is not None:
        epoch.height_step_m = step(fields["printed"][8])


def _take_gga(epoch: Epoch, fields: Fields) -> None:
    place = position(fields)
    quality, satellites = count(fields, "quality"), count(fields, "numSV")
    hdop = dop(fields, "HDOP")
    _take_height(epoch, fields)
    epoch.place, epoch.quality = place, 2 if quality == NOVATEL_SBAS else quality
    if place is None and quality is None:
        epoch.quality = 0
    epoch.satellites = satellites or epoch.satellites or satellites  # GNS may have counted
    epoch.hdop = hdop if hdop is not None else epoch.hdop
    epoch.counted = max(epoch.counted, satellites or 0)


def _take_gns(epoch: Epoch, fields: Fields) -> None:
    place = position(fields)
    satellites, hdop = count(fields, "numSV"), dop(fields, "HDOP")
    used = set(letter(fields, "posMode")) - {"N"}
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
"""Field of the date in RMC."""


def _take_rmc(epoch: Epoch, fields: Fields) -> None:
    speed, course = number(fields, "spd", 0.0), angle(fields, "cog")
    status, mode = letter(fields, "status"), letter(fields, "posMode")
    place = position(fields, 2)
    if status in _MODE_QUALITY or status in _ESTIMATED:
        epoch.rmc_valid, epoch.plain = True, place
        # Status D beside mode R counts as R alone; status E counts, too.
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
        step_m_s = step(fields["printed"][6]) * KNOT_M_S
        epoch.speed = PrintedSpeed(speed * KNOT_M_S, step_m_s, course)


def _take_gll(epoch: Epoch, fields: Fields) -> None:
    place, status = position(fields, 0), letter(fields, "status")
    epoch.modes |= set(letter(fields, "posMode"))
    if status:  # before NMEA 2.0 GLL has neither time nor status
        epoch.gll_valid = status == "A"
    if epoch.gll_valid and epoch.plain is None:
        epoch.plain = place


def _take_vtg(epoch: Epoch, fields: Fields) -> None:
    course = angle(fields, "cogt")
    knots, km_h = number(fields, "sogn", 0.0), number(fields, "sogk", 0.0)
    mode = letter(fields, "posMode")
    epoch.modes |= set(mode)
    if mode == "N":
        return
    if epoch.speed is not None:
        if epoch.speed.course_deg is None:
            epoch.speed = epoch.speed._replace(course_deg=course)
    elif knots is not None:
        epoch.speed = PrintedSpeed(knots * KNOT_M_S, step(fields["printed"][4]) * KNOT_M_S, course)
    elif km_h is not None:
        epoch.speed = PrintedSpeed(km_h * KM_H_M_S, step(fields["printed"][6]) * KM_H_M_S, course)


def _take_gsa(epoch: Epoch, fields: Fields) -> None:
    hdop, vdop = dop(fields, "HDOP"), dop(fields, "VDOP")
    nav_mode = count(fields, "navMode")
    if nav_mode is not None:
        epoch.nav_modes.add(nav_mode)
    system = letter(fields, "systemId")
    epoch.listed.update((each, system) for each in fields["printed"][2:14] if each)
    epoch.hdop = epoch.hdop if epoch.hdop is not None else hdop
    epoch.vdop = epoch.vdop if epoch.vdop is not None else vdop


def _take_gst(epoch: Epoch, fields: Fields) -> None:
    north, east, down = (sigma(fields, name) for name in ("stdLat", "stdLong", "stdAlt"))
    if north is not None and east is not None and down is not None:
        epoch.sd_ned_m = (north, east, down)


def _take_zda(epoch: Epoch, fields: Fields) -> None:
    parts = [count(fields, name) for name in ("year", "month", "day")]
    if parts[0] is None or parts[1] is None or parts[2] is None:
        return
    try:
        day = date(parts[0], parts[1], parts[2])
    except (ValueError, OverflowError) as error:
        raise BadFieldError(str(error)) from None
    epoch.day = epoch.day or day


def _take_hdt(epoch: Epoch, fields: Fields) -> None:
    heading = angle(fields, "headingT")
    if epoch.heading_deg is None:
        epoch.heading_deg = heading


def _take_ths(epoch: Epoch, fields: Fields) -> None:
    heading, mode = angle(fields, "headt"), letter(fields, "mi")
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
"""Handlers of the used sentences."""
