"""What every heading source may look at."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.models.blocks import ImuNoise
from fusiond.models.model import Model
from fusiond.navigation.earth import EARTH_RATE_RAD_S
from fusiond.navigator.alignment.collected import Collected, Standing
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.saved_state import SavedState

if TYPE_CHECKING:
    from fusiond.navigator.alignment.positions import Track

Array = NDArray[np.float64]


class Basis(NamedTuple):
    """Options, the IMU's noise, the filter's model, the saved state, what has come in."""

    options: AlignmentOptions
    noise: ImuNoise
    model: Model
    saved: SavedState | None
    known: Collected
    track: Track


def rest_bias(noise: ImuNoise, standing: Standing, dcm: Array, lat: float) -> tuple[Array, float]:
    """Rate bias (3,) seen at rest and its sigma."""
    earth = EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    return standing.mean_rate - dcm.T @ earth, noise.rate_noise / math.sqrt(standing.seconds)
