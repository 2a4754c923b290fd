"""Simulated GNSS receiver with NMEA 0183: epochs of a true trajectory with errors, as bytes.

Each epoch's error is white noise plus a first-order Gauss-Markov part, in position and velocity;
GST states the sum of both. Sentences leave the receiver 50 to 200 ms after their epoch.
NMEA has no velocity down: `Fix` holds it (for files), the sentences do not.

Source: NMEA 0183 v4.11 sentence formats as the u-blox ZED-F9P interface manual prints them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from typing import Literal

import numpy as np

from fusiond.simulation.imu_truth import Truth, metres_to_geodetic
from fusiond.simulation.markov import gauss_markov

Vector3 = tuple[float, float, float]
Talker = Literal["GP", "GN", "BD", "GB"]
KNOT_M_S = 1852.0 / 3600.0
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_SYSTEM_ID = {"GP": 1, "GN": 1, "BD": 4, "GB": 4}
_MODE = {1: "A", 2: "D", 4: "R", 5: "F"}


@dataclass(frozen=True, slots=True)
class GnssOptions:
    """One sigma of each axis' error; sd pairs are (horizontal, vertical).

    Errors are white by default, as filters assume; `correlated_sd_m` adds correlated ones, as a
    single receiver has.
    """

    rate_hz: float = 10.0
    talker: Talker = "GN"
    sentences: tuple[str, ...] = ("GGA", "RMC", "VTG", "GSA", "GST", "ZDA")
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    white_sd_m: tuple[float, float] = (0.8, 1.5)
    correlated_sd_m: tuple[float, float] = (0.0, 0.0)
    correlation_s: float = 300.0
    velocity_sd_m_s: tuple[float, float] = (0.05, 0.1)
    heading_sd_deg: float = 0.3
    latency_s: tuple[float, float] = (0.05, 0.2)
    outages: tuple[tuple[float, float], ...] = ()
    """Times without a fix: (start, length) in s of the trajectory."""
    quality: int = 1
    satellites: int = 14
    hdop: float = 0.8
    vdop: float = 1.2
    geoid_separation_m: float = -14.0


@dataclass(frozen=True, slots=True)
class GnssFix:
    """Epoch: validity and arrival (s of the trajectory), degrees, m, m/s; NED sigmas."""

    t_s: float
    t_arrival_s: float
    valid: bool
    lat_deg: float
    lon_deg: float
    height_m: float
    v_ned_m_s: Vector3
    heading_deg: float


class GnssReceiver:
    """Receiver whose epochs over a whole trajectory are drawn at construction from `rng`."""

    def __init__(self, truth: Truth, options: GnssOptions, rng: np.random.Generator) -> None:
        o = self.options = options
        n = int(truth.duration_s * o.rate_hz + 1e-9)
        self.t_s = np.arange(1, n + 1) / o.rate_hz
        states = truth.at(self.t_s, o.lever_arm_m)
        axes = np.array([0, 0, 1])
        step = 1.0 / o.rate_hz
        error = rng.standard_normal((n, 3)) * np.array(o.white_sd_m)[axes]
        drift = gauss_markov(rng, (n, 3), step_s=step, correlation_s=o.correlation_s, sigma=1.0)
        error += drift * np.array(o.correlated_sd_m)[axes]
        self.position = states.position + metres_to_geodetic(
            states.position[:, 0], states.position[:, 2], error
        )
        self.v_ned = (
            states.v_ned + rng.standard_normal((n, 3)) * (np.array(o.velocity_sd_m_s)[axes])
        )
        self.heading_deg = np.degrees(states.rpy[:, 2]) % 360.0
        self.heading_deg += rng.standard_normal(n) * o.heading_sd_deg
        # A serial line keeps the order of epochs.
        self.t_arrival_s = np.maximum.accumulate(self.t_s + rng.uniform(*o.latency_s, n))
        self.valid = np.ones(n, dtype=bool)
        for start, length in o.outages:
            self.valid &= (self.t_s < start) | (self.t_s >= start + length)

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def sd_ned_m(self) -> Vector3:
        """One sigma of a fix, north, east, down, as stated by GST."""
        o = self.options
        h = math.hypot(o.white_sd_m[0], o.correlated_sd_m[0])
        return h, h, math.hypot(o.white_sd_m[1], o.correlated_sd_m[1])

    @property
    def sd_v_ned_m_s(self) -> Vector3:
        """One sigma of a velocity, north, east, down."""
        h, v = self.options.velocity_sd_m_s
        return h, h, v

    def fix(self, k: int) -> GnssFix:
        """Fix of epoch number `k`, from 0."""
        lat, lon, height = (float(x) for x in self.position[k])
        north, east, down = (float(x) for x in self.v_ned[k])
        return GnssFix(
            t_s=float(self.t_s[k]),
            t_arrival_s=float(self.t_arrival_s[k]),
            valid=bool(self.valid[k]),
            lat_deg=math.degrees(lat),
            lon_deg=math.degrees(lon),
            height_m=height,
            v_ned_m_s=(north, east, down),
            heading_deg=float(self.heading_deg[k]) % 360.0,
        )

    def nmea(self, k: int, utc_start_ns: int) -> bytes:
        """Sentences of epoch `k`; `utc_start_ns` is UTC (POSIX ns) at the trajectory's 0."""
        fix = self.fix(k)
        # Receivers print the UTC of their epoch to a hundredth: carry the rounding into the date.
        hundredths = round((utc_start_ns + fix.t_s * 1e9) / 1e7)
        utc = _EPOCH + timedelta(milliseconds=10 * hundredths)
        lines = (sentence(self._fields(name, fix, utc)) for name in self.options.sentences)
        return b"".join(lines)

    def _fields(self, name: str, fix: GnssFix, utc: datetime) -> Iterable[str]:
        o = self.options
        clock = f"{utc:%H%M%S}.{utc.microsecond // 10000:02d}"
        head = o.talker + name
        ok = fix.valid
        lat, lon = latitude(fix.lat_deg), longitude(fix.lon_deg)
        where = (*lat, *lon) if ok else ("", "", "", "")
        north, east, _ = fix.v_ned_m_s
        speed = math.hypot(north, east)
        # Printed at any speed: leaving it out below a limit would pick velocities by their error.
        course = f"{math.degrees(math.atan2(east, north)) % 360.0:.3f}"
        mode = _MODE.get(o.quality, "A") if ok else "N"
        system = f"{_SYSTEM_ID[o.talker]:X}"
        match name:
            case "GGA":
                altitude = fix.height_m - o.geoid_separation_m
                tail = (f"{altitude:.3f}", "M", f"{o.geoid_separation_m:.3f}", "M", "", "")
                if not ok:
                    return head, clock, *where, "0", "00", "99.99", "", "", "", "", "", ""
                return head, clock, *where, str(o.quality), str(o.satellites), f"{o.hdop}", *tail
            case "RMC":
                motion = (f"{speed / KNOT_M_S:.4f}", course) if ok else ("", "")
                status = "A" if ok else "V"
                return head, clock, status, *where, *motion, f"{utc:%d%m%y}", "", "", mode, "V"
            case "VTG":
                knots, kmh = (f"{speed / KNOT_M_S:.4f}", f"{speed * 3.6:.4f}") if ok else ("", "")
                return head, course if ok else "", "T", "", "M", knots, "N", kmh, "K", mode
            case "GSA":
                used = [f"{i + 1:02d}" for i in range(min(12, o.satellites))] if ok else []
                ids = (used + [""] * 12)[:12]
                pdop = math.hypot(o.hdop, o.vdop)
                dops = (f"{pdop:.2f}", f"{o.hdop:.2f}", f"{o.vdop:.2f}") if ok else ("99.99",) * 3
                return head, "A", "3" if ok else "1", *ids, *dops, system
            case "GST":
                sd = [f"{x:.3f}" for x in self.sd_ned_m] if ok else ["", "", ""]
                ellipse = (f"{o.white_sd_m[0]:.3f}", sd[1], sd[0], "0.0") if ok else ("",) * 4
                return head, clock, *ellipse, *sd
            case "ZDA":
                return head, clock, f"{utc:%d}", f"{utc:%m}", f"{utc:%Y}", "00", "00"
            case "HDT":
                return head, f"{fix.heading_deg:.3f}" if ok else "", "T"
            case "THS":
                return head, f"{fix.heading_deg:.3f}" if ok else "", "A" if ok else "V"
        raise ValueError(f"no NMEA sentence {name} here")


def sentence(fields: Iterable[str]) -> bytes:
    """Format `$fields*checksum` with the XOR of the characters between `$` and `*`."""
    body = ",".join(fields).encode("ascii")
    return b"$%s*%02X\r\n" % (body, reduce(xor, body))


def _minutes(degrees: float, width: int) -> str:
    """Format ddmm.mmmmmmm: seven decimals are 0.2 mm; rounding carries into the degrees."""
    units = round(abs(degrees) * 600_000_000)
    whole, rest = divmod(units, 600_000_000)
    return f"{whole:0{width}d}{rest // 10_000_000:02d}.{rest % 10_000_000:07d}"


def latitude(degrees: float) -> tuple[str, str]:
    """NMEA latitude and hemisphere."""
    return _minutes(degrees, 2), "N" if degrees >= 0 else "S"


def longitude(degrees: float) -> tuple[str, str]:
    """NMEA longitude and hemisphere."""
    degrees = (degrees + 180.0) % 360.0 - 180.0
    return _minutes(degrees, 3), "E" if degrees >= 0 else "W"
