"""`[recording]`: what is kept of a drive, and where (docs/recording.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat

from fusiond.configuration.aiding import Section


class Recording(Section):
    """Logs of all that came in and what came of it, for `fusiond replay` and other tools."""

    directory: Path | None = None
    """Directory of the logs; without it only `fusiond run --record DIR` records."""
    when: Literal["always", "event", "command"] = "always"
    """`always` from the start on; `event`: when one of `events` comes, with the time before it;
    `command`: when `cmd/start_recording` says so, which works in any case."""
    split_mb: Annotated[float, Field(ge=1.0)] = 256.0
    """A file larger than this is closed and the next begun; 10^6 bytes."""
    split_min: PositiveFloat = 60.0
    """Files older than this are deleted, too."""
    keep_mb: PositiveFloat = 8192.0
    """Of this vehicle's logs in the directory the newest this many MB are kept."""
    min_free_mb: NonNegativeFloat = 100.0
    """With less than this left on the disk the recording stops."""
    before_s: Annotated[float, Field(ge=0.0, le=600.0)] = 60.0
    """With `when = "event"`: how much from before the event is kept; it waits in memory."""
    after_s: Annotated[float, Field(ge=1.0)] = 60.0
    """And how long recording goes on after the last of them."""
    events: tuple[str, ...] = (
        "mode_invalid",
        "diverged",
        "filter_not_finite",
        "driver_fault",
        "protection_level",
    )
    """Codes that start it, or parts of codes."""
