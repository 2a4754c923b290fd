r"""Rate of the troposphere's delay of a vehicle that climbs, which its carriers count as motion.

    dT/dt = m(E) climb dZ/dh        Z zenith delay, m mapping of the elevation E

An aircraft that climbs by 10 m/s has -3 mm/s at the zenith and three to five times that low in the
sky. What all satellites have of it is the clock's, and the rest looks like a vertical velocity of
15 mm/s, where carriers know it to 6. Dopplers have it, too, below their noise.

Source: Groves, 2nd ed., section 9.3.2 (the delay's dependence on height and elevation).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fusiond.gnss.atmosphere import zenith_delays
from fusiond.gnss.plan import RangeNoise
from fusiond.gnss.range_kernel import CARRIER_RATE, TROPOSPHERE_SIGMA

Array = npt.NDArray[np.float64]

STEP_M = 100.0
"""Heights between which the slope is taken: a hundredth of the delay's own scale."""


def take_off_climb(values: Array, lat_rad: float, height_m: float, climb_m_s: float) -> None:
    """Take what the troposphere makes of a climb out of the carriers' rates of an epoch's `values`
    (17, n)."""
    above, below = (sum(zenith_delays(lat_rad, height_m + part * STEP_M)) for part in (0.5, -0.5))
    mapping = values[TROPOSPHERE_SIGMA] / RangeNoise().troposphere_m  # 0 off the Earth
    values[CARRIER_RATE] -= mapping * climb_m_s * (above - below) / STEP_M
