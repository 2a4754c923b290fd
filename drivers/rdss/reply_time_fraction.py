"""Last byte of the time T in a 4.0 position reply: tenths or hundredths of a second, by vendor."""

from __future__ import annotations

from typing import Literal

FractionUnit = Literal["auto", "0.1", "0.01"]


class FractionReader:
    """Reader of the byte in a configured unit, or with detection of the unit.

    A value above 9 can only be hundredths, which decides the unit. Until then, `auto` gives the
    mean of both readings, and half their difference as the uncertainty (at most 0.41 s). PROTOCOLS
    1.2, "fraction of T".
    """

    def __init__(self, unit: FractionUnit = "auto") -> None:
        self._unit = unit

    @property
    def unit(self) -> FractionUnit:
        return self._unit

    def read(self, value: int) -> tuple[float, float]:
        """Fraction of a second and the bound of its error, both in s."""
        if value > 99 or (self._unit == "0.1" and value > 9):
            return 0.5, 0.5  # impossible in both units: only the whole second is known
        if self._unit == "0.1":
            return value * 0.1, 0.05
        if self._unit == "auto" and value > 9:
            self._unit = "0.01"
        if self._unit == "0.01":
            return value * 0.01, 0.005
        return value * 0.055, max(0.05, value * 0.045)
