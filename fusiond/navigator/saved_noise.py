"""Saved noise estimates for the next start, with less weight, and less with age.

Sums of evidence, which can be scaled to less weight: division of a receiver's errors of fixes
(fusiond.aiding.fix_error_correlation), noise share of the samples
(fusiond.navigator.imu_vibration_noise_share), size of configured drifts and white noise
(fusiond.navigator.aiding_drift_sigma_estimation, fusiond.navigator.sensor_white_noise). The next
drive has other streets, so only `CARRIED` of the sums counts: two of ten minutes, which two new
minutes outweigh. With antenna and load possibly changed, the weight falls by e each week.
"""

from __future__ import annotations

import math
from dataclasses import field, replace
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fusiond.aiding.fix_error_correlation import MOST_SHOWN, SHOWN
from fusiond.navigator.aiding_drift_sigma_estimation import GRID as LEVELS
from fusiond.navigator.imu_vibration_noise_share import GRID
from fusiond.navigator.saved_state import STRICT

CARRIED = 0.2
FADES_S = 7.0 * 86400.0

Name = Annotated[str, Field(min_length=1, max_length=128)]
Sum = Annotated[float, Field(ge=-MOST_SHOWN, le=MOST_SHOWN)]
Sums = Annotated[tuple[Sum, ...], Field(min_length=SHOWN, max_length=SHOWN)]
Shown = Annotated[tuple[Sum, ...], Field(min_length=3 * len(GRID), max_length=3 * len(GRID))]

Pairs = Annotated[tuple[Sum, ...], Field(min_length=2, max_length=2)]
Level = Annotated[tuple[Sum, ...], Field(min_length=1 + len(LEVELS), max_length=1 + len(LEVELS))]


@dataclass(frozen=True, slots=True, config=STRICT)
class SavedNoise:
    """Sums of each receiver's fixes by name; log likelihoods of shares of the samples' noise, of
    how many predictions; of levels of drifts by block, after the number of instants; number and sum
    of a sensor's pairs of innovations by source; POSIX time (s), if known. Raises pydantic's
    `ValidationError` for invalid values."""

    utc_s: Annotated[float, Field(ge=0.0, le=1e11)] | None
    fixes: Annotated[dict[Name, Sums], Field(max_length=64)]
    predictions: Annotated[float, Field(ge=0.0, le=1e3)]
    shares: Shown
    drifts: Annotated[dict[Name, Level], Field(max_length=64)] = field(default_factory=dict)
    whites: Annotated[dict[Name, Pairs], Field(max_length=64)] = field(default_factory=dict)

    def at(self, now_utc_s: float | None) -> SavedNoise:
        """Part that counts for a start at that time; for an unknown age, that after a week."""
        age_s = FADES_S
        if now_utc_s is not None and self.utc_s is not None:
            age_s = max(now_utc_s - self.utc_s, 0.0)
        weight = CARRIED * math.exp(-age_s / FADES_S)
        fixes = {name: tuple(weight * x for x in sums) for name, sums in self.fixes.items()}
        shares = tuple(weight * x for x in self.shares)
        drifts = {name: tuple(weight * x for x in level) for name, level in self.drifts.items()}
        whites = {name: tuple(weight * x for x in pairs) for name, pairs in self.whites.items()}
        known = weight * self.predictions
        found = replace(self, fixes=fixes, predictions=known, shares=shares)
        return replace(found, drifts=drifts, whites=whites)
