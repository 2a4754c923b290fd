"""First sections: summary of the run, outcomes of each source's measurements, track."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from fusiond.files.measurement_csv import TrajectoryTable
from fusiond.integrity.series_states import Service
from fusiond.navigation.solution import Mode
from fusiond.report.local_plane import metres_from, origin_of
from fusiond.report.page_items import Item, Section, Sentence, Table, Track
from fusiond.report.run import Run

MODES = tuple(str(mode) for mode in Mode)
SERVICES = tuple(str(state) for state in Service)
MARKED_FROM = 0.05
"""Share of rejections that is marked: a gate rejects 1e-4 by its default."""
_NO_FAULT = frozenset(
    (
        *("start", "no_alignment", "no_imu", "moving", "turning", "turns_at_rest"),
        *("quiet_at_speed", "too_slow", "height_held", "no_attitude"),
    )
)
"""Outcomes without evidence against the source: it could not be used at that instant."""
TRACK_POINTS = 4000
"""Most points of the plotted track; it is 700 pixels wide."""


def summary(run: Run) -> Section:
    first, last = run.span_s
    length = [("duration", f"{last - first:.1f} s"), ("distance", _distance(run.solution))]
    items: list[tuple[str, Item]] = [
        ("facts", Table("Run", ("", ""), [*run.facts, *length])),
        ("modes", _modes(run)),
        ("outcomes", _outcomes(run)),
        ("service", _service(run)),
        ("faults", _faults(run)),
        ("events", _events(run)),
        ("differs", _differs(run)),
    ]
    return Section("Summary", items)


def track(run: Run, truth: TrajectoryTable | None) -> Section:
    origin = origin_of(run.solution)
    if origin is None:
        return Section("Track", [("track", Sentence("No position is known at any instant."))])
    s = run.solution
    known = np.flatnonzero(np.isfinite(s.lat_rad))
    chosen = known[:: max(1, -(-len(known) // TRACK_POINTS))]
    metres = metres_from(origin, s)[chosen]
    status = s.status or [""] * len(s.t_s)
    places = {mode: float(k) for k, mode in enumerate(MODES)}
    beside = None
    if truth is not None:
        beside = metres_from(origin, truth)[:: max(1, -(-len(truth.t_s) // TRACK_POINTS)), :2]
    item = Track(
        t_s=s.t_s[chosen],
        north=metres[:, 0],
        east=metres[:, 1],
        sd_n=s.sd_position[chosen, 0],
        sd_e=s.sd_position[chosen, 1],
        mode=np.array([places.get(status[k], -1.0) for k in chosen]),
        good="Good: one smooth line without jumps; the ellipses (2 sigma, axes north and east) are"
        " small beside the road, grow where measurements are missing and shrink when they return"
        + ("; the truth (grey) runs inside them." if beside is not None else "."),
        truth=beside,
    )
    return Section("Track", [("track", item)])


def _distance(solution: TrajectoryTable) -> str:
    """Distance by integrated speed over ground: positions of a vehicle at rest drift, its speed
    stays zero."""
    speed = np.hypot(solution.v[:, 0], solution.v[:, 1])
    known = np.isfinite(speed)
    if known.sum() < 2:
        return "no velocity in the file"
    metres = float(np.trapezoid(speed[known], solution.t_s[known]))
    return f"{metres / 1000.0:.2f} km over ground" if metres >= 1000.0 else f"{metres:.1f} m"


def _modes(run: Run) -> Item:
    lengths: Counter[str] = Counter()
    for started, ended, mode in run.modes():
        lengths[mode] += ended - started  # type: ignore[assignment]
    total = sum(lengths.values())
    if not total:
        return Sentence("The file does not say in which mode each row is.")
    times = Counter(mode for *_, mode in run.modes())
    rows = [
        [mode, f"{100.0 * s / total:.1f} %", f"{s:.1f} s", str(times[mode])]
        for mode, s in sorted(lengths.items(), key=lambda pair: -pair[1])
    ]
    good = "Good: `navigating` from the alignment to the end; `coasting` only without measurements."
    return Table("Modes", ("mode", "share", "time", "times entered"), rows, good)


def _outcomes(run: Run) -> Item:
    if run.log is None:
        return Sentence(
            "A solution file does not hold what became of each measurement: outcomes, innovations,"
            " biases, verdicts, delays, satellites, and the look at the inertial unit and the"
            " computer need a log (`fusiond run --record`)."
        )
    outcomes = run.log.outcomes
    if not outcomes:
        return Sentence("The log holds no `/health`: what became of the measurements is not known.")
    names = sorted({name for counts in outcomes.values() for name in counts} - {"fused"})
    names = [name for name in names if any(c.get(name) for c in outcomes.values())]
    rows, wrong = [], set()
    for k, (source, counts) in enumerate(outcomes.items()):
        rows.append([source, *(str(counts.get(name, 0)) for name in ("fused", *names))])
        refused = sum(n for name, n in counts.items() if name not in ("fused", *_NO_FAULT))
        if refused > MARKED_FROM * (refused + counts.get("fused", 0)):
            wrong.add(k)
    return Table(
        "What became of the measurements, since the daemon's start",
        ("source", "fused", *names),
        rows,
        "Good: nearly all `fused`; `no_alignment` only before the start, `gated` about as often as"
        " the gate's probability says. Marked: more than a twentieth was refused for what it said.",
        frozenset(wrong),
    )


def _service(run: Run) -> Item:
    if run.log is None or not run.log.service:
        return Sentence("Nothing here says which sources were in service.")
    rows, wrong = [], set()
    for k, (source, counts) in enumerate(run.log.service.items()):
        shares = [counts[state] / counts.total() for state in SERVICES]
        rows.append([source, *(f"{100.0 * share:.1f} %" for share in shares)])
        if counts["out"]:
            wrong.add(k)
    good = "Good: all `nominal`, now and then `suspected`. Marked: it was out of service."
    title = "Service of each source (of a device the worst of what it sends), share of the time"
    return Table(title, ("source", *SERVICES), rows, good, frozenset(wrong))


def _faults(run: Run) -> Item:
    if run.log is None:
        return Sentence("A solution file does not hold what was found to be at fault.")
    if not run.log.faults:
        return Sentence("No fault was identified.")
    first = run.span_s[0]
    rows = [
        [
            *(f.source, f.kind, f"{f.started_s - first:.1f}", f"{f.last_s - first:.1f}", f.axis),
            *(f"{f.size:.4g} {f.unit}", f"{f.sd:.2g}", f"{f.log_odds:.1f}", f.action),
        ]
        for f in run.log.faults
    ]
    head = ("source", "kind", "began s", "told until s", "axis", "size", "one sigma", "log odds")
    return Table(
        "Faults",
        (*head, "what was done"),
        rows,
        "Good: none. Each should have an explanation; a size many sigma large is a certain one.",
        frozenset(range(len(rows))),
    )


def _events(run: Run) -> Item:
    if run.log is None:
        return Sentence("A solution file holds no events; its changes of mode are the background.")
    if not run.events:
        return Sentence("No events.")
    first = run.span_s[0]
    rows = [[f"{e.t_s - first:.2f}", e.level, e.source, e.code, e.text] for e in run.events]
    wrong = frozenset(k for k, e in enumerate(run.events) if e.level == "error")
    return Table(
        "Events",
        ("s", "level", "source", "code", "text"),
        rows,
        "Good: no errors, and each warning has an explanation. They are the marks in the plots.",
        wrong,
    )


def _differs(run: Run) -> Item:
    if run.log is None:
        return Sentence("A solution file does not hold the configuration.")
    if run.differs is None:
        return Sentence("The log holds no configuration that can be read.")
    if not run.differs:
        return Sentence("The configuration is the default.")
    rows: Sequence[Sequence[str]] = [
        [d.key, d.value, "must be given" if d.default is None else d.default] for d in run.differs
    ]
    return Table(
        "What differs from the default configuration of this version",
        ("key", "value", "default"),
        rows,
    )
