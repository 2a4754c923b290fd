"""Store of broadcast ephemerides: the valid one of a satellite, or the reason for none.

    |t - toe| <= limit        t, toe in GPS time

The ephemeris with the closest toe is used. The last issues of a satellite are stored, so that a
delayed measurement at a changeover can still use the older one. An impossible change of orbit shows
that the number was given to another satellite: the old one's data are dropped. Health is the
satellite's last statement, whatever its issue.

Outcomes: `no_ephemeris`, `unhealthy`, `stale_ephemeris`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from drivers.raw.messages import (
    Bdgim,
    Correction,
    Ephemeris,
    Klobuchar,
    NavigationMessage,
    SignalDelays,
    System,
)
from fusiond.gnss.corrections import MESSAGES as CORRECTED
from fusiond.gnss.corrections import CorrectedEphemeris, Corrections, issue_of
from fusiond.gnss.group_delay import GroupDelay, group_delay
from fusiond.gnss.orbit import WEEK_S, Orbits, gps_time

MAX_AGE_S: dict[System, float] = {"G": 7200.0, "E": 14400.0, "C": 7200.0}
"""Longest validity of an ephemeris. GPS: fit interval of 4 h centred on toe (IS-GPS-200N 20.3.4.4
and table 20-XI). Galileo: 4 h (Galileo OS SDD: longest time a set of navigation data is valid).
BeiDou: a new set each hour, for the hour from toe on (BDS-SIS-ICD-B1I-3.0 5.2.4; toe on the hour),
and one hour more for an incomplete reception."""
COMPARED_S, OTHER_ORBIT_M = 14_400.0, 1e5
"""Interval and distance that show another satellite's orbit: four hours beyond its toe a broadcast
orbit is kilometres off, after a manoeuvre tens; two satellites are thousands apart."""
KEPT_ISSUES = 4
"""Issues kept by message: the present one, the next, and one for queued measurements."""

Missing = Literal["no_ephemeris", "unhealthy", "stale_ephemeris"]

_MESSAGES: dict[tuple[System, str], tuple[str, ...]] = {
    ("E", "5"): ("fnav", "inav"),
    ("C", "1"): ("bcnav1", "bcnav2", "d1", "d2"),
    ("C", "5"): ("bcnav2", "bcnav1", "d1", "d2"),
}
_OTHERS: dict[System, tuple[str, ...]] = {
    "G": ("lnav",),
    "E": ("inav", "fnav"),
    "C": ("d1", "d2", "bcnav1", "bcnav2"),
}


class EphemerisStore:
    """Store of received navigation messages. `version` rises with every change."""

    def __init__(self) -> None:
        self._kept: dict[tuple[System, int, str], list[Ephemeris]] = {}
        self.ionosphere: dict[System, Klobuchar] = {}
        self.bdgim: Bdgim | None = None
        self.corrections = Corrections()
        self._delays: dict[tuple[System, int], SignalDelays] = {}
        self.version = 0
        self.replaced = 0
        """Numbers that have become another satellite's so far."""

    def __len__(self) -> int:
        """Number of satellites with an ephemeris."""
        return len({key[:2] for key in self._kept})

    def add(self, message: NavigationMessage) -> None:
        """Store a decoded message; a repetition only updates its instant."""
        if isinstance(message, Correction):
            self.corrections.add(message)
            self.version += 1
            return
        if isinstance(message, SignalDelays):
            known = self._delays.get((message.system, message.prn))
            self._delays[message.system, message.prn] = message
            self.version += known is None or _delays(known) != _delays(message)
            return
        if isinstance(message, Bdgim):
            if self.bdgim is None or self.bdgim.alpha != message.alpha:
                self.version += 1
            self.bdgim = message
            return
        if isinstance(message, Klobuchar):
            old = self.ionosphere.get(message.system)
            if old is None or (old.alpha, old.beta) != (message.alpha, message.beta):
                self.version += 1
            self.ionosphere[message.system] = message
            return
        key = (message.system, message.prn, message.message)
        if self._of_another(message):
            for other in [k for k in self._kept if k[:2] == key[:2]]:
                del self._kept[other]
            self.replaced += 1
        kept = self._kept.setdefault(key, [])
        same = [e for e in kept if (e.week, e.toe_s) == (message.week, message.toe_s)]
        for e in same:
            kept.remove(e)
        kept.append(message)
        del kept[:-KEPT_ISSUES]
        if not (same and _differs_only_in_time(same[-1], message)):
            self.version += 1

    def _of_another(self, message: Ephemeris) -> bool:
        """True if the last ephemeris of that number has another orbit, so belongs to another
        satellite."""
        kept = self._kept.get((message.system, message.prn, message.message))
        if not kept or (kept[-1].week, kept[-1].toe_s) == (message.week, message.toe_s):
            return False
        week, toe_s = gps_time(message.system, message.week, message.toe_s)
        if abs(seconds_from_toe(kept[-1], week, toe_s)) > COMPARED_S:
            return False
        old, new = Orbits.of([kept[-1], message]).at(week, toe_s).position
        return bool(np.linalg.norm(old - new) > OTHER_ORBIT_M)

    def delay(self, ephemeris: Ephemeris, signal: str) -> GroupDelay | None:
        """Group delay of a signal, by all data of its satellite; None if unknown."""
        sent = self._delays.get((ephemeris.system, ephemeris.prn))
        return group_delay(ephemeris, signal, sent)

    def corrected(
        self, system: System, prn: int, week: int, tow_s: float
    ) -> CorrectedEphemeris | None:
        """Ephemeris with the correction that is valid at a GPS time; None without one."""
        issue = self.corrections.issue(system, prn, week, tow_s)
        if issue is None:
            return None
        for message in CORRECTED[system]:
            kept = self._kept.get((system, prn, message), [])
            for e in reversed(kept):
                old = abs(seconds_from_toe(e, week, tow_s)) > MAX_AGE_S[system]
                if issue_of(e) == issue and e.healthy and kept[-1].healthy and not old:
                    return self.corrections.applied(e, week, tow_s)
        return None

    def select(
        self, system: System, prn: int, week: int, tow_s: float, band: str = ""
    ) -> Ephemeris | Missing:
        """Ephemeris for a GPS time, or the reason for its absence.

        `band` is the first character of a signal: Galileo's clock for E5a is that of F/NAV, and
        BeiDou's delays for B1C and B2a are in B-CNAV; without `band` D1 is chosen, which has none.
        """
        outcome: Missing = "no_ephemeris"
        for message in _MESSAGES.get((system, band), _OTHERS[system]):
            kept = self._kept.get((system, prn, message))
            if not kept:
                continue
            if not kept[-1].healthy:
                return "unhealthy"
            best = min(kept, key=lambda e: abs(seconds_from_toe(e, week, tow_s)))
            if abs(seconds_from_toe(best, week, tow_s)) <= MAX_AGE_S[system]:
                return best if best.healthy else "unhealthy"
            outcome = "stale_ephemeris"
        return outcome


def seconds_from_toe(ephemeris: Ephemeris, week: int, tow_s: float) -> float:
    """t - toe in s for a GPS time."""
    toe_week, toe = gps_time(ephemeris.system, ephemeris.week, ephemeris.toe_s)
    return (week - toe_week) * WEEK_S + (tow_s - toe)


def _delays(message: SignalDelays) -> tuple[object, ...]:
    return message.group_delay_s, message.correction_s


def _differs_only_in_time(a: Ephemeris, b: Ephemeris) -> bool:
    names = [n for n in Ephemeris.__match_args__ if n not in {"t_seen_ns", "source"}]
    return all(getattr(a, n) == getattr(b, n) for n in names)
