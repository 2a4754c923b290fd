"""Data that heading sources share."""

from __future__ import annotations

from typing import NamedTuple

from fusiond.models.blocks import ImuNoise
from fusiond.models.model import Model
from fusiond.navigator.alignment.evidence import AlignmentEvidence
from fusiond.navigator.alignment.heading_from_positions import Track
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.saved_state import SavedState


class Basis(NamedTuple):
    """Input of a start: options, the filter's model, the saved state, the evidence."""

    options: AlignmentOptions
    model: Model
    saved: SavedState | None
    known: AlignmentEvidence
    track: Track

    @property
    def noise(self) -> ImuNoise:
        """Noise of the inertial unit, as observed so far."""
        return self.known.unit.noise
