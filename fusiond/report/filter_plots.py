"""Plots of the filter's agreement with its inputs: innovations, verdicts, delays, satellites."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fusiond.files.csv_tables import Floats
from fusiond.report.page_items import Item, Plot, Section, Sentence, Series, Table
from fusiond.report.run import Innovations, LogParts, Run

_AXES = {"n": "north", "e": "east", "d": "down"}
_MOST_ROWS = 3
"""Most rows of an innovation that are plotted singly; an epoch of pseudoranges is shown by its NIS.
"""
_BINS = 60
_CONSTRAINT = (
    "Good: far below 1, and slow: a constraint's sigma is what the vehicle may do at most, and no"
    " verdict is made of it. What is refused stands alone."
)
LEAST_NIS = 1e-3
"""Least NIS on the logarithmic axis; smaller values carry no information."""


def innovations(run: Run) -> Section | None:
    if run.log is None:
        return None
    items: list[tuple[str, Item]] = []
    judged = {s: i for s, i in run.log.innovations.items() if np.isfinite(i.nis).any()}
    if not judged:
        return Section("Innovations", [("none", Sentence("The log holds no innovation."))])
    items.append(("shares", _shares(judged)))
    for source, found in judged.items():
        items += _of_source(source, found, _is_judged(run.log, source))
    rest = sorted(set(run.log.innovations) - set(judged))
    if rest:
        text = f"No innovation was computed of {', '.join(rest)}: see the outcomes above."
        items.append(("rest", Sentence(text)))
    if not any(found.raw.size for found in judged.values()):
        text = "An earlier version wrote this log: its innovations are whitened, not in metres."
        items.append(("raw", Sentence(text)))
    return Section("Innovations", items)


def _is_judged(log: LogParts, source: str) -> bool:
    """True if the log has a verdict on the source or on a part of it; constraints have none."""
    return not log.verdicts or any(f"{name}_".startswith(f"{source}_") for name in log.verdicts)


def _of_source(source: str, found: Innovations, judged: bool) -> list[tuple[str, Item]]:
    fused = found.fused
    per_degree = found.nis / np.where(found.degrees > 0, found.degrees, np.nan)
    per_degree = np.maximum(per_degree, LEAST_NIS)
    accepted = Series("accepted", np.where(fused, per_degree, np.nan), "points")
    refused = Series("refused", np.where(fused, np.nan, per_degree), "refused")
    drawn = [s for s in (accepted, refused) if np.isfinite(s.values).any()]
    good = (
        f"Good: around 1, with {LEAST_NIS:g} and less at the bottom; what is refused stands alone."
        " A slow rise is a fault that creeps in."
    )
    if not judged:
        good = _CONSTRAINT
    nis = Plot(
        f"NIS a degree of freedom, {source}", "1", found.t_s, drawn, good, log=True, levels=[1.0]
    )
    items: list[tuple[str, Item]] = [(f"nis_{source}", nis)]
    rows = found.whitened.shape[1]
    if not 0 < rows <= _MOST_ROWS:
        return items
    good = "Good: noise around 0 without a trend: two of three points within 1, 95 % within 2."
    if not judged:
        good = _CONSTRAINT
    series = _by_row(found.whitened, fused, [f"row {k + 1}" for k in range(rows)])
    title = f"Normalised innovation, {source}"
    plot = Plot(title, "sigma", found.t_s, series, good, levels=[-2.0, 0.0, 2.0])
    return [(f"whitened_{source}", plot), *_raw(source, found), *items]


def _raw(source: str, found: Innovations) -> list[tuple[str, Item]]:
    """Plot of innovations in metres or m/s, where the source measures them."""
    count = found.raw.shape[1]
    if not 0 < count <= _MOST_ROWS:
        return []
    names = [_AXES[axis] for axis in found.axes if axis in _AXES]
    if len(names) != count:
        names = [f"row {k + 1}" for k in range(count)]
    series = _by_row(found.raw, found.fused, names)
    title = f"Innovation, {source}: estimate minus measurement"
    good = (
        "Good: noise around 0, as large as the data sheet says. What lasts is a datum, or a delay"
        " if it goes with the speed; what turns with the heading is a lever arm."
    )
    return [(f"raw_{source}", Plot(title, found.unit, found.t_s, series, good, levels=[0.0]))]


def _by_row(values: Floats, fused: np.ndarray[Any, Any], names: Sequence[str]) -> list[Series]:
    """Series of accepted and rejected measurements in one colour."""
    series: list[Series] = []
    for k, name in enumerate(names):
        series.append(Series(name, np.where(fused, values[:, k], np.nan), "points"))
        left = np.where(fused, np.nan, values[:, k])
        if np.isfinite(left).any():
            series.append(Series(f"{name}, refused", left, "refused", like=len(series) - 1))
    return series


def _shares(judged: dict[str, Innovations]) -> Item:
    """Distribution of the normalised innovations of fused measurements."""
    rows = []
    for source, found in judged.items():
        values = found.whitened[found.fused]
        values = values[np.isfinite(values)]
        refused = int((~found.fused & np.isfinite(found.nis)).sum())
        if len(values):
            one, two = (f"{100 * float(np.mean(np.abs(values) <= k)):.1f} %" for k in (1.0, 2.0))
            spread = float(np.sqrt(np.mean(values**2)))
            fused = int(found.fused.sum())
            rows.append([source, str(fused), str(refused), one, two, f"{spread:.2f}"])
    head = ("source", "fused", "refused by their innovation", "within 1 sigma", "within 2", "RMS")
    good = (
        "Good: 68.3 %, 95.4 %, RMS 1. A smaller RMS: sigma is too large, as a constraint's is; a"
        " larger: too small."
    )
    return Table("How they are spread", head, rows, good)


def verdicts(run: Run) -> Section | None:
    if run.log is None:
        return None
    if not run.log.verdicts:
        text = "The log holds no `/consistency`."
        return Section("Verdicts", [("none", Sentence(text))])
    items: list[tuple[str, Item]] = []
    last = [
        [source, v.verdict[-1], _figure(v.nis_average[-1]), _figure(v.rho_1[-1])]
        for source, v in run.log.verdicts.items()
    ]
    wrong = frozenset(k for k, row in enumerate(last) if row[1] not in ("consistent", "too_few"))
    head = ("source", "verdict", "NIS average", "rho(1)")
    good = "Good: `consistent`. `optimistic`: the filter's sigma is too small, do not trust it."
    items.append(("last", Table("At the end", head, last, good, wrong)))
    for source, v in run.log.verdicts.items():
        if not np.isfinite(v.nis_average).any():
            text = f"Verdict of {source}: too few innovations."
            items.append((f"verdict_{source}", Sentence(text)))
            continue
        nis = [
            Series("NIS average", v.nis_average),
            Series("95 % from", v.nis_low, "bound", 0),
            Series("95 % to", v.nis_high, "bound", 0),
        ]
        good = "Good: between the dashed lines. Above: sigma is too small; below: too large."
        plot = Plot(f"NIS average of the window, {source}", "1", v.t_s, nis, good)
        items.append((f"verdict_{source}", plot))
        rho = [
            Series("rho(1)", v.rho_1),
            Series("95 % to", v.rho_high, "bound", 0),
            Series("95 % from", -v.rho_high, "bound", 0),
        ]
        good = "Good: between the dashed lines; above: errors last from one epoch to the next."
        plot = Plot(f"Autocorrelation at lag 1, {source}", "1", v.t_s, rho, good)
        items.append((f"rho_{source}", plot))
    return Section("Verdicts", items)


def delays(run: Run) -> Section | None:
    if run.log is None:
        return None
    items: list[tuple[str, Item]] = []
    for source in run.log.sources:
        found = run.log.innovations.get(source)
        if found is None:
            continue
        # What came before the alignment was kept until then.
        waited = np.array([name == "no_alignment" for name in found.outcome])
        if waited.all():
            continue
        items.append((f"delay_{source}", _histogram(source, found.delay_s[~waited])))
        counters = run.log.counters.get(source, {})
        if "requested" in counters:
            items.append((f"cycle_{source}", _cycle(source, counters)))
    for source, (t_s, latency_s) in run.log.latency.items():
        if f"delay_{source}" not in dict(items):
            series = [Series("last sample", 1e3 * latency_s)]
            good = "Good: constant. A rise means a bus or a host that is too busy."
            plot = Plot(f"From validity to arrival, {source}", "ms", t_s, series, good)
            items.append((f"latency_{source}", plot))
    if not items:
        items.append(("none", Sentence("No measurement's delay is known.")))
    return Section("Delays", items)


def _histogram(source: str, delay_s: Floats) -> Plot:
    delay_ms = 1e3 * delay_s
    edges = np.histogram_bin_edges(delay_ms, bins=_BINS)
    counts = np.histogram(delay_ms, edges)[0].astype(np.float64)
    middle = 0.5 * (edges[1:] + edges[:-1])
    good = (
        f"Good: one narrow hump (median here {float(np.median(delay_ms)):.0f} ms); RDSS: the"
        " request cycle, 0.6 to 5 s. A tail to the right is a busy line or host."
    )
    title = f"Delay from validity to the filter, {source}"
    series = [Series("count", counts, "bars")]
    return Plot(title, "measurements", middle, series, good, x_label="ms", log=True)


def _cycle(source: str, counters: dict[str, int]) -> Table:
    """Outcomes of the requests, as the driver counts them."""
    head = ("counter", "count")
    rows = [[name, str(count)] for name, count in counters.items()]
    good = "Good: as many `fixes` as `requested`."
    return Table(f"Request cycle, {source}: the driver's counters", head, rows, good)


def satellites(run: Run) -> Section | None:
    if run.log is None:
        return None
    items: list[tuple[str, Item]] = []
    for source, sky in run.log.sky.items():
        series = [Series("used", sky.used, "steps"), Series("refused", sky.refused, "steps")]
        good = "Good: many more used than refused; at least five used, for a check of them all."
        items.append((f"sky_{source}", Plot(f"Satellites, {source}", "", sky.t_s, series, good)))
        if np.isfinite(sky.pdop).any():
            good = "Good: below 3."
            plot = Plot(f"PDOP, {source}", "1", sky.t_s, [Series("PDOP", sky.pdop)], good, log=True)
            items.append((f"pdop_{source}", plot))
        if sky.reasons:
            ordered = sorted(sky.reasons.items(), key=lambda pair: -pair[1])
            rows = [[reason, str(count)] for reason, count in ordered]
            head = ("reason", "satellites, over the health messages")
            items.append((f"refused_{source}", Table(f"Why refused, {source}", head, rows)))
    if not items:
        text = "No receiver of this run gives raw data: which satellites it used, it does not tell."
        items.append(("none", Sentence(text)))
    return Section("Satellites", items)


def _figure(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "too few"
