"""Reports in gpsd's protocol, built from the daemon's messages; no I/O.

Units m, m/s, degrees; `climb` up, `velD` down; the errors of TPV at 95 %, those of GST one sigma.
Unknown values are left out, since the protocol has neither null nor NaN. TPV has only fields of
gpsd 3.22, whose library discards a report with any other.

Source: gpsd_json(5) of gpsd 3.22; the order of keys is gpsd's own.
"""

from __future__ import annotations

import json
from math import isfinite
from typing import Any

from fusiond.navigation.solution import Mode
from fusiond.outputs.derived_figures import TWO_SIDED_95, horizontal_rms_m, known, motion, usable
from fusiond.outputs.geoid import sea_height
from fusiond.outputs.messages.health import SatelliteHealth, SkyHealth
from fusiond.outputs.messages.nav import NavMessage

PROTOCOL = (3, 14)
"""Protocol version of gpsd 3.22."""
_STATUS = {Mode.NAVIGATING: 6, Mode.COASTING: 5}
"""Status codes STATUS_GNSSDR (satellites and dead reckoning) and STATUS_DR (dead reckoning)."""
_SYSTEMS = {"G": (0, 0), "E": (2, 300), "C": (3, 400)}
"""gnssid of u-blox, and where gpsd's own numbers start: GPS 1, Galileo 301, BeiDou 401."""
_NO_FIX, _FIX_2D, _FIX_3D = 1, 2, 3

Report = dict[str, Any]


def encoded(report: Report) -> bytes:
    """Encode a report as a line without spaces: cgps reads `"mode": 3` as no fix."""
    text = json.dumps(known_only(report), separators=(",", ":"), allow_nan=False)
    return text.encode() + b"\r\n"


def known_only(report: Report) -> Report:
    """Report without the keys whose value is unknown."""

    def stands(value: Any) -> bool:
        return value is not None and not (isinstance(value, float) and not isfinite(value))

    return {key: value for key, value in report.items() if stands(value)}


def version(release: str) -> Report:
    return {
        "class": "VERSION",
        "release": "3.22",
        "rev": f"fusiond-{release}",
        "proto_major": PROTOCOL[0],
        "proto_minor": PROTOCOL[1],
    }


def device(path: str, activated: str | None) -> Report:
    """Report DEVICE of the only device; `activated` is its start in UTC."""
    report = {"class": "DEVICE", "path": path, "driver": "fusiond", "activated": activated}
    return known_only(report)


def error(text: str) -> Report:
    return {"class": "ERROR", "message": text}


def tpv(path: str, nav: NavMessage, geoid_separation_m: float | None) -> Report:
    """Report TPV: time, position, velocity."""
    head = {"class": "TPV", "device": path}
    if not usable(nav):
        return head | {"mode": _NO_FIX, "time": nav.t_utc}
    height = known(nav.height_m)
    known_height = height is not None and known(nav.sd_d_m) is not None
    above_sea = sea_height(nav, geoid_separation_m)
    msl = None if above_sea is None else round(above_sea.above_sea_m, 4)
    rms = horizontal_rms_m(nav)
    report = head | {
        "status": _STATUS[nav.mode],
        "mode": _FIX_3D if known_height else _FIX_2D,
        "time": nav.t_utc,
        "lat": nav.lat_deg,
        "lon": nav.lon_deg,
        "altHAE": height if known_height else None,
        "altMSL": msl,
        "alt": msl,
        "epx": _at_95(nav.sd_e_m),
        "epy": _at_95(nav.sd_n_m),
        "epv": _at_95(nav.sd_d_m),
        "eph": None if rms is None else round(2.0 * rms, 3),
    }
    moving = motion(nav)
    if moving is not None:
        down = known(nav.v_d_m_s)
        report |= {
            "track": None if moving.course_deg is None else round(moving.course_deg, 4),
            "speed": round(moving.speed_m_s, 4),
            "climb": None if down is None else -down,
            "eps": round(moving.speed_error_m_s, 3),
            "epc": _at_95(nav.sd_vd_m_s),
            "epd": round(moving.course_error_deg, 4),
            "velN": nav.v_n_m_s,
            "velE": nav.v_e_m_s,
            "velD": nav.v_d_m_s,
        }
    return report


def att(path: str, nav: NavMessage) -> Report | None:
    """Report ATT: attitude; None while unknown."""
    if not usable(nav) or known(nav.yaw_deg) is None:
        return None
    return {
        "class": "ATT",
        "device": path,
        "time": nav.t_utc,
        "heading": nav.yaw_deg,
        "pitch": nav.pitch_deg,
        "roll": nav.roll_deg,
        "yaw": nav.yaw_deg,
    }


def gst(path: str, nav: NavMessage) -> Report | None:
    """Report GST: one sigma of position and velocity; None without a position."""
    if not usable(nav):
        return None
    return {
        "class": "GST",
        "device": path,
        "time": nav.t_utc,
        "lat": nav.sd_n_m,
        "lon": nav.sd_e_m,
        "alt": nav.sd_d_m,
        "ve": nav.sd_ve_m_s,
        "vn": nav.sd_vn_m_s,
        "vu": nav.sd_vd_m_s,
    }


def sky(path: str, t_utc: str | None, seen: SkyHealth) -> Report:
    """Report SKY: satellites of the last raw epoch; refused ones are marked unused."""
    satellites = [_satellite(name, seen) for name in (*seen.used, *seen.refused)]
    return {
        "class": "SKY",
        "device": path,
        "time": t_utc,
        "gdop": seen.gdop,
        "hdop": seen.hdop,
        "pdop": seen.pdop,
        "tdop": seen.tdop,
        "vdop": seen.vdop,
        "nSat": len(satellites),
        "uSat": len(seen.used),
        "satellites": satellites,
    }


def _satellite(name: str, sky: SkyHealth) -> Report:
    number = int(name[1:])
    gnssid, first = _SYSTEMS[name[0]]
    seen = sky.satellites.get(name, SatelliteHealth())
    report = {
        "PRN": first + number,
        "el": seen.elevation_deg,
        "az": seen.azimuth_deg,
        "ss": seen.cno_db_hz,
        "used": name in sky.used,
        "gnssid": gnssid,
        "svid": number,
    }
    return known_only(report)


def _at_95(sd: float | None) -> float | None:
    value = known(sd)
    return None if value is None else round(TWO_SIDED_95 * value, 3)
