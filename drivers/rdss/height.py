"""Which height goes into a position request."""

from __future__ import annotations

from drivers.rdss.binary_4_0_encode import MAX_ORDINARY_HEIGHT_M
from drivers.rdss.cycle import HINT_AGE_NS, HINT_SD_M, TerminalOptions
from drivers.rdss.messages import HeightMode, PositionRequest


class HeightSource:
    """The solution's height while it is fresh and good enough, else the configured one, else none:
    the centre then uses its terrain model and the antenna's height above the ground.
    """

    def __init__(self, options: TerminalOptions) -> None:
        self._options = options
        self._hint: tuple[float, float, int] | None = None

    def hint(self, height_m: float, sd_m: float, t_ns: int) -> None:
        """Ellipsoidal height of the antenna and its sigma, as of `t_ns`."""
        self._hint = (height_m, sd_m, t_ns)

    def request(self, user: int, t_ns: int) -> PositionRequest:
        """A single, ordinary request."""
        height = self._options.height_m
        if self._options.use_solution_height and self._hint is not None:
            hint, sd, at = self._hint
            if sd < HINT_SD_M and t_ns - at <= HINT_AGE_NS:
                height = hint
        if height is not None and abs(height) < MAX_ORDINARY_HEIGHT_M:
            return PositionRequest(user, HeightMode.GIVEN, height_m=height)
        antenna = self._options.antenna_height_m
        return PositionRequest(user, HeightMode.NONE, antenna_height_m=antenna)
