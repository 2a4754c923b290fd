"""Message `fleet/<card>`: position of another vehicle, by its own report or by the centre."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from drivers.rdss.mail import FleetFix
from drivers.rdss.position_report_coding import PositionReport
from fusiond.navigation.solution import Mode
from fusiond.outputs.messages.base import HalfTurn, Message, Milliseconds, Number, QuarterTurn, Turn
from fusiond.outputs.messages.base import stamp as stamped
from fusiond.outputs.messages.short_message import Card


class FleetMessage(Message):
    """WGS 84, one sigma each; the time is that of the position. Unknown values are null."""

    card: Card
    source: str = Field(description="the terminal that received it")
    by: Literal["report", "centre"] = Field(
        description="`report`: its own solution; `centre`: a fix that the centre passed on"
    )
    received_ms: Milliseconds | None = Field(description="arrival, POSIX milliseconds, UTC")
    mode: Mode | None
    lat_deg: QuarterTurn
    lon_deg: HalfTurn
    height_m: Number = Field(description="above the ellipsoid")
    sd_n_m: Number
    sd_e_m: Number
    sd_d_m: Number
    speed_m_s: Number = Field(description="over ground")
    course_deg: Turn = Field(description="true, clockwise from north")


def of_report(
    report: PositionReport, card: int, source: str, t_utc_ns: int | None, seen_utc_ns: int | None
) -> FleetMessage:
    """Build `fleet` of a vehicle's own report, valid at `t_utc_ns`; 1e-7 deg is 1 cm."""
    t_utc, t_ms = stamped(t_utc_ns)
    north, east, down = (_figure(sd) for sd in report.sd_ned_m)
    height, speed, course = report.height_m, report.speed_m_s, report.course_deg
    return FleetMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        card=card,
        source=source,
        by="report",
        received_ms=stamped(seen_utc_ns)[1],
        mode=Mode(report.mode),
        lat_deg=round(report.lat_deg, 7),
        lon_deg=round(report.lon_deg, 7),
        height_m=None if height is None else round(height, 1),
        sd_n_m=north,
        sd_e_m=east,
        sd_d_m=down,
        speed_m_s=None if speed is None else round(speed, 2),
        course_deg=None if course is None else round(course, 2) % 360.0,
    )


def of_centre(fix: FleetFix, seen_utc_ns: int | None) -> FleetMessage:
    """Build `fleet` of a fix from the centre, at its arrival: the fix's own time of day lacks zone
    and date."""
    t_utc, t_ms = stamped(seen_utc_ns)
    return FleetMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        card=fix.card,
        source=fix.source,
        by="centre",
        received_ms=t_ms,
        mode=None,
        lat_deg=round(fix.lat_deg, 7),
        lon_deg=round(fix.lon_deg, 7),
        height_m=round(fix.height_m, 1),
        sd_n_m=fix.precision_class_m,
        sd_e_m=fix.precision_class_m,
        sd_d_m=None,
        speed_m_s=None,
        course_deg=None,
    )


def _figure(sd_m: float | None) -> float | None:
    return None if sd_m is None else round(sd_m, 2)
