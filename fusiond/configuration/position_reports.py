"""`[position_reports]`: position reports by RDSS short message."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, PositiveFloat, model_validator

from fusiond.configuration.aiding import Section

EventCode = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]


class PositionReports(Section):
    """Reports of the solution to another card; see `docs/rdss-messages.md`."""

    card: Annotated[int, Field(ge=1, le=9_999_999)] | None = None
    """Card that the reports go to; without one none are sent."""
    source: str | None = None
    """Terminal that sends them, if there are several."""
    interval_s: PositiveFloat | None = None
    """Interval of the reports, if the card's turns allow it; a newer report replaces a waiting
    one."""
    events: tuple[EventCode, ...] = ()
    """Codes of events that send a report at once."""

    @model_validator(mode="after")
    def _when(self) -> PositionReports:
        if self.card is not None and self.interval_s is None and not self.events:
            raise ValueError("position_reports.card needs interval_s, events or both")
        return self
