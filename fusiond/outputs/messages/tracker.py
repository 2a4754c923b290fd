"""Message `tracker`: the vehicle's position at intervals, in Home Assistant's terms."""

from __future__ import annotations

from pydantic import Field

from fusiond.outputs.derived_figures import horizontal_rms_m, usable
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.nav import NavMessage


class TrackerMessage(Message):
    """A position that may be used: WGS 84, degrees."""

    latitude: float
    longitude: float
    gps_accuracy: float = Field(
        description="m: root of the sum of both variances, about 65 % of errors are smaller"
    )


def tracker_message(nav: NavMessage) -> TrackerMessage | None:
    """Build `tracker` of a solution; None if the solution may not be used."""
    accuracy_m = horizontal_rms_m(nav)
    if not usable(nav) or accuracy_m is None or nav.lat_deg is None or nav.lon_deg is None:
        return None
    return TrackerMessage(
        t_utc=nav.t_utc,
        t_ms=nav.t_ms,
        latitude=round(nav.lat_deg, 7),
        longitude=round(nav.lon_deg, 7),
        gps_accuracy=round(accuracy_m, 2),
    )
