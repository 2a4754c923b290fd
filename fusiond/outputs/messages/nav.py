"""Message `nav`: the solution with its sigma."""

from __future__ import annotations

from math import degrees

from pydantic import Field

from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.messages.base import HalfTurn, Message, Number, QuarterTurn, Turn, stamp


class NavMessage(Message):
    """The solution of the body origin: WGS 84, north-east-down, one sigma each."""

    mode: Mode
    lat_deg: QuarterTurn
    lon_deg: HalfTurn
    height_m: Number = Field(description="above the ellipsoid")
    v_n_m_s: Number
    v_e_m_s: Number
    v_d_m_s: Number
    roll_deg: HalfTurn
    pitch_deg: QuarterTurn
    yaw_deg: Turn = Field(description="true heading, 0 to 360, clockwise from north")
    sd_n_m: Number
    sd_e_m: Number
    sd_d_m: Number
    sd_vn_m_s: Number
    sd_ve_m_s: Number
    sd_vd_m_s: Number
    sd_roll_deg: Number
    sd_pitch_deg: Number
    sd_yaw_deg: Number
    protection_horizontal_m: Number = Field(
        description="bound of the horizontal error at the configured integrity risk"
    )
    protection_vertical_m: Number = Field(description="bound of the vertical error")


def nav_message(solution: Solution, utc_ns: int | None) -> NavMessage:
    """Build `nav` of a solution valid at `utc_ns`; 1e-9 deg is 0.1 mm."""
    t_utc, t_ms = stamp(utc_ns)
    s = solution
    return NavMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        mode=s.mode,
        lat_deg=round(degrees(s.lat_rad), 9),
        lon_deg=round(degrees(s.lon_rad), 9),
        height_m=round(s.height_m, 4),
        v_n_m_s=round(s.v_ned_m_s[0], 4),
        v_e_m_s=round(s.v_ned_m_s[1], 4),
        v_d_m_s=round(s.v_ned_m_s[2], 4),
        roll_deg=round(degrees(s.rpy_rad[0]), 5),
        pitch_deg=round(degrees(s.rpy_rad[1]), 5),
        yaw_deg=round(degrees(s.rpy_rad[2]), 5) % 360.0,
        sd_n_m=round(s.sd_ned_m[0], 4),
        sd_e_m=round(s.sd_ned_m[1], 4),
        sd_d_m=round(s.sd_ned_m[2], 4),
        sd_vn_m_s=round(s.sd_v_ned_m_s[0], 4),
        sd_ve_m_s=round(s.sd_v_ned_m_s[1], 4),
        sd_vd_m_s=round(s.sd_v_ned_m_s[2], 4),
        sd_roll_deg=round(degrees(s.sd_rpy_rad[0]), 5),
        sd_pitch_deg=round(degrees(s.sd_rpy_rad[1]), 5),
        sd_yaw_deg=round(degrees(s.sd_rpy_rad[2]), 5),
        protection_horizontal_m=round(s.bound.hpl_m, 3),
        protection_vertical_m=round(s.bound.vpl_m, 3),
    )
