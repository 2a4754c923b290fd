"""RINEX 3 and 4 navigation files: text to ephemerides and ionospheres; no I/O.

    3    Gnn yyyy mm dd hh mm ss, then numbers of 19 characters, four a line behind four blanks
    4    > EPH Gnn LNAV, > ION Gnn LNAV and so on before the same lines

In RINEX 3 a Galileo record has the source of its clock, I/NAV or F/NAV, in `data sources`; BeiDou's
are D1 or D2 by the satellite. RINEX 4 names the message: LNAV, INAV, FNAV, D1, D2, and BeiDou's
CNV1 and CNV2 are read, and of GPS's CNAV the delays; others are counted. Weeks are not read: toc
has a full date, and toe is the instant nearest to it. Source: RINEX 3.05, table A5 and following;
RINEX 4.01, tables A9 to A24.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

from drivers.raw.beidou_words import GEO
from drivers.raw.cnav_group_delay import SIGNALS as CNAV_SIGNALS
from drivers.raw.messages import (
    Bdgim,
    Ephemeris,
    Klobuchar,
    NavigationMessage,
    SignalDelays,
    System,
)
from drivers.raw.rinex import (
    LABEL,
    OTHERS,
    SYSTEMS,
    RinexError,
    gps_seconds,
    version_and_type,
)
from drivers.raw.subframes import RefusedError, check_orbit, week_of_toe
from drivers.raw.ubx import MAX_PRN
from drivers.raw.weeks import BDT_BEHIND_GPS_S, BDT_WEEK, HALF_WEEK_S, WEEK_S

_MESSAGES: dict[tuple[str, str], str] = {
    ("G", "LNAV"): "lnav",
    ("E", "INAV"): "inav",
    ("E", "FNAV"): "fnav",
    ("C", "D1"): "d1",
    ("C", "D2"): "d2",
    ("C", "CNV1"): "bcnav1",
    ("C", "CNV2"): "bcnav2",
}
"""Messages by system and RINEX 4's name."""
_ION: dict[tuple[str, str], System] = {("G", "LNAV"): "G", ("C", "D1D2"): "C"}
_ION_3: dict[str, tuple[System, int]] = {
    "GPSA": ("G", 0),
    "GPSB": ("G", 1),
    "BDSA": ("C", 0),
    "BDSB": ("C", 1),
}
_LINES, _LINES_CNAV, _LINES_GPS_CNAV = 8, 10, 9
"""Number of lines of a record, including the first."""
_TGD, _ISC = 25, 27
"""Places of delays in a record of GPS CNAV, after the clock's three numbers."""

# Places of numbers behind the clock's three; the first ones are the same in all messages.
_ORBIT = (
    ("crs", 4), ("mean_motion_correction", 5), ("mean_anomaly", 6), ("cuc", 7),
    ("eccentricity", 8), ("cus", 9), ("sqrt_a", 10), ("toe_s", 11), ("cic", 12),
    ("ascending_node", 13), ("cis", 14), ("inclination", 15), ("crc", 16), ("perigee", 17),
    ("ascending_node_rate", 18), ("inclination_rate", 19),
)  # fmt: skip


class Broadcast(NamedTuple):
    """Message of a satellite and its instant (GPS time, s since 1980-01-06)."""

    gps_s: float
    message: NavigationMessage


def navigation(source: str, text: str, counters: Counter[str]) -> list[Broadcast]:
    """Messages of a file in order. RinexError for any other file.

    Counts `ephemerides`, `ionospheres`, `records_unreadable`, `ephemeris_implausible`,
    `satellite_unknown`, and `<system>_not_used` or `<message>_not_used`.
    """
    version, kind = version_and_type(text)
    if kind != "N":
        raise RinexError(f"RINEX type {kind!r} has no ephemerides")
    head, _, body = text.partition("END OF HEADER")
    if not body:
        raise RinexError("its header has no end")
    found = _header_ionospheres(source, head)
    counters["ionospheres"] += len(found)
    lines = body.splitlines()[1:]
    for system, prn, name, record in _records(lines, version):
        try:
            taken = _taken(source, system, prn, name, record, counters)
        except RefusedError as refused:
            counters[str(refused)] += 1
        except (ValueError, OverflowError):
            counters["records_unreadable"] += 1
        else:
            found += [] if taken is None else [taken]
    return found


def _records(lines: list[str], version: float) -> Iterator[tuple[str, str, str, list[str]]]:
    """Records: system, number, "EPH LNAV" (RINEX 4) or "EPH" (3), and lines."""
    head, record = "", list[str]()
    for line in (*lines, ">" if version >= 4.0 else "X"):
        starts = line[:1] == ">" if version >= 4.0 else line[:1].isalpha()
        if not starts:
            record.append(line)
            continue
        if record and head:
            if version >= 4.0:
                words = head[1:].split()
                if len(words) >= 2:
                    kind, satellite, *rest = words
                    yield satellite[:1], satellite[1:], " ".join([kind, *rest[:1]]), record
            else:
                yield head[:1], head[1:3], "EPH", record
        head, record = line, [] if version >= 4.0 else [line]


def _taken(
    source: str, system: str, number: str, name: str, record: list[str], counters: Counter[str]
) -> Broadcast | None:
    kind, _, message = name.partition(" ")
    if kind == "ION":
        return _ionosphere(source, system, message, record, counters)
    if kind != "EPH":
        counters["records_not_used"] += 1
        return None
    if system not in SYSTEMS:
        counters[f"{OTHERS.get(system, 'unknown_system')}_not_used"] += 1
        return None
    prn = int(number)
    if not 1 <= prn <= MAX_PRN[SYSTEMS[system]]:
        raise RefusedError("satellite_unknown")
    if (system, message) == ("G", "CNAV"):
        delays = _signal_delays(source, prn, record)
        counters["signal_delays"] += 1
        return delays
    if message and (system, message) not in _MESSAGES:
        counters["gps_cnav_not_used" if system == "G" else "bcnav_not_used"] += 1
        return None
    known = _MESSAGES.get((system, message), "")
    found = _ephemeris(source, SYSTEMS[system], prn, known, record)
    counters["ephemerides"] += 1
    return found


def _numbers(record: list[str], first: int, wanted: int) -> list[float]:
    """Numbers of a record, in the first line from character `first` on; blanks are 0."""
    found: list[float] = []
    for k, line in enumerate(record):
        start = first if k == 0 else 4
        for at in range(start, start + 19 * (3 if k == 0 else 4), 19):
            text = line[at : at + 19].strip().replace("D", "E").replace("d", "e")
            value = float(text) if text else 0.0
            if not math.isfinite(value):
                raise ValueError(text)
            found.append(value)
    return found + [0.0] * (wanted - len(found))


def _ephemeris(source: str, system: System, prn: int, message: str, record: list[str]) -> Broadcast:
    cnav = message.startswith("bcnav")
    lines = _LINES_CNAV if cnav else _LINES
    if len(record) < lines:
        raise ValueError("too few lines")
    values = _numbers(record[:lines], 23, 4 * lines)
    own_s = gps_seconds(record[0][4:23].split())  # counted in the system's own time
    week, toc_s = divmod(own_s, WEEK_S)
    numbers: dict[str, Any] = {name: values[at] for name, at in _ORBIT}
    numbers |= dict(
        zip(("clock_bias_s", "clock_drift", "clock_drift_rate"), values[:3], strict=True)
    )
    toe_s = numbers["toe_s"]
    if not 0.0 <= toe_s < WEEK_S + 1:
        raise RefusedError("ephemeris_implausible")
    toe_week = week_of_toe(int(week), toc_s, toe_s)
    rest = _cnav(message, values) if cnav else _legacy(system, prn, message, values)
    sent_s = rest.pop("sent_s")
    found = Ephemeris(
        source=source,
        t_seen_ns=0,
        system=system,
        prn=prn,
        week=toe_week - (BDT_WEEK if system == "C" else 0),
        toc_s=toc_s,
        **numbers,
        **rest,
    )
    check_orbit(found)
    at_toe = toe_week * WEEK_S + toe_s + (BDT_BEHIND_GPS_S if system == "C" else 0)
    # A transmission time that cannot belong to this ephemeris is a filler, such as 0.9999e9.
    near = abs(sent_s - toe_s) < HALF_WEEK_S and sent_s != 0.0
    return Broadcast(at_toe + (sent_s - toe_s if near else 0.0), found)


def _legacy(system: System, prn: int, message: str, v: list[float]) -> dict[str, Any]:
    """Fields 19 on of LNAV, D1, D2, I/NAV and F/NAV: rate of inclination, source, week; accuracy,
    health, delays; transmission."""
    accuracy = v[23] if v[23] > 0.0 else None
    common: dict[str, Any] = {"accuracy_m": accuracy, "sent_s": v[27]}
    if system == "G":
        return common | {
            "message": "lnav",
            "group_delay_s": (v[25],),
            "issue": int(v[3]),
            "healthy": v[24] == 0.0,
        }
    if system == "C":
        return common | {
            "message": message or ("d2" if prn in GEO else "d1"),
            "group_delay_s": (v[25], v[26]),
            "issue": int(v[3]),
            "healthy": v[24] == 0.0,
        }
    sources, health = int(v[20]), int(v[24])
    if not message:
        message = "fnav" if sources & 0x102 and not sources & 0x205 else "inav"
    mask = 0b000111000 if message == "fnav" else 0b000000111
    return common | {
        "message": message,
        "group_delay_s": (v[25],) if message == "fnav" else (v[25], v[26]),
        "issue": int(v[3]),
        "healthy": health & mask == 0,
    }


def _cnav(message: str, v: list[float]) -> dict[str, Any]:
    """CNV1 and CNV2 of BeiDou. The ISC of the message's own data component is where it stands."""
    isc = v[27] if message == "bcnav1" else v[28]
    return {
        "message": message,
        "semi_major_rate": v[3],
        "mean_motion_rate": v[20],
        "group_delay_s": (v[29], v[30], isc),
        "issue": int(v[38]),
        "accuracy_m": None,
        # Health, and the integrity flags DIF and SIF (above AIF), of B-CNAV2 those of both signals.
        "healthy": v[32] == 0.0 and int(v[33]) & 0o66 == 0,
        "sent_s": v[35],
    }


def _signal_delays(source: str, prn: int, record: list[str]) -> Broadcast:
    """T_GD and ISC of GPS CNAV (table A14 of RINEX 4.01); a blank ISC is none."""
    if len(record) < _LINES_GPS_CNAV:
        raise ValueError("too few lines")
    values = _numbers(record[:_LINES_GPS_CNAV], 23, 4 * _LINES_GPS_CNAV)
    line = record[7].ljust(80)
    blank = [not line[at : at + 19].strip() for at in range(4, 80, 19)]
    isc = tuple(
        (name, values[_ISC + k])
        for k, names in enumerate(CNAV_SIGNALS)
        for name in names
        if not blank[k]
    )
    sent_s = gps_seconds(record[0][4:23].split())
    return Broadcast(sent_s, SignalDelays(source, 0, "G", prn, values[_TGD], isc))


# --------------------------------------------------------------------------- ionosphere


def _ionosphere(
    source: str, system: str, message: str, record: list[str], counters: Counter[str]
) -> Broadcast | None:
    wanted = _ION.get((system, message)) or ("C" if system == "C" and message == "D1D2" else None)
    if (system, message) == ("C", "CNVX"):
        sent_s = gps_seconds(record[0][4:23].split())
        a1, a2, a3, a4, a5, a6, a7, a8, a9 = _numbers(record, 23, 9)[:9]
        counters["ionospheres"] += 1
        return Broadcast(sent_s, Bdgim(source, 0, (a1, a2, a3, a4, a5, a6, a7, a8, a9)))
    if wanted is None:
        counters["ionosphere_not_used"] += 1
        return None
    sent_s = gps_seconds(record[0][4:23].split())
    v = _numbers(record, 23, 8)
    counters["ionospheres"] += 1
    return Broadcast(sent_s, _klobuchar(source, wanted, v[:4], v[4:8]))


def _klobuchar(source: str, system: System, alpha: list[float], beta: list[float]) -> Klobuchar:
    a0, a1, a2, a3 = alpha
    b0, b1, b2, b3 = beta
    return Klobuchar(source, 0, system, (a0, a1, a2, a3), (b0, b1, b2, b3))


def _header_ionospheres(source: str, head: str) -> list[Broadcast]:
    """RINEX 3's IONOSPHERIC CORR: the first of each system with both rows."""
    rows: dict[System, dict[int, list[float]]] = {}
    for line in head.splitlines():
        known = _ION_3.get(line[:4])
        if known is None or line[LABEL].strip() != "IONOSPHERIC CORR":
            continue
        try:
            values = [float(line[at : at + 12].replace("D", "E")) for at in range(5, 53, 12)]
        except ValueError:
            continue
        system, which = known
        rows.setdefault(system, {}).setdefault(which, values)
    return [
        Broadcast(0.0, _klobuchar(source, system, found[0], found[1]))
        for system, found in rows.items()
        if len(found) == 2
    ]
