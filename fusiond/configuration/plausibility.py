"""Limits of a class of vehicle: ranges that every measurement of it is held against.

They are wide enough that no vehicle of the class leaves them and narrow enough that the usual
nonsense of devices does: another unit, a field that slipped, a number out of range.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from drivers.plausible import HEIGHT_M, SPEED_M_S

VehicleClass = Literal["road", "rail", "marine", "aircraft"]


class Plausibility(NamedTuple):
    """Ellipsoidal height (m), lowest and highest, and speed (m/s, horizontal as vertical)."""

    height_m: tuple[float, float]
    max_speed_m_s: float


PLAUSIBILITY: dict[VehicleClass, Plausibility] = {
    # Roads go from -430 m at the Dead Sea to 5.9 km in Ladakh, and the geoid lies between -106 and
    # +85 m (EGM96); the fastest production car did 136 m/s (304.77 mph, 2019).
    "road": Plausibility((-1_000.0, 6_500.0), 150.0),
    # Up to 5,072 m (Tanggula pass), down to -240 m (Seikan tunnel); 160 m/s (574.8 km/h, TGV V150,
    # 2007), and 168 m/s on magnets (603 km/h, L0, 2015).
    "rail": Plausibility((-1_000.0, 6_000.0), 170.0),
    # Lake Titicaca lies at 3,812 m; the fastest ship in service does 30 m/s (58 knots, HSC
    # Francisco), racing boats 2.5 times as much.
    "marine": Plausibility((-1_000.0, 4_500.0), 80.0),
    # Whatever a receiver can mean.
    "aircraft": Plausibility(HEIGHT_M, SPEED_M_S),
}
