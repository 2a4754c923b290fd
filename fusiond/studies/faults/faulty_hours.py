"""Long runs with occasional faults of the library: reports during faults and between them.

The vehicles of `hours`, with the same noise for the same seed. Faults are those that alter a
recording over a window and need no other drive or configuration. The seed draws the fault and its
begin, `SPACING_S` after the previous begin. A fault that lasts to the end of the matrix's drive has
a drawn length (`LASTS_S`). With two receivers one, the other or both are at fault.

A fault answers for all that follows it until the next begins. It is noticed if an event or another
mode than `navigating` comes within `SETTLED_S` of its end. Quiet is every second in mode
`navigating` that is further from any fault: what is told then is a false alarm, and stands beside
what is stated for so many tests (`hours.rates`). A verdict judges the last hundred innovations, and
tells of the fault for `JUDGED_S` longer.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fusiond.studies.faults.error_sigma_score import (
    LIE_S,
    NAVIGATING,
    Course,
    Event,
    Sample,
    longest_lie_s,
    row_figures,
)
from fusiond.studies.faults.extra_faults import EVERY
from fusiond.studies.faults.hours import (
    HOUR_S,
    KINDS,
    USUAL,
    Kind,
    beyond_s,
    event_name,
    resident_mb,
    stated_per_h,
    tests_by_series,
)
from fusiond.studies.faults.library import TO_THE_END
from fusiond.studies.faults.measurement_faults import except_source
from fusiond.studies.faults.power import largest
from fusiond.studies.faults.runs import navigate
from fusiond.studies.faults.sensor_data import GNSS, SECOND, Recording, town

SPACING_S = (180.0, 480.0)
"""Least and largest interval between the starts of two faults, and before the first."""
LASTS_S = (20.0, 60.0)
"""Least and largest duration of faults that last to the end of the matrix's drive."""
SETTLED_S = 60.0
"""Time after a fault's end within which events belong to it."""
JUDGED_S = 100.0
"""Time (s) of a hundred fixes at one a second."""
RECEIVERS = (GNSS, SECOND)
NOTHING_WRONG = (*USUAL, "verdict_cannot_tell")


@dataclass(frozen=True, slots=True)
class TimedFault:
    """Fault of the library from `begin_s` to `end_s`, on all receivers or on all but one."""

    fault: str
    begin_s: float
    end_s: float
    spares: str | None = None

    def put_into(self, whole: Recording) -> Recording:
        """Recording with the fault."""
        alter = EVERY[self.fault].alter
        assert alter is not None
        if self.spares is not None:
            alter = except_source(alter, self.spares)
        return alter(whole, self.begin_s, self.end_s - self.begin_s)


def faults_of(kind: Kind) -> tuple[str, ...]:
    """Names of the faults that can affect a vehicle at any time."""
    return tuple(
        name
        for name, fault in EVERY.items()
        if fault.alter is not None and fault.configure is None and fault.begin_s is None
        if fault.drive.path is town and not (fault.drive.spare or fault.drive.second)
        if kind.drive.wheels or not fault.drive.wheels
    )


def timed_faults(kind: Kind, seed: int, duration_s: float) -> list[TimedFault]:
    """Faults of an hour; the last one begins before the end by the least spacing or more."""
    rng = np.random.default_rng([seed, 3])
    names, found = faults_of(kind), []
    begin_s = 0.0
    while (begin_s := round(begin_s + rng.uniform(*SPACING_S), 1)) <= duration_s - SPACING_S[0]:
        name = names[rng.integers(len(names))]
        fault, drawn_s = EVERY[name], round(rng.uniform(*LASTS_S))
        spares = (None, *RECEIVERS)[rng.integers(3)]
        length_s = drawn_s if fault.length_s == TO_THE_END else fault.length_s
        of_two = kind.drive.second and not fault.of_imu
        found.append(TimedFault(name, begin_s, begin_s + length_s, spares if of_two else None))
    return found


def faulty_hour_of(seed: int, duration_s: float = HOUR_S) -> dict[str, Any]:
    """Figures of an hour, whose kind follows from the seed: `row_figures` of each fault until the
    next, and figures of `hours.hour_of` for the quiet between faults."""
    name = tuple(KINDS)[seed % len(KINDS)]
    kind = KINDS[name]
    config = kind.config()
    truth, recording = kind.recorded(config, seed, duration_s)
    happened = timed_faults(kind, seed, duration_s)
    for happening in happened:
        recording = happening.put_into(recording)
    course = navigate(config, recording, truth)
    modes = [sample.mode for sample in course.samples]

    def calm(t_s: float, settled_s: float = SETTLED_S) -> bool:
        return not any(h.begin_s <= t_s <= h.end_s + settled_s for h in happened)

    def quiet(t_s: float, settled_s: float = SETTLED_S) -> bool:
        """True if quiet at an instant, by the mode of the last whole second before."""
        row = math.ceil(t_s) - 2
        return 0 <= row < len(modes) and modes[row] == NAVIGATING and calm(t_s, settled_s)

    def alarms(event: Event) -> bool:
        judged = SETTLED_S + JUDGED_S if event.code.startswith("verdict_") else SETTLED_S
        return event.code not in USUAL and quiet(event.t_s, judged)

    aligned = course.samples[modes.index(NAVIGATING) if NAVIGATING in modes else len(modes) :]
    samples = [s if calm(s.t_s) else replace(s, mode="", ratios=()) for s in aligned]
    reported = Counter(event_name(e.code, e.text) for e in course.events if alarms(e))
    ends = [*(h.begin_s for h in happened[1:]), duration_s]
    return {
        "kind": name,
        "seed": seed,
        "simulated_hours": duration_s / 3600.0,
        "faults": [
            _figures(course, happening, until_s)
            for happening, until_s in zip(happened, ends, strict=False)
            if happening.begin_s < len(modes)
        ],
        "hours": sum(s.mode == NAVIGATING for s in samples) / 3600.0,
        "told": dict(reported),
        "stated_per_h": stated_per_h(config),
        "tests": tests_by_series(r for r in recording.received if quiet(r.seen_ns * 1e-9)),
        "judged": tests_by_series(
            r for r in recording.received if quiet(r.seen_ns * 1e-9, SETTLED_S + JUDGED_S)
        ),
        "limits": kind.drive.second,
        "not_navigating_s": sum(s.mode not in ("", NAVIGATING) for s in samples),
        "beyond_s": beyond_s([s.ratios for s in samples if s.ratios]),
        "longest_lie_s": longest_lie_s(samples),
        "resident_mb": resident_mb(),
        "crash": course.crash,
    }


def _figures(course: Course, h: TimedFault, until_s: float) -> dict[str, Any]:
    """Figures of a fault, as if the course ended before the next, compared with a course without a
    report."""
    before = [s.mode for s in course.samples if s.t_s < h.begin_s]
    samples = [s for s in course.samples if h.begin_s <= s.t_s < until_s]
    events = [
        e for e in course.events if h.begin_s <= e.t_s < until_s and e.code not in NOTHING_WRONG
    ]
    usual = Course([Sample(s.t_s, NAVIGATING) for s in samples], ())
    found = row_figures(Course(samples, events), usual, h.begin_s, h.end_s)
    noticed_s = found.pop("noticed_s")
    in_time = noticed_s is not None and h.begin_s + noticed_s <= h.end_s + SETTLED_S
    return {
        "fault": h.fault,
        "spares": h.spares,
        "begin_s": h.begin_s,
        "end_s": h.end_s,
        "mode": before[-1],
        "noticed_s": noticed_s if in_time else None,
        **{key: value for key, value in found.items() if key not in ("verdict", "crash")},
    }


def by_fault(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Figures of `faulty_hour_of`, one line a fault in the library's order; faults that start in
    mode `navigating` can be noticed and recovered from."""
    happened = [fault for row in found for fault in row["faults"]]
    lines = []
    for name in EVERY:
        rows = [row for row in happened if row["fault"] == name]
        if not rows:
            continue
        started = [row for row in rows if row["mode"] == NAVIGATING]
        noticed = [row["noticed_s"] for row in started if row["noticed_s"] is not None]
        recovered = [row["recovered_s"] for row in started if row["recovered_s"] is not None]
        lines.append(
            {
                "fault": name,
                "times": len(rows),
                "begun": len(started),
                "noticed": len(noticed),
                "noticed_median_s": statistics.median(noticed) if noticed else None,
                "noticed_slowest_s": max(noticed, default=None),
                "recovered": len(recovered),
                "recovered_median_s": statistics.median(recovered) if recovered else None,
                "recovered_slowest_s": max(recovered, default=None),
                "largest_ratio": largest(rows, "largest_ratio"),
                "beyond_s": sum(row["beyond_s"] for row in rows),
                "lies": sum(row["longest_lie_s"] > LIE_S for row in rows),
                "longest_lie_s": max(row["longest_lie_s"] for row in rows),
            }
        )
    return lines
