r"""Ellipsoidal height of the body origin.

z = -(h^ - h) = dr_D + v
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusiond.aiding.base import Aid, Innovation, NotApplicable, State
from fusiond.aiding.offers import HeightOffer
from fusiond.navigation.strapdown import HEIGHT


@dataclass(frozen=True, slots=True)
class HeightAid(Aid):
    """Ellipsoidal height (m) with `sd_m`."""

    height_m: float
    sd_m: float

    def innovation(self, state: State) -> Innovation | NotApplicable:
        if state.model.hold_height:
            return NotApplicable("height_held")
        h = np.zeros((1, state.model.size))
        h[0, 8] = 1.0
        return Innovation(
            np.array([self.height_m - state.nav[HEIGHT]]), h, np.array([self.sd_m**2])
        )

    def offers(self) -> tuple[HeightOffer, ...]:
        return (HeightOffer(self.height_m, self.sd_m),)
