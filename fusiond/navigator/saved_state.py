"""Last solution on disk, for a restart at the same place without a new heading."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, TypeAdapter
from pydantic.dataclasses import dataclass

from fusiond.navigator.state_file import RefusedStateError, read_state, write_state

# A parked vehicle does not turn; ferries and tow trucks do. What the sigma of a saved heading grows
# to at least (rad).
SAVED_HEADING_SD_RAD = math.radians(2.0)
# A host's clock that is set by network time may go back by this much (s) between two runs.
CLOCK_SLACK_S = 60.0

# Anywhere that a vehicle drives, sails or flies, in WGS 84, as for the commands of an operator.
Latitude = Annotated[float, Field(ge=-math.pi / 2, le=math.pi / 2)]
Longitude = Annotated[float, Field(ge=-math.pi, le=math.pi)]
Height = Annotated[float, Field(ge=-1000.0, le=100_000.0)]
# Half the Earth's circumference: a sigma beyond it says nothing more.
PositionSigma = Annotated[float, Field(gt=0.0, le=2.1e7)]

STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, slots=True, config=STRICT)
class SavedState:
    """Position (rad, rad, m), yaw (rad) and sigmas of a vehicle at rest, with POSIX time (s); no
    height if unknown.

    Raises pydantic's `ValidationError` for impossible values.
    """

    utc_s: Annotated[float, Field(ge=0.0, le=1e11)]
    position: tuple[Latitude, Longitude, Height | None]
    sd_position_m: PositionSigma
    yaw_rad: Annotated[float, Field(ge=-math.pi, le=math.pi)]
    sd_yaw_rad: Annotated[float, Field(gt=0.0, le=2.0 * math.pi)]
    confirmed: bool = True
    """True if a measurement has confirmed the heading, beside its configuration."""
    version: Literal[1] = 1
    """Version of the layout; older files without it have the same one."""


_SAVED = TypeAdapter(SavedState)


def save_state(path: Path, state: SavedState) -> None:
    """Write atomically: a power cut leaves the old file or the new one. OSError passes."""
    write_state(path, _SAVED.dump_json(state), durable=True)


def load_state(path: Path, now_utc_s: float | None, max_age_s: float) -> SavedState | None:
    """Saved state; None without a valid one.

    Raises `DamagedStateError` for an invalid file, `RefusedStateError` for a wrong time or if the
    time (`now_utc_s`, POSIX) is unknown.
    """
    state = read_state(path, _SAVED)
    if state is None:
        return None
    if now_utc_s is None:
        raise RefusedStateError("the time is not known yet, so its age is not")
    age = now_utc_s - state.utc_s
    if age < -CLOCK_SLACK_S:
        raise RefusedStateError(f"it is from {-age:.0f} s ahead of this computer's clock")
    if age > max_age_s:
        raise RefusedStateError(f"it is {age:.0f} s old (limit {max_age_s:.0f} s)")
    return replace(state, sd_yaw_rad=max(state.sd_yaw_rad, SAVED_HEADING_SD_RAD))
