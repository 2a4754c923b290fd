"""Parser of UBX-NAV messages, little endian, in verified frames, into an epoch.

    PVT 0x07      everything; POSLLH 0x02, VELNED 0x12 and HPPOSLLH 0x14 parts of it, finer
    SOL 0x06      what PVT was before generation 7: ECEF, GPS time
    POSECEF 0x01 and VELECEF 0x11    the same without status and time
    STATUS 0x03, DOP 0x04, COV 0x36, TIMEGPS 0x20, TIMEUTC 0x21
    hAcc          sqrt(sd_n^2 + sd_e^2), pAcc and sAcc over three axes

The root of sums: of a recorded ZED-F9P and F9R pAcc^2 = hAcc^2 + vAcc^2 and GST's two sigmas make
hAcc. NAV-COV has each axis. Source: u-blox F9 HPG interface description; u-blox 6 receiver
description (SOL).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date

from drivers.geodesy import geodetic, north_east_down
from drivers.measurements import Vector3
from drivers.nmea.time import posix_ns
from drivers.raw.weeks import leap_seconds, utc_ns

CLASS_NAV = 0x01
_EVEN_2, _EVEN_3 = math.sqrt(0.5), math.sqrt(1.0 / 3.0)
_DEG_1E7 = math.radians(1e-7)
NO_FIX, DEAD_RECKONING, TWO_D, THREE_D, COMBINED, TIME_ONLY = range(6)
"""fixType of PVT, gpsFix of STATUS and SOL."""
NO_DOP = 99.0


@dataclass(slots=True)
class NavEpoch:
    """Contents of the messages of one iTOW; None for what none of them has.

    `rank` is the source of the position (SOL 1, POSLLH 2, PVT 3, HPPOSLLH 4), `utc_rank` that of
    the time: a higher one replaces a lower one.
    """

    itow_ms: int
    t_seen_ns: int = 0
    utc_ns: int | None = None
    utc_known: bool = False
    utc_rank: int = 0
    fix: int | None = None
    fix_ok: bool = False
    differential: bool = False
    carrier: int = 0
    position_valid: bool = True
    rank: int = 0
    lat_rad: float | None = None
    lon_rad: float | None = None
    height_m: float | None = None
    sd_ned_m: Vector3 | None = None
    covariance_ned_m: Vector3 | None = None
    v_rank: int = 0
    v_ecef_m_s: tuple[Vector3, float] | None = None
    """ECEF velocity with its sigma, rotated to NED when the epoch is complete."""
    v_ned_m_s: Vector3 | None = None
    sd_v_m_s: float | None = None
    covariance_v_m_s: Vector3 | None = None
    satellites: int | None = None
    hdop: float | None = None
    vdop: float | None = None

    def place(self, rank: int, where: Vector3, sd_h_m: float, sd_v_m: float) -> None:
        """Set a position (rad, rad, m) with its horizontal and vertical sigma."""
        if rank >= self.rank:
            self.rank = rank
            self.lat_rad, self.lon_rad, self.height_m = where
            level = sd_h_m * _EVEN_2
            self.sd_ned_m = level, level, sd_v_m

    def velocity(self, rank: int, v: Vector3, sd_m_s: float) -> None:
        if rank >= self.v_rank:
            self.v_rank, self.v_ned_m_s, self.sd_v_m_s = rank, v, sd_m_s * _EVEN_3

    def whole(self) -> None:
        """Complete the epoch: convert the values that depend on its position."""
        if self.v_ecef_m_s is not None and self.lat_rad is not None and self.lon_rad is not None:
            v, sd_m_s = self.v_ecef_m_s
            self.velocity(1, north_east_down(v, self.lat_rad, self.lon_rad), sd_m_s)

    def status(self, fix: int, flags: int, carrier: int, rank: int) -> None:
        """Set the status: gnssFixOK and diffSoln are the lowest bits of `flags` in every
        message."""
        if self.fix is not None and rank < 3:
            return
        self.fix, self.fix_ok, self.differential = fix, bool(flags & 1), bool(flags & 2)
        self.carrier = carrier

    def time(self, rank: int, at_ns: int, known: bool) -> None:
        if rank >= self.utc_rank:
            self.utc_rank, self.utc_ns, self.utc_known = rank, at_ns, known


class UnreadableError(ValueError):
    """Error: an impossible field in a verified message."""


_PVT = struct.Struct("<IHBBBBBBIiBBBBiiiiIIiiiiiIIHH")
_POSLLH = struct.Struct("<IiiiiII")
_HPPOSLLH = struct.Struct("<B2xBIiiiibbbbII")
_VELNED = struct.Struct("<IiiiIIiII")
_SOL = struct.Struct("<IihBBiiiIiiiIHBB")
_ECEF = struct.Struct("<IiiiI")
_STATUS = struct.Struct("<IBBBBII")
_DOP = struct.Struct("<IHHHHHHH")
_COV = struct.Struct("<IBBB9x12f")
_TIMEGPS = struct.Struct("<IihbBI")
_TIMEUTC = struct.Struct("<IIiHBBBBBB")
_DATE, _TIME, _RESOLVED = 1, 2, 4


def _utc(day: tuple[int, int, int], clock: tuple[int, int, int], nano: int) -> int:
    """POSIX ns; second 60 is a leap second."""
    hour, minute, second = clock
    try:
        when = date(*day)
    except ValueError as error:
        raise UnreadableError(str(error)) from None
    if hour > 23 or minute > 59 or second > 60 or abs(nano) > 1_000_000_000:
        raise UnreadableError("no such time of day")
    of_day = ((hour * 60 + minute) * 60 + second) * 1_000_000_000
    return posix_ns(when, of_day) + nano


def _pvt(epoch: NavEpoch, payload: bytes) -> None:
    (
        _, year, month, day, hour, minute, second, valid, _, nano, fix, flags, _, satellites,
        lon, lat, height, _, sd_h, sd_v, v_n, v_e, v_d, _, _, sd_speed, _, _, flags3,
    ) = _PVT.unpack_from(payload)  # fmt: skip
    if valid & (_DATE | _TIME) == _DATE | _TIME:
        at_ns = _utc((year, month, day), (hour, minute, second), nano)
        epoch.time(3, at_ns, bool(valid & _RESOLVED))
    epoch.status(fix, flags, flags >> 6, 3)
    epoch.position_valid = not flags3 & 1
    epoch.satellites = satellites
    where = (lat * _DEG_1E7, lon * _DEG_1E7, height * 1e-3)
    epoch.place(3, where, sd_h * 1e-3, sd_v * 1e-3)
    epoch.velocity(3, (v_n * 1e-3, v_e * 1e-3, v_d * 1e-3), sd_speed * 1e-3)


def _posllh(epoch: NavEpoch, payload: bytes) -> None:
    _, lon, lat, height, _, sd_h, sd_v = _POSLLH.unpack_from(payload)
    epoch.place(2, (lat * _DEG_1E7, lon * _DEG_1E7, height * 1e-3), sd_h * 1e-3, sd_v * 1e-3)


def _hpposllh(epoch: NavEpoch, payload: bytes) -> None:
    _, flags, _, lon, lat, height, _, hp_lon, hp_lat, hp_height, _, sd_h, sd_v = (
        _HPPOSLLH.unpack_from(payload)
    )
    if flags & 1:
        epoch.position_valid = False
        return
    where = (
        (lat + 0.01 * hp_lat) * _DEG_1E7,
        (lon + 0.01 * hp_lon) * _DEG_1E7,
        (height + 0.1 * hp_height) * 1e-3,
    )
    epoch.place(4, where, sd_h * 1e-4, sd_v * 1e-4)


def _velned(epoch: NavEpoch, payload: bytes) -> None:
    _, v_n, v_e, v_d, _, _, _, sd_speed, _ = _VELNED.unpack_from(payload)
    epoch.velocity(2, (v_n * 1e-2, v_e * 1e-2, v_d * 1e-2), sd_speed * 1e-2)


def _sol(epoch: NavEpoch, payload: bytes) -> None:
    (
        itow, fraction, week, fix, flags, x, y, z, sd_p, v_x, v_y, v_z, sd_speed, _, _, number,
    ) = _SOL.unpack_from(payload)  # fmt: skip
    if flags & 12 == 12:
        tow_s = itow * 1e-3 + fraction * 1e-9
        epoch.time(1, utc_ns(week, tow_s, leap_seconds(week, tow_s)), True)
    epoch.status(fix, flags, 0, 1)
    epoch.satellites = number if epoch.satellites is None else epoch.satellites
    if x == y == 0:
        return
    lat, lon, height = geodetic(x * 1e-2, y * 1e-2, z * 1e-2)
    spread = sd_p * 1e-2 * _EVEN_3
    epoch.place(1, (lat, lon, height), spread / _EVEN_2, spread)
    v = north_east_down((v_x * 1e-2, v_y * 1e-2, v_z * 1e-2), lat, lon)
    epoch.velocity(1, v, sd_speed * 1e-2)


def _posecef(epoch: NavEpoch, payload: bytes) -> None:
    _, x, y, z, sd_p = _ECEF.unpack_from(payload)
    if x == y == 0:
        return
    spread = sd_p * 1e-2 * _EVEN_3
    epoch.place(1, geodetic(x * 1e-2, y * 1e-2, z * 1e-2), spread / _EVEN_2, spread)


def _velecef(epoch: NavEpoch, payload: bytes) -> None:
    _, x, y, z, sd = _ECEF.unpack_from(payload)
    epoch.v_ecef_m_s = (x * 1e-2, y * 1e-2, z * 1e-2), sd * 1e-2


def _status(epoch: NavEpoch, payload: bytes) -> None:
    _, fix, flags, _, more, _, _ = _STATUS.unpack_from(payload)
    epoch.status(fix, flags, more >> 6, 2)


def _dop(epoch: NavEpoch, payload: bytes) -> None:
    _, _, _, _, vertical, horizontal, _, _ = _DOP.unpack_from(payload)
    if 0 < vertical < NO_DOP * 100:
        epoch.vdop = vertical * 0.01
    if 0 < horizontal < NO_DOP * 100:
        epoch.hdop = horizontal * 0.01


def _cov(epoch: NavEpoch, payload: bytes) -> None:
    _, _, position, velocity, *values = _COV.unpack_from(payload)
    if position:
        epoch.covariance_ned_m = _roots(values[0], values[3], values[5])
    if velocity:
        epoch.covariance_v_m_s = _roots(values[6], values[9], values[11])


def _roots(*variances: float) -> Vector3 | None:
    if not all(0.0 < v < math.inf for v in variances):
        return None
    n, e, d = map(math.sqrt, variances)
    return n, e, d


def _timegps(epoch: NavEpoch, payload: bytes) -> None:
    itow, fraction, week, leap, valid, _ = _TIMEGPS.unpack_from(payload)
    if valid & 3 == 3:
        tow_s = itow * 1e-3 + fraction * 1e-9
        known = bool(valid & 4)
        epoch.time(1, utc_ns(week, tow_s, leap if known else leap_seconds(week, tow_s)), known)


def _timeutc(epoch: NavEpoch, payload: bytes) -> None:
    _, _, nano, year, month, day, hour, minute, second, valid = _TIMEUTC.unpack_from(payload)
    if valid & 3 == 3:
        at_ns = _utc((year, month, day), (hour, minute, second), nano)
        epoch.time(2, at_ns, bool(valid & 4))


MESSAGES: dict[int, tuple[str, int, int, Callable[[NavEpoch, bytes], None]]] = {
    0x07: ("PVT", 84, 0, _pvt),
    0x02: ("POSLLH", _POSLLH.size, 0, _posllh),
    0x14: ("HPPOSLLH", _HPPOSLLH.size, 4, _hpposllh),
    0x12: ("VELNED", _VELNED.size, 0, _velned),
    0x06: ("SOL", 52, 0, _sol),
    0x01: ("POSECEF", _ECEF.size, 0, _posecef),
    0x11: ("VELECEF", _ECEF.size, 0, _velecef),
    0x03: ("STATUS", _STATUS.size, 0, _status),
    0x04: ("DOP", _DOP.size, 0, _dop),
    0x36: ("COV", _COV.size, 0, _cov),
    0x20: ("TIMEGPS", _TIMEGPS.size, 0, _timegps),
    0x21: ("TIMEUTC", _TIMEUTC.size, 0, _timeutc),
}
"""Messages by identifier: name, least length, offset of iTOW, and handler."""
END_OF_EPOCH = 0x61
RELPOSNED = 0x3C

_RELPOSNED = struct.Struct("<BxHIiiiii4xbbbbIIIII4xI")
_FIX_OK, _HEADING_VALID, _MOVING = 1, 1 << 8, 1 << 5


@dataclass(frozen=True, slots=True)
class Baseline:
    """UBX-NAV-RELPOSNED version 1: rad; `refusal` by counter where it is no heading."""

    itow_ms: int
    heading_rad: float
    sd_rad: float
    refusal: str | None


def parse_relposned(payload: bytes) -> Baseline | None:
    """Parse a baseline; None if the length is wrong, or for a version without heading.

    The baseline is a heading only from a moving base, and only with fixed ambiguities; the
    direction to a stationary base is none.
    """
    if len(payload) < _RELPOSNED.size or payload[0] < 1:
        return None
    values = _RELPOSNED.unpack_from(payload)
    itow, heading, accuracy, flags = values[2], values[7], values[16], values[17]
    refusal = None
    if not flags & _MOVING:
        refusal = "baseline_of_a_station"
    elif not (flags & _FIX_OK and flags & _HEADING_VALID):
        refusal = "heading_not_valid"
    elif flags >> 3 & 3 != 2:
        refusal = "heading_not_fixed"
    return Baseline(itow, math.radians(heading * 1e-5), math.radians(accuracy * 1e-5), refusal)
