"""Choice of the height in a position request."""

from __future__ import annotations

from drivers.rdss.binary_4_0_encode import MAX_ORDINARY_HEIGHT_M
from drivers.rdss.messages import HeightMode, PositionRequest
from drivers.rdss.state_tables import HINT_AGE_NS, HINT_SD_M, TerminalOptions
from drivers.standard_atmosphere import LAPSE_K_M, T0_K, pressure_height_m

ZERO_CELSIUS_K = 273.15
PRESSURE_PA = (22_632.0, 104_857.0)
"""Plausible pressures: from the tropopause, where the standard atmosphere's formula ends, to the
limit of 20 bits of 0.1 Pa; 4 % above the highest mean pressure at any shore."""


class HeightSource:
    """Source of the height in a request: the solution while it is fresh and better than the
    centre's, else the configured height, else the pressure of the vehicle's barometer, else none.
    Without one the centre uses its terrain model and the antenna's height above the ground.

    `given_sd_m` is the sigma of the last request's height, None if unknown.
    """

    def __init__(self, options: TerminalOptions) -> None:
        self._options = options
        self._hint: tuple[float, float, int] | None = None
        self._pressure: tuple[float, int] | None = None
        self.given_sd_m: float | None = None

    def hint(
        self, height_m: float, sd_m: float, t_ns: int, centre_sd_m: float | None = None
    ) -> None:
        """Set the ellipsoidal height of the antenna and its sigma, as of `t_ns`; `centre_sd_m` is
        the sigma of the centre's own height."""
        limit_m = HINT_SD_M if centre_sd_m is None else centre_sd_m
        self._hint = (height_m, sd_m, t_ns) if sd_m < limit_m else None

    def pressure(self, pressure_pa: float, t_ns: int) -> None:
        """Static pressure at the antenna, as of `t_ns`."""
        self._pressure = pressure_pa, t_ns

    def request(self, user: int, t_ns: int) -> PositionRequest:
        """Make a single, ordinary request."""
        height, self.given_sd_m = self._options.height_m, None
        if self._options.use_solution_height and self._hint is not None:
            hint, sd, at = self._hint
            if t_ns - at <= HINT_AGE_NS:
                height, self.given_sd_m = hint, sd
        if height is not None and abs(height) < MAX_ORDINARY_HEIGHT_M:
            return PositionRequest(user, HeightMode.GIVEN, height_m=height)
        self.given_sd_m = None
        antenna = self._options.antenna_height_m
        if self._options.use_barometer and self._pressure is not None:
            pressure_pa, at = self._pressure
            if t_ns - at <= HINT_AGE_NS and PRESSURE_PA[0] <= pressure_pa <= PRESSURE_PA[1]:
                return self._by_pressure(user, pressure_pa, antenna)
        return PositionRequest(user, HeightMode.NONE, antenna_height_m=antenna)

    def _by_pressure(self, user: int, pressure_pa: float, antenna_m: float) -> PositionRequest:
        """Request with the pressure; the temperature is the standard atmosphere's, as no sensor
        measures it."""
        temperature_c = T0_K - LAPSE_K_M * pressure_height_m(pressure_pa) - ZERO_CELSIUS_K
        return PositionRequest(
            user,
            HeightMode.ALTIMETER_1,
            antenna_height_m=antenna_m,
            pressure_pa=pressure_pa / self._options.pressure_unit_pa,
            temperature_c=temperature_c,
        )
