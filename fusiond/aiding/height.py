r"""Height of the body origin above the ellipsoid, or by air pressure.

    ellipsoidal:    z = -(h^ - h) = dr_D + v
    barometric:     y = (1 + k) h + b + c (v_N^2 + v_E^2) / (2 g) + v

b the weather's offset (m), k the scale error, c the share of the dynamic pressure that the sensor's
place lacks (fusiond.models.vehicle_parameter_blocks). With z = y - h(x^), navigation errors
computed minus true and parameters true minus estimated:

    z = (1 + k) dr_D - c (v_N dv_N + v_E dv_E) / g + db + h dk + (v_N^2 + v_E^2) / (2 g) dc + v

The air is taken to be calm: wind is a part of b.

Source: hypsometric equation, dH / dh = T_standard / T (Dobyne, The accuracy of barometric
altimeters with respect to geometric altitude, ION GPS 1988); Bernoulli for c.
"""

from __future__ import annotations

import numpy as np

from drivers.immutable import immutable
from fusiond.aiding.base import AidingMeasurement, Innovation, NotApplicable, State
from fusiond.aiding.heading_history import HeadingHistory
from fusiond.aiding.initialisation_candidates import HeightCandidate
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.strapdown import HEIGHT, VE, VN


@immutable()
class HeightMeasurement(AidingMeasurement):
    """Ellipsoidal height (m) with `sd_m`. What successive ones share is not estimated: it is of the
    same origin as the error of the blocks `of`, those of the position that came with it."""

    height_m: float
    sd_m: float
    of: tuple[str, ...] = ()

    @property
    def shares(self) -> tuple[str, ...]:
        return self.of

    def without_attitude(self, way: HeadingHistory) -> HeightMeasurement:
        return self

    def innovation(self, state: State) -> Innovation | NotApplicable:
        if state.model.hold_height:
            return NotApplicable("height_held")
        h = np.zeros((1, state.model.size))
        h[0, 8] = 1.0
        return Innovation(
            np.array([self.height_m - state.nav[HEIGHT]]), h, np.array([self.sd_m**2])
        )

    def candidates(self) -> tuple[HeightCandidate, ...]:
        return (HeightCandidate(self.height_m, self.sd_m),)


@immutable()
class BarometerMeasurement(AidingMeasurement):
    """Height of the standard atmosphere (m) with `sd_m`; `offset`, `scale` and `airflow` name the
    blocks of its errors, which the model has. It is no height to start with: the weather may be
    anything."""

    height_m: float
    sd_m: float
    offset: str
    scale: str
    airflow: str

    def without_attitude(self, way: HeadingHistory) -> BarometerMeasurement:
        return self

    def innovation(self, state: State) -> Innovation | NotApplicable:
        model, nav = state.model, state.nav
        if model.hold_height:
            return NotApplicable("height_held")
        (offset,), (scale,), (airflow,) = map(
            model.slots_of, (self.offset, self.scale, self.airflow)
        )
        height, north, east = float(nav[HEIGHT]), float(nav[VN]), float(nav[VE])
        gain, share = 1.0 + state.xi[scale], state.xi[airflow]
        head_m = (north * north + east * east) / (2.0 * STANDARD_GRAVITY_M_S2)
        says_m = gain * height + state.xi[offset] + share * head_m
        h = np.zeros((1, model.size))
        h[0, 3] = -share * north / STANDARD_GRAVITY_M_S2
        h[0, 4] = -share * east / STANDARD_GRAVITY_M_S2
        h[0, 8] = gain
        h[0, offset], h[0, scale], h[0, airflow] = 1.0, height, head_m
        return Innovation(np.array([self.height_m - says_m]), h, np.array([self.sd_m**2]))
