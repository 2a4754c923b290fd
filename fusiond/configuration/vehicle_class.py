"""Plausible ranges of measurements for a class of vehicle.

They are wide enough that no vehicle of the class leaves them and narrow enough that the usual
nonsense of devices does: another unit, a field that slipped, a number out of range.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from drivers.plausible import HEIGHT_M, SPEED_M_S

VehicleClass = Literal["road", "rail", "marine", "aircraft"]


class Plausibility(NamedTuple):
    """Ellipsoidal height (m), lowest and highest, and speed (m/s, horizontal as vertical).

    `manoeuvre`: usual motion, which is no limit: one sigma (m/s^2) of its horizontal and vertical
    acceleration, and the duration (s) of one. `hardest_m_s2`: the largest horizontal acceleration:
    five sigma of an unobserved motion.
    """

    height_m: tuple[float, float]
    max_speed_m_s: float
    manoeuvre: tuple[float, float, float]
    hardest_m_s2: float


PLAUSIBILITY: dict[VehicleClass, Plausibility] = {
    # Roads go from -430 m at the Dead Sea to 5.9 km in Ladakh, and the geoid lies between -106 and
    # +85 m (EGM96); the fastest production car did 136 m/s (304.77 mph, 2019).
    # In traffic each axis has 0.7 to 0.8 m/s^2, and over 10 s velocity grows as if one of them
    # lasted for 2 to 3 s (drive_0708; on a main road, css_164, half of it). Tyres hold 0.8 g on a
    # dry road (Wong, Theory of Ground Vehicles, table 1.3: peak 0.8 to 0.9).
    "road": Plausibility((-1_000.0, 6_500.0), 150.0, (0.75, 0.1, 3.0), 7.8),
    # Up to 5,072 m (Tanggula pass), down to -240 m (Seikan tunnel); 160 m/s (574.8 km/h, TGV V150,
    # 2007), and 168 m/s on magnets (603 km/h, L0, 2015).
    # Trains start and brake by 0.5 m/s^2, and take their bends by as much (EN 13803: 0.65 to 0.85).
    # Emergency brakes reach 1.5 m/s^2; canted by 180 mm a bend is one of 2.
    "rail": Plausibility((-1_000.0, 6_000.0), 170.0, (0.3, 0.05, 10.0), 2.0),
    # Lake Titicaca lies at 3,812 m; the fastest ship in service does 30 m/s (58 knots, HSC
    # Francisco), racing boats 2.5 times as much.
    # Waves of some metres and 8 s move a hull by 0.5 m/s^2, for a quarter of their period. Planing
    # boats turn by half a g.
    "marine": Plausibility((-1_000.0, 4_500.0), 80.0, (0.3, 0.5, 2.0), 4.9),
    # Whatever a receiver can mean.
    # A turn at 25 deg of bank is one of 4.6 m/s^2 and lasts for half a minute; most of a flight is
    # straight. At 45 deg it is one g.
    "aircraft": Plausibility(HEIGHT_M, SPEED_M_S, (1.2, 0.3, 8.0), 9.8),
}
