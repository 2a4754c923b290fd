"""Section `[alignment]`: where attitude and position come from before navigation starts."""

from __future__ import annotations

from typing import Literal

from pydantic import PositiveFloat, model_validator

from fusiond.configuration.aiding import Section, Vector


class Alignment(Section):
    """Alignment: sources of attitude and position before navigation starts.

    `heading` lists the allowed sources of the first heading in order of preference.
    """

    heading: tuple[
        Literal[
            "saved",
            "config",
            "dual_antenna",
            "compass",
            "gyrocompass",
            "gnss_course",
            "positions",
        ],
        ...,
    ] = ("saved", "dual_antenna", "gyrocompass", "gnss_course", "positions")
    """Allowed sources of the first heading, in order of preference."""
    heading_deg: float | None = None
    """True heading at the start, for `config`."""
    heading_sd_deg: PositiveFloat = 5.0
    """One sigma of `heading_deg`."""
    position_deg_m: Vector | None = None
    """Latitude, longitude, height of the start, if no device gives a position."""
    position_sd_m: PositiveFloat = 100.0
    """One sigma of the position."""
    levelling_s: PositiveFloat = 2.0
    """Rest needed to level by gravity."""
    course_speed_m_s: PositiveFloat = 3.0
    """Least speed at which the GNSS course is taken as the heading."""
    course_sd_deg: PositiveFloat = 5.0
    """One sigma of that heading (side slip, mounting)."""
    gyrocompass_s: PositiveFloat = 120.0
    """Rest needed to gyrocompass."""
    gyrocompass_max_sd_deg: PositiveFloat = 5.0
    """Gyrocompassing is used only if bias and noise allow a smaller heading sigma."""
    saved_max_age_s: PositiveFloat = 86400.0
    """A saved state older than this is not used."""

    @model_validator(mode="after")
    def _heading_given(self) -> Alignment:
        if "config" in self.heading and self.heading_deg is None:
            raise ValueError("heading lists 'config': set heading_deg too")
        return self
