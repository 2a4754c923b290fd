"""Random drives for the matrix, whose one town drive may be a lucky one.

Speeds of 4 to 32 m/s, bends of 10 to 120 deg at up to 3 m/s^2, straights of up to 40 s, stops of up
to 25 s, any course, some bank, a receiver of 1, 2, 5 or 10 Hz. Faults begin at the instants of the
phases and so meet the vehicle in any motion: at rest, in a bend, braking.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from fusiond.simulation.trajectories import Leg, Path, follow
from fusiond.studies.faults.sensor_data import DURATION_S, REST_S, Drive

KINDS = ("speed", "bend", "straight", "stop", "both")
SHARES = (0.22, 0.33, 0.25, 0.08, 0.12)
RATES_HZ = (1.0, 2.0, 5.0, 10.0)


@lru_cache(maxsize=8)
def drive_of_number(number: int) -> Drive:
    """Make the random drive of a number."""
    return random_drive(np.random.default_rng([2026, number]))


def random_drive(rng: np.random.Generator, duration_s: float = DURATION_S) -> Drive:
    """Draw a drive from a random generator."""
    legs = _legs(rng, duration_s)
    course_deg, bank_ratio = rng.uniform(0.0, 360.0), rng.uniform(-0.1, 0.02)

    def path(duration_s: float) -> Path:
        there = (*legs, Leg(duration_s))
        return follow(there, duration_s, course_deg=course_deg, bank_ratio=bank_ratio)

    return Drive(path, gnss_rate_hz=float(rng.choice(RATES_HZ)), duration_s=duration_s)


def _legs(rng: np.random.Generator, duration_s: float) -> list[Leg]:
    legs, speed, t_s = [Leg(REST_S)], 0.0, REST_S
    while t_s < duration_s:
        kind = rng.choice(KINDS, p=SHARES) if speed else "speed"
        if kind == "stop":
            braking = Leg(max(5.0, speed / 2.0), speed_m_s=0.0)
            found, speed = [braking, Leg(rng.uniform(3.0, 25.0))], 0.0
        elif kind == "straight":
            found = [Leg(rng.uniform(4.0, 40.0))]
        else:
            most = rng.uniform(1.0, 3.0)
            turn_deg = 0.0 if kind == "speed" else float(rng.choice((-1, 1)) * rng.uniform(10, 120))
            after = speed if kind == "bend" else rng.uniform(4.0, 32.0)
            change = math.radians(abs(turn_deg)) * max(speed, after) + abs(after - speed)
            found, speed = [Leg(max(4.0, change / most), after, turn_deg)], after
        legs += found
        t_s += sum(leg.duration_s for leg in found)
    return legs
