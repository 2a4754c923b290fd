"""Coding of a position report: the solution in the few bits of a short message.

    report (kind 1)                                    short report (kind 2)
     0  4  time, POSIX s                                0  3  latitude, 90 deg / 2^23, signed
     4  1  its fraction, 1/256 s                        3  3  longitude, 180 deg / 2^23, signed
     5  4  latitude, 90 deg / 2^31, signed              6  3  mode (3 bits), sigma of the place
     9  4  longitude, 180 deg / 2^31, signed                  (4 bits), second of the day, UTC
    13  3  height + 1000 m, 0.1 m                             (17 bits)
    16  1  mode
    17  3  sigma north, east, down
    20  2  speed, 0.01 m/s
    22  2  course, 360 deg / 2^16

All numbers are big-endian. The full report resolves 4.7 mm of latitude, 9.3 mm of longitude and 4
ms. The short one, for a card of level 1, resolves 1.2 m, 2.4 m and 1 s, without date, height and
velocity.

A sigma is sent as the exponent k: 0.01 m 2^(k/12) in the full report (to 22 km, in steps of 6 %), 1
m 2^k in the short one (to 8 km). It is rounded up, so that no report claims more than its solution;
the last step means unknown. Height, speed and course are unknown with all bits of their field set.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

MODES = ("waiting", "aligning", "navigating", "coasting", "invalid")
"""Modes by number, as in `fusiond.navigation.solution.Mode`."""
REPORT, SHORT_REPORT = 1, 2
FULL = struct.Struct(">IBii3sB3sHH")
SHORT = struct.Struct(">3s3s3s")
DAY_S = 86400
LEAST_HEIGHT_M, HEIGHT_STEP_M = -1000.0, 0.1
SPEED_STEP_M_S = 0.01
UNKNOWN_24, UNKNOWN_16 = 0xFFFFFF, 0xFFFF
FULL_SIGMAS, SHORT_SIGMAS = 255, 14
"""Steps of sigma with a value; the next step means unknown."""


class PositionReport(NamedTuple):
    """Position report of a vehicle by its own solution; degrees, metres, one sigma. None: unknown.

    `t_s` is POSIX; of a short report, which has no date, the second of its day (`dated` is False).
    `sd_ned_m` of a short report is one figure for north and east.
    """

    t_s: float
    lat_deg: float
    lon_deg: float
    mode: str
    sd_ned_m: tuple[float | None, float | None, float | None] = (None, None, None)
    height_m: float | None = None
    speed_m_s: float | None = None
    course_deg: float | None = None
    dated: bool = True


def encode_report(report: PositionReport) -> bytes:
    """Body of a full report. Raises ValueError for an invalid position."""
    _check(report)
    whole = math.floor(report.t_s)
    height, speed, course = report.height_m, report.speed_m_s, report.course_deg
    steps = UNKNOWN_24 if height is None else (height - LEAST_HEIGHT_M) / HEIGHT_STEP_M
    return FULL.pack(
        whole,
        min(255, math.floor((report.t_s - whole) * 256)),
        _angle(report.lat_deg, 90.0, 31),
        _angle(report.lon_deg, 180.0, 31),
        _clipped(steps, UNKNOWN_24).to_bytes(3, "big"),
        MODES.index(report.mode),
        bytes(_sigma_step(sd, 0.01, 12, FULL_SIGMAS) for sd in report.sd_ned_m),
        UNKNOWN_16 if speed is None else _clipped(speed / SPEED_STEP_M_S, UNKNOWN_16 - 1),
        UNKNOWN_16 if course is None else _course(course),
    )


def encode_short(report: PositionReport) -> bytes:
    """Body of a short report. Raises ValueError for an invalid position."""
    _check(report)
    north, east = report.sd_ned_m[:2]
    sd = None if north is None or east is None else max(north, east)
    packed = MODES.index(report.mode) << 21 | _sigma_step(sd, 1.0, 1, SHORT_SIGMAS) << 17
    packed |= math.floor(report.t_s) % DAY_S
    return SHORT.pack(
        _angle(report.lat_deg, 90.0, 23).to_bytes(3, "big", signed=True),
        _angle(report.lon_deg, 180.0, 23).to_bytes(3, "big", signed=True),
        packed.to_bytes(3, "big"),
    )


def decode_report(kind: int, body: bytes) -> PositionReport:
    """Report from a body of this kind. ValueError for an invalid one."""
    return _decode_full(body) if kind == REPORT else _decode_short(body)


def _decode_full(body: bytes) -> PositionReport:
    whole, part, lat, lon, height, mode, sigmas, speed, course = FULL.unpack(body)
    steps = int.from_bytes(height, "big")
    north, east, down = (_sigma(k, 0.01, 12, FULL_SIGMAS) for k in sigmas)
    return PositionReport(
        t_s=whole + part / 256,
        lat_deg=lat * 90.0 / 2**31,
        lon_deg=lon * 180.0 / 2**31,
        mode=_mode(mode),
        sd_ned_m=(north, east, down),
        height_m=None if steps == UNKNOWN_24 else LEAST_HEIGHT_M + steps * HEIGHT_STEP_M,
        speed_m_s=None if speed == UNKNOWN_16 else speed * SPEED_STEP_M_S,
        course_deg=None if course == UNKNOWN_16 else course * 360.0 / 2**16,
    )


def _decode_short(body: bytes) -> PositionReport:
    lat, lon, packed = SHORT.unpack(body)
    rest = int.from_bytes(packed, "big")
    second = rest & 0x1FFFF
    if second >= DAY_S:
        raise ValueError(f"second {second} of a day")
    sd = _sigma(rest >> 17 & 0xF, 1.0, 1, SHORT_SIGMAS)
    return PositionReport(
        t_s=float(second),
        lat_deg=int.from_bytes(lat, "big", signed=True) * 90.0 / 2**23,
        lon_deg=int.from_bytes(lon, "big", signed=True) * 180.0 / 2**23,
        mode=_mode(rest >> 21),
        sd_ned_m=(sd, sd, None),
        dated=False,
    )


def _check(report: PositionReport) -> None:
    if not (abs(report.lat_deg) <= 90.0 and abs(report.lon_deg) <= 180.0):
        raise ValueError(f"{report.lat_deg}, {report.lon_deg} is no place")
    if not 0.0 <= report.t_s < 2**32:
        raise ValueError(f"{report.t_s} s is no time of a report")


def _mode(number: int) -> str:
    if number >= len(MODES):
        raise ValueError(f"mode {number}")
    return MODES[number]


def _angle(value_deg: float, greatest_deg: float, bits: int) -> int:
    steps: int = 1 << bits
    return min(round(value_deg / greatest_deg * steps), steps - 1)


def _clipped(steps: float, greatest: int) -> int:
    return min(max(round(steps), 0), greatest)


def _course(course_deg: float) -> int:
    """Encode a course: within half a step of 360 deg it is 0, since the last step means unknown."""
    step = round(course_deg / 360.0 * 2**16) % 2**16
    return step if step != UNKNOWN_16 else 0


def _sigma_step(sd_m: float | None, least_m: float, an_octave: int, steps: int) -> int:
    if sd_m is None or not sd_m >= 0.0:
        return steps
    # A decoded step must encode to itself.
    k = math.ceil(an_octave * math.log2(max(sd_m / least_m, 1.0)) - 1e-9)
    return min(k, steps)


def _sigma(step: int, least_m: float, an_octave: int, steps: int) -> float | None:
    return None if step >= steps else least_m * 2.0 ** (step / an_octave)
