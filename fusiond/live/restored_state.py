"""State loaded from earlier runs, from which a replay starts, too."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import TypeAdapter

from fusiond.live.chain import Chain
from fusiond.live.state_in_memory import KeptState
from fusiond.navigator.restart_from_memory import WarmStart
from fusiond.navigator.saved_calibration import SavedCalibration
from fusiond.navigator.saved_state import SavedState


@dataclass(frozen=True, slots=True)
class RestoredState:
    """State restored from disk; None for each part that had nothing usable."""

    saved: SavedState | None = None
    warm: KeptState | None = None
    calibration: SavedCalibration | None = None
    messages: str | None = None
    """Stored messages, as JSON of `fusiond.live.stored_messages`."""

    def restore_into(self, chain: Chain) -> None:
        """Restore everything but `saved`, with which the chain was made. Raises `DamagedStateError`
        for a state of another model."""
        chain.navigator.calibration = self.calibration
        if self.messages is not None:
            from fusiond.live.stored_messages import KEPT_MESSAGES  # noqa: PLC0415

            chain.messaging.resume(KEPT_MESSAGES.validate_json(self.messages))
        if self.warm is not None:
            chain.navigator.trial.warm = WarmStart(self.warm.navigation, chain.navigator.model)
            chain.clock.resume(self.warm.utc)


RESTORED_STATE = TypeAdapter(RestoredState)
