r"""What a series and the filter differ by, before it can be told which of them is wrong.

A mean of innovations that is beyond what chance does once in a million is a bias, and its series is
left out. A drift has by then taken the filter away by more than it is sure of: no test is as quick
as the error (fusiond.integrity.proof). Before that the mean is beyond what chance does once in
twenty. Series and filter then differ by it, and either may be wrong, so that the filter is surer
than it can be unless what it publishes is open by as much: with m a mean of whitened innovations
and s the variance of such means (fusiond.integrity.means),

    sigma^2 + S max(0, m^2 - 3.84 s)                 S = P + R, of each axis

of what the series measures; and of all that P says goes with it, by the square of the regression on
it, P_ix / P_xx. P is not touched: the solution is the same, and as sure as before once
the mean is. One window in twenty of a sound series is a little wider.

Once the series is left out, P is: by S m^2, which is what the filter and the series were apart for
as long as the mean looks back. The last innovation alone is mostly noise.

Source: Brenner, Integrated GPS/inertial fault detection availability, NAVIGATION 43 (1996), 111 (a
solution is off by no more than it is apart from one without the fault, and that one's error).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.offers import PositionOffer, VelocityOffer
from fusiond.integrity.series import Series
from fusiond.integrity.support import FINE_M
from fusiond.navigation.error_model import DR, DV

Array = NDArray[np.float64]
Said = PositionOffer | VelocityOffer | None

NOTHING: Mapping[str, Array] = {}


class Hedge:
    """By series, the variances (9,) that what is published is wider by: position, velocity (n, e,
    d), attitude. `wider` is replaced whenever it changes, never changed itself."""

    __slots__ = ("wider",)

    def __init__(self) -> None:
        self.wider = NOTHING

    def look(self, source: str, record: Series, said: Said, covariance: Array | None) -> None:
        """A mean of a series that is fused is beyond what is likely, or was; P (n, n) of the
        filter. A coarse position cannot say that a fine one is wrong."""
        if not record.means.unlikely:
            self.drop(source)
        elif said is not None and covariance is not None and record.sd_m <= FINE_M:
            first = DR if record.locates else DV
            wider = record.means.leaves_open(covariance, first, said.sd)
            self.wider = {**self.wider, source: wider}

    def drop(self, source: str) -> None:
        """Nothing of a series is beyond chance, or P holds it."""
        if source in self.wider:
            rest = {name: each for name, each in self.wider.items() if name != source}
            self.wider = rest or NOTHING


def differ(record: Series, said: Said, covariance: Array | None) -> tuple[float, ...]:
    """By how much (m or m/s) of each axis the means of a series are off; P (n, n) of the filter."""
    if said is None or covariance is None:
        return ()
    first, coarse = DR if record.locates else DV, record.means.coarse
    own: list[float] = covariance.diagonal()[first : first + 3].tolist()
    axes = zip(record.means.most(), own, said.sd, strict=False)
    return tuple(m * math.sqrt(p + (coarse * sd) ** 2) for m, p, sd in axes)
