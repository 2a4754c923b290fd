"""Conversion of RINEX 2 files to RINEX 3, text to text; no I/O.

    observations   C1 L1 P2 L2 D1 S1 ...      16 characters an observable as in 3, five a line
    epochs         yy mm dd hh mm ss.sssssss flag n and twelve satellites a line
    navigation     nn yy mm dd hh mm ss.s     numbers of 19 characters, one column further left

RINEX 2 names a band and, of GPS's codes, C (civil) or P: carriers, Dopplers and strengths are those
of the code that serves the band, C1 before P1, P2 before C2. Source: RINEX 2.11 and 2.12, tables A1
to A4; RINEX 3.05, table A23 (the names in 3).
"""

from __future__ import annotations

from collections.abc import Iterator

from drivers.raw.rinex import FIRST_LABEL, LABEL, RinexError

_SATELLITES_A_LINE = 12
_OBSERVABLES_A_LINE = 5
_WIDTH = 80
_SINCE_1900 = 80
"""Years from 80 on are of the last century: the standard's."""
_TYPES = "# / TYPES OF OBSERV"
_NOT_READ = "XXX"
"""An observable that the reader passes over."""
_CODES: dict[str, dict[str, str]] = {
    "G": {"C1": "1C", "P1": "1W", "C2": "2X", "P2": "2W", "C5": "5X"},
    "E": {"C1": "1X", "C5": "5X", "C7": "7X", "C8": "8X", "C6": "6X"},
    "C": {"C1": "2I", "C2": "2I", "C7": "7I", "C6": "6I"},
}
"""Signal of each kind of range, by system."""
_SERVES = {"1": ("C1", "P1"), "2": ("P2", "C2")}
"""Preferred range of a band with two kinds, the one of the carrier first."""


def as_version_3(text: str) -> str:
    """Convert a RINEX 2 file to 3.05; other text is unchanged. RinexError for an unsupported kind
    of file."""
    head, _, body = text.partition("\n")
    if head[LABEL].strip() != FIRST_LABEL:
        return text
    try:
        version = float(head[:20])
    except ValueError:
        return text
    if not 2.0 <= version < 3.0:
        return text
    kind, system = head[20:21], head[40:41].strip() or "G"
    lines = iter(body.splitlines())
    if kind == "O":
        found = list(_observations(lines, system))
    elif kind == "N" and system in ("G", "M"):
        found = list(_navigation(lines))
    else:
        raise RinexError(f"RINEX 2 of type {kind!r} is not read: observations and GPS's navigation")
    first = f"{3.05:9.2f}{'':11}{kind:20}{system:20}{FIRST_LABEL}"
    return "\n".join([first, *found, ""])


# --------------------------------------------------------------------------- observations


def _observations(lines: Iterator[str], system: str) -> Iterator[str]:
    types: list[str] = []
    for line in lines:
        label = line[LABEL].strip()
        if label == _TYPES:
            types = _types(line, types)
        elif label == "END OF HEADER":
            yield from _named(types)
            yield line
            break
        else:
            yield line
    a_satellite = -(-len(types) // _OBSERVABLES_A_LINE)
    for line in lines:
        try:
            flag, number = int(line[28:29].strip() or "0"), int(line[29:32])
            when = _date(line) if flag <= 1 or line[1:26].strip() else ""
        except ValueError:
            yield line  # the reader counts lines that are no epoch
            continue
        if flag == 6:  # cycle slips, in the form of observations
            for _ in range(len(_satellites(line, number, lines, system)) * a_satellite):
                next(lines, "")
            continue
        if flag > 1:
            events = [next(lines, "") for _ in range(number)]
            renamed = list[str]()
            for event in events:
                if event[LABEL].strip() == _TYPES:
                    renamed = _types(event, renamed)
            if renamed:
                types, a_satellite = renamed, -(-len(renamed) // _OBSERVABLES_A_LINE)
                events = [e for e in events if e[LABEL].strip() != _TYPES] + list(_named(types))
            yield f">{when:28}  {flag}{len(events):3}"
            yield from events
            continue
        satellites = _satellites(line, number, lines, system)
        yield f">{when:28}  {flag}{len(satellites):3}"
        for satellite in satellites:
            values = "".join(next(lines, "")[:_WIDTH].ljust(_WIDTH) for _ in range(a_satellite))
            yield satellite + values


def _types(line: str, before: list[str]) -> list[str]:
    """Observables of a header line appended to those before; a number starts a new list."""
    return ([] if line[:6].strip() else before) + line[6:60].split()


def _named(types: list[str]) -> Iterator[str]:
    """RINEX 3's list of observables of each system: nine lines hold the most that RINEX 2 knows."""
    for system, codes in _CODES.items():
        names = [_name(kind, types, codes) for kind in types]
        for at in range(0, len(names), 13):
            first = f"{system}  {len(names):3}" if at == 0 else " " * 6
            row = "".join(f" {name}" for name in names[at : at + 13])
            yield f"{first + row:60}SYS / # / OBS TYPES"


def _name(kind: str, types: list[str], codes: dict[str, str]) -> str:
    if len(kind) != 2:
        return _NOT_READ
    letter, band = kind[0], kind[1]
    if letter in "CP":
        return f"C{codes[kind]}" if kind in codes else _NOT_READ
    served = [name for name in _SERVES.get(band, ()) if name in types and name in codes]
    code = codes.get(served[0] if served else f"C{band}")
    return f"{letter}{code}" if code is not None and letter in "LDS" else _NOT_READ


def _satellites(line: str, number: int, lines: Iterator[str], system: str) -> list[str]:
    found: list[str] = []
    for k in range(number):
        at = k % _SATELLITES_A_LINE
        if k and not at:
            line = next(lines, "")
        letter, prn = line[32 + 3 * at : 33 + 3 * at], line[33 + 3 * at : 35 + 3 * at]
        own = "G" if system == "M" else system
        found.append(f"{letter.strip() or own}{prn.strip():>02}")
    return found


def _year(text: str) -> int:
    short = int(text)
    return short + (1900 if short >= _SINCE_1900 else 2000)


def _date(line: str) -> str:
    """Date in RINEX 3's format."""
    month, day, hour, minute = (int(line[at : at + 3]) for at in (3, 6, 9, 12))
    second = float(line[15:26])
    return f" {_year(line[1:3]):04} {month:02} {day:02} {hour:02} {minute:02}{second:11.7f}"


# --------------------------------------------------------------------------- navigation


def _navigation(lines: Iterator[str]) -> Iterator[str]:
    for line in lines:
        label = line[LABEL].strip()
        if label in ("ION ALPHA", "ION BETA"):
            name = "GPSA" if label == "ION ALPHA" else "GPSB"
            yield f"{name} {line[2:50]:55}IONOSPHERIC CORR"
            continue
        yield line
        if label == "END OF HEADER":
            break
    for line in lines:
        if not line[:2].strip():
            yield f" {line}"
            continue
        try:
            prn = int(line[:2])
            month, day, hour, minute = (int(line[at : at + 3]) for at in (5, 8, 11, 14))
            when = f"{_year(line[2:5])} {month:02} {day:02} {hour:02} {minute:02}"
            second = round(float(line[17:22]))
        except ValueError:
            yield f"X{line}"  # the reader counts lines that are no record
            continue
        yield f"G{prn:02} {when} {second:02}{line[22:]}"
