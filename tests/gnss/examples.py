"""Ephemerides made by hand, and the same as RTKLIB takes them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.measurements import ArrivalStamp
from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    Ephemeris,
    RawGnssEpoch,
    RawSignal,
    System,
)
from fusiond.gnss.orbit import gps_time

rtk = pytest.importorskip("pyrtklib", reason="pyrtklib, the oracle, has wheels for x86-64 only")

SQRT_A = {"G": 5153.65, "E": 5440.60, "C": 5282.62, "C geo": 6493.41, "C igso": 6493.12}
LETTER: dict[System, int] = {"G": rtk.SYS_GPS, "E": rtk.SYS_GAL, "C": rtk.SYS_CMP}


def ephemeris(
    system: System,
    prn: int,
    *,
    week: int,
    toe_s: float,
    kind: str | None = None,
    eccentricity: float = 0.0123,
    seed: int = 0,
) -> Ephemeris:
    """Orbit of the right size with every correction present, drawn by `seed` and satellite."""
    rng = np.random.default_rng([seed, ord(system), prn])
    inclination = {"C geo": 0.1, "C igso": 0.96}.get(kind or "", 0.96)
    sign = rng.choice([-1.0, 1.0], 20)
    return Ephemeris(
        source="made",
        t_seen_ns=0,
        system=system,
        prn=prn,
        message={"G": "lnav", "E": "inav", "C": "d2" if kind == "C geo" else "d1"}[system],
        week=week,
        toe_s=toe_s,
        toc_s=toe_s,
        sqrt_a=SQRT_A[kind or system] + rng.uniform(-0.1, 0.1),
        eccentricity=eccentricity,
        inclination=inclination + rng.uniform(-0.02, 0.02),
        ascending_node=rng.uniform(-math.pi, math.pi),
        perigee=rng.uniform(-math.pi, math.pi),
        mean_anomaly=rng.uniform(-math.pi, math.pi),
        mean_motion_correction=sign[0] * 4.5e-9,
        inclination_rate=sign[1] * 3e-10,
        ascending_node_rate=-8e-9,
        cuc=sign[2] * 2e-6,
        cus=sign[3] * 9e-6,
        crc=sign[4] * 250.0,
        crs=sign[5] * 60.0,
        cic=sign[6] * 1.5e-7,
        cis=sign[7] * 8e-8,
        clock_bias_s=sign[8] * 4.2e-4,
        clock_drift=sign[9] * 3e-11,
        clock_drift_rate=sign[10] * 1e-18,
        group_delay_s=(sign[11] * 7e-9,) if system == "G" else (sign[11] * 9e-9, sign[12] * 4e-9),
        issue=7,
        accuracy_m=2.0,
        healthy=True,
    )


def examples(week: int = 2381, toe_s: float = 388800.0) -> list[Ephemeris]:
    """GPS, Galileo, BeiDou MEO, IGSO and the four GEO numbers at the ends of their ranges."""
    own = {"G": (week, toe_s), "E": (week, toe_s), "C": (week - 1356, toe_s)}
    made = [ephemeris("G", n, week=own["G"][0], toe_s=own["G"][1]) for n in (1, 13, 32)]
    made += [ephemeris("E", n, week=own["E"][0], toe_s=own["E"][1]) for n in (2, 36)]
    week_c, toe_c = own["C"]
    made += [ephemeris("C", n, week=week_c, toe_s=toe_c) for n in (11, 30, 58)]
    made += [ephemeris("C", n, week=week_c, toe_s=toe_c, kind="C igso") for n in (6, 38)]
    made += [
        ephemeris("C", n, week=week_c, toe_s=toe_c, kind="C geo", eccentricity=5e-4)
        for n in (1, 5, 59, 60, 63)
    ]
    return [*made, replace(made[0], eccentricity=0.02), replace(made[5], eccentricity=0.02)]


def oracle_time(week: int, tow_s: float) -> Any:
    """GPS week and second as RTKLIB's time."""
    return rtk.gpst2time(week, tow_s)


def oracle_ephemeris(e: Ephemeris) -> Any:
    """The same ephemeris as RTKLIB's `eph_t`."""
    out = rtk.eph_t()
    out.sat = rtk.satno(LETTER[e.system], e.prn)
    week, toe = gps_time(e.system, e.week, e.toe_s)
    out.toe = out.ttr = rtk.gpst2time(week, toe)
    out.toc = rtk.gpst2time(week, gps_time(e.system, e.week, e.toc_s)[1])
    out.week, out.toes = e.week, e.toe_s
    out.A, out.e, out.i0, out.OMG0 = e.sqrt_a**2, e.eccentricity, e.inclination, e.ascending_node
    out.omg, out.M0, out.deln = e.perigee, e.mean_anomaly, e.mean_motion_correction
    out.OMGd, out.idot = e.ascending_node_rate, e.inclination_rate
    out.crc, out.crs, out.cuc, out.cus, out.cic, out.cis = e.crc, e.crs, e.cuc, e.cus, e.cic, e.cis
    out.f0, out.f1, out.f2 = e.clock_bias_s, e.clock_drift, e.clock_drift_rate
    return out


def vector(*values: float) -> Any:
    """RTKLIB's array of double."""
    out = rtk.Arr1Ddouble(len(values))
    for i, value in enumerate(values):
        out[i] = value
    return out


def oracle_state(e: Ephemeris, week: int, tow_s: float) -> tuple[Any, float]:
    """Position (3,) m and clock s (with relativity) by `eph2pos` at a GPS time of transmission."""
    position, clock, variance = vector(0, 0, 0), vector(0), vector(0)
    rtk.eph2pos(oracle_time(week, tow_s), oracle_ephemeris(e), position, clock, variance)
    return np.array([position[i] for i in range(3)]), clock[0]


def oracle_pseudorange(
    e: Ephemeris,
    week: int,
    tow_s: float,
    receiver: Any,
    signal: str,
    group_delay_s: float,
    clock_m: float,
    ionosphere: tuple[float, ...] = (),
) -> float:
    """Pseudorange that RTKLIB's parts make; without `ionosphere` (GPS's eight) in vacuo.

    `tow_s` true time of reception; the receiver's clock, and so what it says of the epoch, is ahead
    by `clock_m` / c.
    """
    at = vector(*receiver)
    place, azel, sight = vector(0, 0, 0), vector(0, 0), vector(0, 0, 0)
    rtk.ecef2pos(at, place)
    flight, distance, clock = 0.07, 0.0, 0.0
    for _ in range(6):
        position, clock = oracle_state(e, week, tow_s - flight)
        distance = rtk.geodist(vector(*position), at, sight)
        flight = distance / SPEED_OF_LIGHT_M_S
    rtk.satazel(place, sight, azel)
    range_m = distance - SPEED_OF_LIGHT_M_S * (clock - group_delay_s) + clock_m
    if not ionosphere:
        return float(range_m)
    now = oracle_time(week, tow_s)
    zenith = vector(0.0, math.pi / 2)
    dry = rtk.tropmodel(now, place, zenith, 0.0)
    wet = rtk.tropmodel(now, place, zenith, 0.7) - dry
    wet_map = vector(0)
    dry_map = rtk.tropmapf(now, place, azel, wet_map)
    carrier = CARRIER_HZ[e.system, signal[0]]
    layer = rtk.ionmodel(now, vector(*ionosphere), place, azel)
    layer *= (CARRIER_HZ["G", "1"] / carrier) ** 2
    return float(range_m + dry * dry_map + wet * wet_map[0] + layer)


def signals_epoch(week: int, tow_s: float, signals: list[RawSignal]) -> RawGnssEpoch:
    """An epoch of some signals."""
    return RawGnssEpoch("made", 0, ArrivalStamp(), week, tow_s, tuple(signals))
