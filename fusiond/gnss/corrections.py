r"""Corrections of a service to broadcast orbits and clocks: validity and sigma.

A satellite is corrected if one solution has these parts, none of them too old:

    its orbit, for a stored and healthy ephemeris;  its clock;  a bias of the signal

All are needed because a clock is only valid with its own biases: P + bias replaces the broadcast
group delay. A correction is valid for three of its intervals, 30 s at least and 180 s at most, so
that one or two may be lost; biases, which change in days, are valid for an hour.

    sigma^2 = max(0.15 m, what the service states)^2 + (1 mm/s age)^2

A service's clocks have their own zero, often metres from the broadcast one. So corrections are used
for a whole system or not at all: if half of its satellites have them, the others are
`no_correction`.

Source: RTCM 10403.3, 3.5.12; quality of real-time orbits (5 cm) and clocks (0.3 ns): IGS Real-Time
Service, products, 2013; age: a caesium clock's 1e-11 over 30 s are 0.1 m.
"""

from __future__ import annotations

from typing import NamedTuple

from drivers.raw.messages import Correction, CorrectionPart, Ephemeris, System
from fusiond.gnss.orbit import WEEK_S

CORRECTED_M = 0.15
AGEING_M_S = 1e-3
INTERVALS, LEAST_S, MOST_S = 3.0, 30.0, 180.0
BIAS_LASTS_S = 3600.0
MODULUS, STEP_S = 1024, 8.0
"""Modulus and step of BeiDou's toe, by which corrections identify an ephemeris."""
MESSAGES: dict[System, tuple[str, ...]] = {"G": ("lnav",), "E": ("inav",), "C": ("d1", "d2")}
"""Messages that corrections are of."""


class CorrectedEphemeris(NamedTuple):
    """Ephemeris of a satellite with its correction (14,), as `elements_row` takes them, the `bias`
    (m) of each signal, and one sigma of its ranges (m)."""

    ephemeris: Ephemeris
    columns: tuple[float, ...]
    bias: dict[str, float]
    sigma_m: float


class Corrections:
    """Latest part of each kind by satellite."""

    def __init__(self) -> None:
        self._parts: dict[tuple[System, int], dict[CorrectionPart, Correction]] = {}

    def add(self, correction: Correction) -> None:
        """Store a part, unless the stored one is valid for a later instant."""
        parts = self._parts.setdefault((correction.system, correction.prn), {})
        old = parts.get(correction.part)
        if old is None or _age_s(old, correction.week, correction.tow_s) >= 0.0:
            parts[correction.part] = correction

    def __bool__(self) -> bool:
        """True if any correction has been received."""
        return bool(self._parts)

    def issue(self, system: System, prn: int, week: int, tow_s: float) -> int | None:
        """Issue of the ephemeris to which the satellite's valid correction refers at a GPS time;
        None without one."""
        parts = self._parts.get((system, prn), {})
        orbit, clock, bias = (parts.get(p) for p in ("orbit", "clock", "bias"))
        if orbit is None or clock is None or bias is None or orbit.solution != clock.solution:
            return None
        if orbit.solution[:2] != bias.solution[:2]:
            return None
        holds = (_holds(p, week, tow_s) for p in (orbit, clock, bias))
        return orbit.issue if all(holds) else None

    def applied(self, ephemeris: Ephemeris, week: int, tow_s: float) -> CorrectedEphemeris:
        """Correction for the ephemeris with an `issue`."""
        parts = self._parts[ephemeris.system, ephemeris.prn]
        orbit, clock, bias = parts["orbit"], parts["clock"], parts["bias"]
        c0, c1, c2 = clock.values
        fast = parts.get("fast_clock")
        if fast is not None and fast.solution == clock.solution and _holds(fast, week, tow_s):
            c0 += fast.values[0]
        columns = (1.0, orbit.week, orbit.tow_s, *orbit.values, clock.week, clock.tow_s, c0, c1, c2)
        stated = parts.get("accuracy")
        sigma = CORRECTED_M if stated is None else max(CORRECTED_M, stated.values[0])
        age = max(abs(_age_s(orbit, week, tow_s)), abs(_age_s(clock, week, tow_s)))
        sigma = (sigma**2 + (AGEING_M_S * age) ** 2) ** 0.5
        biases = dict(zip(bias.signals, bias.values, strict=True))
        return CorrectedEphemeris(ephemeris, columns, biases, sigma)


def issue_of(ephemeris: Ephemeris) -> int:
    """Issue of an ephemeris, as corrections identify it."""
    if ephemeris.system == "C":
        return int(ephemeris.toe_s / STEP_S) % MODULUS
    return ephemeris.issue


def _age_s(correction: Correction, week: int, tow_s: float) -> float:
    """Seconds since the correction's reference instant."""
    return (week - correction.week) * WEEK_S + (tow_s - correction.tow_s)


def _holds(correction: Correction, week: int, tow_s: float) -> bool:
    lasts = min(max(INTERVALS * correction.interval_s, LEAST_S), MOST_S)
    if correction.part == "bias":
        lasts = BIAS_LASTS_S
    return abs(_age_s(correction, week, tow_s)) <= lasts
