"""The last solution on disk, so that a restart at the same place needs no new heading."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path

# A parked vehicle does not turn; ferries and tow trucks do. What the sigma of a saved heading grows
# to at least (rad).
SAVED_HEADING_SD_RAD = math.radians(2.0)


@dataclass(frozen=True, slots=True)
class SavedState:
    """Position (rad, rad, m), yaw (rad) and sigmas of a vehicle at rest, with POSIX time (s)."""

    utc_s: float
    position: tuple[float, float, float]
    sd_position_m: float
    yaw_rad: float
    sd_yaw_rad: float


def save_state(path: Path, state: SavedState) -> None:
    """Write atomically: a power cut leaves the old file or the new one. OSError passes."""
    temporary = path.with_suffix(".new")
    with temporary.open("w") as f:
        json.dump(asdict(state), f)
        f.flush()
        os.fsync(f.fileno())
    temporary.replace(path)


def load_state(path: Path, now_utc_s: float, max_age_s: float) -> tuple[SavedState | None, str]:
    """The saved state, or None and why there is none that can be used."""
    try:
        raw = json.loads(path.read_text())
        state = SavedState(
            float(raw["utc_s"]),
            (float(raw["position"][0]), float(raw["position"][1]), float(raw["position"][2])),
            float(raw["sd_position_m"]),
            float(raw["yaw_rad"]),
            max(float(raw["sd_yaw_rad"]), SAVED_HEADING_SD_RAD),
        )
    except FileNotFoundError:
        return None, "no saved state"
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        return None, f"saved state unusable: {error!r}"
    numbers = (state.utc_s, *state.position, state.sd_position_m, state.yaw_rad, state.sd_yaw_rad)
    if not all(math.isfinite(x) for x in numbers) or abs(state.position[0]) > math.pi / 2:
        return None, "saved state unusable: a figure out of range"
    age = now_utc_s - state.utc_s
    if not -60.0 <= age <= max_age_s:
        return None, f"saved state is {age:.0f} s old (limit {max_age_s:.0f} s)"
    return state, "saved state"
