"""`[recording]`: contents and place of logs (docs/recording.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat

from fusiond.configuration.aiding import Section


class Recording(Section):
    """Logs of all inputs and results, for `fusiond replay` and other tools."""

    directory: Path | None = None
    """Directory of the logs; without it only `fusiond run --record DIR` records."""
    when: Literal["always", "event", "command"] = "always"
    """`always`: from the start; `event`: from one of `events` on, with the time before it;
    `command`: by `cmd/start_recording`, which always works."""
    split_mb: Annotated[float, Field(ge=1.0)] = 256.0
    """Size (10^6 bytes) at which the next file begins."""
    split_min: PositiveFloat = 60.0
    """Age at which the next file begins."""
    keep_mb: PositiveFloat = 8192.0
    """Most MB of this vehicle's logs in the directory: the oldest are deleted."""
    min_free_mb: NonNegativeFloat = 100.0
    """Least free space on the disk; with less the recording stops."""
    before_s: Annotated[float, Field(ge=0.0, le=600.0)] = 60.0
    """With `when = "event"`: time before the event in the log; it is kept in memory."""
    after_s: Annotated[float, Field(ge=1.0)] = 60.0
    """With `when = "event"`: time after the last event in the log."""
    events: tuple[str, ...] = (
        "mode_invalid",
        "diverged",
        "filter_not_finite",
        "driver_fault",
        "protection_level",
    )
    """Codes of events, or parts of codes, that start a recording."""
