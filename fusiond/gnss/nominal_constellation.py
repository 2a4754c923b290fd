r"""Nominal BeiDou-3 and GPS constellations: broadcast ephemerides from orbit parameters.

In inertial axes that coincide with the Earth's at `EPOCH_S`, tau = t - EPOCH_S:

    node(tau) = node_0 + node' tau                  argument of latitude  u(tau) = u_0 + n tau
    n = sqrt(mu / a^3)        node' = -3/2 n J2 (R / a)^2 cos i / (1 - e^2)^2
    Omega_0 = node(toe) - omega_e (toe's week start - EPOCH_S)              MEO, IGSO, GPS
    M(toe) = u(toe) - omega

An IGSO has n = omega_e - node', so that it always crosses the equator northward at the longitude
u_0 + node_0. A GEO keeps still in the Earth's axes, at longitude L. Its user algorithm turns by
Rx(-5 deg) from the axes of the broadcast elements, where the equatorial orbit is

    i = 5 deg      Omega_0 - omega_e toe = pi      omega + M(toe) = L + pi

a (m) semi-major axis, e eccentricity, i inclination, omega argument of perigee, toe (s) reference
time. Perigees do not turn. Harmonic corrections and clocks are fixed numbers of the usual size,
different for each satellite. Two ephemerides of one satellite give the same orbit, to rounding. The
orientation among the stars, and so the sky over a place at a date, is not the real one.

Source: BDS-SIS-ICD-B1I-3.0 sections 3.1 and 5.2.4.12 (24 MEO on Walker 24/3/1 at 27906.1 km, 3 GEO
at 80, 110.5 and 140 deg E); IGSO node 118 deg E: Yang et al., Satellite Navigation 1 (2020) 1; GPS
SPS Performance Standard, 4th ed., table 3.2-1 (24 slots); J2: NGA.STND.0036.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.raw.messages import Ephemeris, System
from fusiond.gnss.ecef import ned_axes, to_ecef
from fusiond.gnss.orbit import (
    BDT_BEHIND_GPS_S,
    BDT_WEEK_0_IN_GPS_WEEKS,
    CONSTANTS,
    GEO_TILT_RAD,
    WEEK_S,
    Orbits,
    gps_time,
)
from fusiond.navigation.earth import SEMI_MAJOR_M

Array = NDArray[np.float64]

EPOCH_S = 2300.0 * WEEK_S
"""GPS time where the inertial axes coincide with the Earth's: 2024-02-04."""
J2 = 1.082629821e-3
UPDATE_S: dict[System, float] = {"G": 7200.0, "E": 600.0, "C": 3600.0}
"""Interval of ephemeris broadcasts; toe lies on its multiples."""

INCLINATION_RAD = math.radians(55.0)
GEO_LONGITUDES_DEG = {59: 140.0, 60: 80.0, 61: 110.5}
"""PRN and slot of the BeiDou-3 GEO."""
IGSO_PRNS = (38, 39, 40)
IGSO_NODE_DEG = 118.0
MEO_PRNS = (*range(19, 31), *range(32, 38), *range(41, 47))
MEO_SEMI_MAJOR_M = 27_906_100.0
MEO_PLANES = 3
GPS_SEMI_MAJOR_M = 26_559_700.0
GPS_SLOTS_DEG = (
    (272.847, (268.126, 161.786, 11.676, 41.806)),
    (332.847, (80.956, 173.336, 309.976, 204.376)),
    (32.847, (111.876, 11.796, 339.666, 241.556)),
    (92.847, (135.226, 265.446, 35.156, 167.356)),
    (152.847, (197.046, 302.596, 66.066, 333.686)),
    (212.847, (238.886, 345.226, 105.206, 135.346)),
)
"""Planes A to F: node and the four arguments of latitude. PRN 1 to 24 in this order."""
_ECCENTRICITY = {"geo": 3e-4, "igso": 2e-3, "meo": 8e-4, "gps": 8e-3}


@dataclass(frozen=True, slots=True)
class Slot:
    """Orbital slot: node and argument of latitude at `EPOCH_S`, rad.

    For a GEO `latitude_argument` is the longitude, and there is no node.
    """

    system: System
    prn: int
    kind: str
    semi_major_m: float
    node: float
    latitude_argument: float

    @property
    def node_rate(self) -> float:
        """Precession of the node by J2, rad/s."""
        if self.kind == "geo":
            return 0.0
        n = math.sqrt(CONSTANTS[self.system].gm / self.semi_major_m**3)
        return _node_rate(n, self.semi_major_m, _ECCENTRICITY[self.kind])


def _node_rate(n: float, a: float, e: float) -> float:
    ratio = SEMI_MAJOR_M / a
    return -1.5 * n * J2 * ratio * ratio * math.cos(INCLINATION_RAD) / (1.0 - e * e) ** 2


def _synchronous_m(node_rate: float) -> float:
    """Semi-major axis with n + node' = omega_e."""
    n = CONSTANTS["C"].earth_rate - node_rate
    return math.cbrt(CONSTANTS["C"].gm / (n * n))


def beidou_slots() -> Iterator[Slot]:
    """Slots of BeiDou-3: 3 GEO, 3 IGSO a third of a turn apart on one ground track, 24 MEO."""
    a = _synchronous_m(0.0)
    for prn, longitude in GEO_LONGITUDES_DEG.items():
        yield Slot("C", prn, "geo", a, 0.0, math.radians(longitude))
    e = _ECCENTRICITY["igso"]
    for _ in range(4):  # node' changes a by 1e-5: a fixed point in two steps
        n = math.sqrt(CONSTANTS["C"].gm / a**3)
        a = _synchronous_m(_node_rate(n, a, e))
    for k, prn in enumerate(IGSO_PRNS):
        node = 2.0 * math.pi * k / len(IGSO_PRNS)
        yield Slot("C", prn, "igso", a, node, math.radians(IGSO_NODE_DEG) - node)
    per_plane = len(MEO_PRNS) // MEO_PLANES
    for k, prn in enumerate(MEO_PRNS):
        plane, place = divmod(k, per_plane)
        # Walker T/P/F = 24/3/1: a plane ahead, F / T of a turn ahead in the orbit.
        u = place / per_plane + plane / len(MEO_PRNS)
        node = plane / MEO_PLANES
        yield Slot("C", prn, "meo", MEO_SEMI_MAJOR_M, 2.0 * math.pi * node, 2.0 * math.pi * u)


def gps_slots() -> Iterator[Slot]:
    """Slots of GPS: the 24 baseline slots, PRN 1 to 24."""
    prn = 0
    for node, arguments in GPS_SLOTS_DEG:
        for u in arguments:
            prn += 1
            yield Slot("G", prn, "gps", GPS_SEMI_MAJOR_M, math.radians(node), math.radians(u))


def slots(systems: Sequence[System] = ("C", "G")) -> tuple[Slot, ...]:
    """Slots of the supported systems: "C" and "G". Raises ValueError."""
    makers = {"C": beidou_slots, "G": gps_slots}
    if unknown := set(systems) - set(makers):
        raise ValueError(f"no constellation for {sorted(unknown)}")
    return tuple(slot for system in systems for slot in makers[system]())


def ephemeris(slot: Slot, week: int, tow_s: float, epoch_s: float = EPOCH_S) -> Ephemeris:
    """Ephemeris broadcast by the satellite at GPS time `week`, `tow_s`: the one with the nearest
    toe.

    At `epoch_s` (GPS time, s; default `EPOCH_S`) the satellites have their nominal positions.
    Unquantised: `fusiond.simulation.gnss.nav_fields.quantised` rounds to what a message can carry.
    """
    system = slot.system
    beidou = system == "C"
    mu, rate = CONSTANTS[system].gm, CONSTANTS[system].earth_rate
    own_week, own_tow = system_time(system, week, tow_s)
    toe = round(own_tow / UPDATE_S[system]) * UPDATE_S[system]
    if toe >= WEEK_S:
        own_week, toe = own_week + 1, toe - WEEK_S
    gps_week, start_s = gps_time(system, own_week, 0.0)
    week_start = gps_week * WEEK_S + start_s - epoch_s
    tau = week_start + toe
    e = _ECCENTRICITY[slot.kind]
    n = math.sqrt(mu / slot.semi_major_m**3)
    spread = 2.0 * math.pi * (0.618034 * slot.prn % 1.0)  # golden section: all phases differ
    if slot.kind == "geo":
        # The perigee is fixed among the stars, so it turns backwards in the Earth's axes.
        node = math.pi + rate * toe
        u = slot.latitude_argument + math.pi
        perigee = spread - rate * tau
        inclination = -GEO_TILT_RAD
    else:
        node = slot.node + slot.node_rate * tau - rate * week_start
        u = slot.latitude_argument + n * tau
        perigee = spread
        inclination = INCLINATION_RAD
    drift = 5e-13 * math.sin(3.0 * spread)
    small = 0.0 if slot.kind == "geo" else 1.0
    return Ephemeris(
        source="constellation",
        t_seen_ns=0,
        system=system,
        prn=slot.prn,
        message="lnav" if not beidou else "d2" if slot.kind == "geo" else "d1",
        week=own_week,
        toe_s=toe,
        toc_s=toe,
        sqrt_a=math.sqrt(slot.semi_major_m),
        eccentricity=e,
        inclination=inclination,
        ascending_node=_wrap(node),
        perigee=_wrap(perigee),
        mean_anomaly=_wrap(u - perigee),
        mean_motion_correction=0.0,
        inclination_rate=0.0,
        ascending_node_rate=slot.node_rate,
        cuc=small * 2e-6 * math.cos(spread),
        cus=small * 6e-6 * math.cos(2.0 * spread),
        crc=small * 250.0 * math.sin(2.0 * spread),
        crs=small * 60.0 * math.sin(spread),
        cic=small * 8e-8 * math.cos(4.0 * spread),
        cis=small * 8e-8 * math.sin(4.0 * spread),
        clock_bias_s=4e-4 * math.sin(5.0 * spread) + drift * tau,
        clock_drift=drift,
        clock_drift_rate=0.0,
        group_delay_s=(1.2e-8 * math.sin(spread), 7e-9 * math.cos(spread))[: 2 if beidou else 1],
        issue=1 if beidou else round(toe / UPDATE_S[system]) % 240,
        accuracy_m=2.0,
        healthy=True,
    )


def constellation(
    week: int,
    tow_s: float,
    systems: Sequence[System] = ("C", "G"),
    epoch_s: float = EPOCH_S,
) -> tuple[Ephemeris, ...]:
    """Broadcast messages at GPS time `week`, `tow_s`, one ephemeris for each satellite."""
    return tuple(ephemeris(slot, week, tow_s, epoch_s) for slot in slots(systems))


def system_time(system: System, week: int, tow_s: float) -> tuple[int, float]:
    """Convert GPS time to week and second of week of the system's own time."""
    if system != "C":
        return week, tow_s
    tow_s -= BDT_BEHIND_GPS_S
    back = tow_s < 0.0
    return week - BDT_WEEK_0_IN_GPS_WEEKS - back, tow_s + WEEK_S * back


def _wrap(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


# ---------------------------------------------------------------------------- geometry


class Sky(NamedTuple):
    """Satellites seen from a place at one instant: angles (n,) rad, unit vectors (n, 3) to the
    satellites, NED, ranges (n,) m, ECEF positions (n, 3) m and velocities m/s."""

    satellites: tuple[str, ...]
    azimuth: Array
    elevation: Array
    unit_ned: Array
    range_m: Array
    position_ecef_m: Array
    velocity_ecef_m_s: Array

    def above(self, elevation_rad: float) -> Sky:
        """Satellites at or above an elevation."""
        return self.only(self.elevation >= elevation_rad)

    def only(self, keep: NDArray[np.bool_]) -> Sky:
        """Satellites marked in `keep` (n,)."""
        names = tuple(s for s, k in zip(self.satellites, keep, strict=True) if k)
        return Sky(names, *(values[keep] for values in self[1:]))


class Constellation:
    """Satellites on the orbits of their ephemerides, as arrays."""

    def __init__(self, ephemerides: Sequence[Ephemeris]) -> None:
        self.ephemerides = tuple(ephemerides)
        self.satellites = tuple(e.satellite for e in self.ephemerides)
        self.orbits = Orbits.of(self.ephemerides)

    def positions(self, t_s: float) -> tuple[Array, Array]:
        """ECEF positions (n, 3) in m and velocities in m/s at GPS time `t_s`.

        `t_s` is counted from 1980-01-06 (week * 604800 + second of week). Doubles resolve it to
        0.2 us, 1 mm of a satellite's way.
        """
        week, tow_s = divmod(t_s, WEEK_S)
        states = self.orbits.at(int(week), tow_s)
        return states.position, states.velocity

    def line_of_sight(self, lat: float, lon: float, height_m: float, t_s: float) -> Sky:
        """Sky over a geodetic place (rad, m) at GPS time `t_s`, with satellites below the horizon.

        The geometry of one instant neglects the 70 to 130 ms of flight, in which a satellite moves
        up to 400 m: 1e-5 rad seen from the place.
        """
        p, v = self.positions(t_s)
        delta = p - np.array(to_ecef(lat, lon, height_m))
        distance = np.linalg.norm(delta, axis=1)
        unit = (delta / distance[:, None]) @ ned_axes(lat, lon)
        return Sky(
            self.satellites,
            np.arctan2(unit[:, 1], unit[:, 0]) % (2.0 * math.pi),
            np.arcsin(-unit[:, 2]),
            unit,
            distance,
            p,
            v,
        )
