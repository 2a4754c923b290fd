"""Channels of a log as arrays. A value that is not a number becomes NaN."""

from __future__ import annotations

from collections import Counter
from math import isfinite, isnan, nan
from typing import Any, NamedTuple

import numpy as np

from fusiond.clock.host import SECOND_NS
from fusiond.files.csv_tables import Floats
from fusiond.report.run import Estimated, Fault, Innovations, Sky, Verdicts


def number(value: object) -> float:
    """Convert a JSON value to a float; NaN for null and for a value that is not a number."""
    return float(value) if isinstance(value, int | float) and isfinite(value) else nan


def _objects(said: dict[str, Any], key: str) -> dict[str, dict[str, Any]]:
    """Values of the object `key` that are objects."""
    found = said.get(key)
    if not isinstance(found, dict):
        return {}
    return {name: value for name, value in found.items() if isinstance(value, dict)}


def _rows(rows: list[tuple[float, ...]], width: int) -> Floats:
    table: Floats = np.array(rows, dtype=np.float64).reshape(len(rows), width)
    return table


def _numbers(value: object) -> list[float]:
    return [number(v) for v in value] if isinstance(value, list) else []


def _ragged(rows: list[list[float]]) -> Floats:
    """Table of rows with different lengths, padded with NaN."""
    table: Floats = np.full((len(rows), max(map(len, rows))), nan)
    for k, row in enumerate(rows):
        table[k, : len(row)] = row
    return table


class _Ended(NamedTuple):
    delay_s: float
    outcome: str
    nis: float
    degrees: float
    whitened: list[float]
    raw: list[float]
    unit: str
    axes: str


class InnovationLists:
    """Rows of `/innovation`. A delayed measurement rewinds the filter, which repeats later
    measurements: the last outcome counts, with the first time of arrival."""

    def __init__(self, epoch_ns: int) -> None:
        self._epoch_ns = epoch_ns
        self._ended: dict[str, dict[int, _Ended]] = {}

    def read(self, t_s: float, said: dict[str, Any]) -> None:
        t_ns, source = said.get("t_ns"), said.get("source")
        if not isinstance(t_ns, int) or not isinstance(source, str):
            return
        ended = self._ended.setdefault(source, {})
        valid_s = (t_ns + self._epoch_ns) / SECOND_NS
        ended[t_ns] = _Ended(
            ended[t_ns].delay_s if t_ns in ended else t_s - valid_s,
            str(said.get("outcome", "")),
            number(said.get("nis")),
            number(said.get("degrees")),
            _numbers(said.get("whitened")),
            _numbers(said.get("raw")),
            *(str(said.get(name) or "") for name in ("unit", "axes")),
        )

    def by_source(self) -> dict[str, Innovations]:
        return {source: self._of(ended) for source, ended in self._ended.items()}

    def _of(self, ended: dict[int, _Ended]) -> Innovations:
        times = sorted(ended)
        rows = [ended[t] for t in times]
        return Innovations(
            t_s=np.array([(t + self._epoch_ns) / SECOND_NS for t in times]),
            delay_s=np.array([row.delay_s for row in rows]),
            nis=np.array([row.nis for row in rows]),
            degrees=np.array([row.degrees for row in rows]),
            whitened=_ragged([row.whitened for row in rows]),
            outcome=[row.outcome for row in rows],
            raw=_ragged([row.raw for row in rows]),
            unit=next((row.unit for row in rows if row.unit), ""),
            axes=next((row.axes for row in rows if row.unit), ""),
        )


class VerdictLists:
    """Rows of `/consistency`."""

    def __init__(self) -> None:
        self._rows: dict[str, list[tuple[float, ...]]] = {}
        self._verdicts: dict[str, list[str]] = {}

    def read(self, t_s: float, said: dict[str, Any]) -> None:
        for source, one in _objects(said, "sources").items():
            rho = one.get("rho")
            first = rho[0] if isinstance(rho, list) and rho else None
            figures = (*(one.get(f"nis_{k}") for k in ("average", "low", "high")), first)
            row = (t_s, *map(number, (*figures, one.get("rho_high"))))
            self._rows.setdefault(source, []).append(row)
            self._verdicts.setdefault(source, []).append(str(one.get("verdict", "")))

    def by_source(self) -> dict[str, Verdicts]:
        found = {}
        for source, rows in self._rows.items():
            t_s, average, low, high, rho_1, rho_high = _rows(rows, 6).T
            words = self._verdicts[source]
            found[source] = Verdicts(t_s, average, low, high, rho_1, rho_high, words)
        return found


class Calibrations:
    """Rows of `/calibration`; a parameter's name ends with its unit, or has none for a ratio."""

    def __init__(self) -> None:
        self._rows: dict[str, list[tuple[float, ...]]] = {}
        self._states: dict[str, str] = {}

    def read(self, t_s: float, said: dict[str, Any]) -> None:
        for name, one in _objects(said, "parameters").items():
            row = (t_s, number(one.get("value")), number(one.get("sd")))
            self._rows.setdefault(name, []).append(row)
            self._states[name] = str(one.get("state", ""))

    def by_name(self) -> dict[str, Estimated]:
        found = {}
        for name, rows in self._rows.items():
            unit = name.rpartition("_")[2]
            known = unit if unit in ("m", "s", "deg") else "1"
            t_s, value, sd = _rows(rows, 3).T
            found[name] = Estimated(known, t_s, value, sd, self._states[name])
        return found


class Healths:
    """Rows of `/health`: last outcomes and counters; satellites, delays, CPU and memory over
    time."""

    def __init__(self) -> None:
        self.outcomes: dict[str, dict[str, int]] = {}
        self.counters: dict[str, dict[str, int]] = {}
        self._usage: list[tuple[float, ...]] = []
        self._latency: dict[str, list[tuple[float, ...]]] = {}
        self._sky: dict[str, list[tuple[float, ...]]] = {}
        self._reasons: dict[str, Counter[str]] = {}
        self.service: dict[str, Counter[str]] = {}
        """Messages in each state of service, by source."""

    def read(self, t_s: float, said: dict[str, Any]) -> None:
        self._usage.append((t_s, number(said.get("cpu_percent")), number(said.get("memory_mb"))))
        for source, one in _objects(said, "sources").items():
            rejected = _counts(one.get("rejected"))
            self.outcomes[source] = {"fused": _count(one.get("fused")), **rejected}
            self.counters[source] = _counts(one.get("counters"))
            if isinstance(state := one.get("service"), str):
                self.service.setdefault(source, Counter())[state] += 1
            latency = number(one.get("latency_s"))
            if not isnan(latency):
                self._latency.setdefault(source, []).append((t_s, latency))
            sky = one.get("sky")
            if isinstance(sky, dict):
                self._sky_of(source, t_s, sky)

    def _sky_of(self, source: str, t_s: float, sky: dict[str, Any]) -> None:
        used, refused = sky.get("used"), sky.get("refused")
        used = used if isinstance(used, list) else []
        refused = refused if isinstance(refused, dict) else {}
        row = (t_s, float(len(used)), float(len(refused)), number(sky.get("pdop")))
        self._sky.setdefault(source, []).append(row)
        self._reasons.setdefault(source, Counter()).update(map(str, refused.values()))

    def usage(self) -> tuple[Floats, Floats, Floats] | None:
        if not self._usage:
            return None
        t_s, cpu, memory = _rows(self._usage, 3).T
        return t_s, cpu, memory

    def latency(self) -> dict[str, tuple[Floats, Floats]]:
        tables = {source: _rows(rows, 2) for source, rows in self._latency.items()}
        return {source: (table[:, 0], table[:, 1]) for source, table in tables.items()}

    def sky(self) -> dict[str, Sky]:
        found = {}
        for source, rows in self._sky.items():
            t_s, used, refused, pdop = _rows(rows, 4).T
            found[source] = Sky(t_s, used, refused, pdop, dict(self._reasons[source]))
        return found


class FaultLists:
    """Faults from `/status`: each lasts from its first message to the last one in a row."""

    def __init__(self) -> None:
        self.found: list[Fault] = []
        self._now: dict[tuple[str, ...], Fault] = {}

    def read(self, t_s: float, said: dict[str, Any]) -> None:
        faults = said.get("faults")
        before, self._now = self._now, {}
        for one in faults if isinstance(faults, list) else ():
            if not isinstance(one, dict):
                continue
            source, kind, axis, unit, action = (
                str(one.get(k) or "") for k in ("source", "kind", "axis", "unit", "action")
            )
            key = source, kind, action
            fault = before.get(key)
            if fault is None:
                started_s = t_s - number(one.get("since_s"))
                fault = Fault(source, kind, started_s, t_s)
                self.found.append(fault)
            fault.last_s, fault.axis, fault.unit, fault.action = t_s, axis, unit, action
            fault.size, fault.sd = number(one.get("size")), number(one.get("sd"))
            fault.log_odds = number(one.get("log_odds"))
            self._now[key] = fault


def _count(value: object) -> int:
    found = number(value)
    return 0 if isnan(found) else int(found)


def _counts(value: object) -> dict[str, int]:
    if not isinstance(value, dict):
        return {}
    return {str(name): _count(count) for name, count in value.items()}
