r"""Score of a run with a fault: error against stated sigma, second by second.

    ratio = max over axes of |error| / sigma

of each quantity: horizontal position (north, east), height, horizontal velocity (north, east), yaw,
tilt (roll, pitch). An axis is compared with its own sigma, so that the ratio means the same however
the axes are correlated: chance passes 5 about once in a million. Where error or sigma is not a
finite number, or sigma is not positive, the ratio is infinite.

A sample stands for the time until the next. The verdict is the first of these that holds:

`crashed`       an exception left the navigator
`lie`           some ratio above 5, unbroken for over 2 s, in any mode that publishes a solution:
                `coasting` and `invalid` state a sigma, too
`degraded and said so`   the fault was noticed
`survived`      none of them

Noticed: the first event from the fault's begin on that the same drive without the fault does not
have, or the first sample whose mode differs from that drive's. Recovered: from the fault's end, the
time to the first of five samples in a row with mode `navigating` and no ratio above 5.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

QUANTITIES = ("horizontal", "height", "velocity", "yaw", "tilt")
MOST_SIGMA = 5.0
LIE_S = 2.0
SETTLED_SAMPLES = 5
NAVIGATING = "navigating"
Verdict = Literal["crashed", "lie", "degraded and said so", "survived"]


@dataclass(frozen=True, slots=True)
class Sample:
    """Sample of a run at an instant: mode, ratio of error to sigma by quantity, errors."""

    t_s: float
    mode: str
    ratios: tuple[float, ...] = ()
    horizontal_m: float = math.nan
    yaw_deg: float = math.nan

    @property
    def beyond(self) -> bool:
        """True if a published error exceeds its sigma's bound, in any mode."""
        return any(not r <= MOST_SIGMA for r in self.ratios)


@dataclass(frozen=True, slots=True)
class Event:
    """Events for the operator."""

    t_s: float
    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Course:
    """Published course of a run: samples and events; `crash` is the exception that ended it."""

    samples: Sequence[Sample]
    events: Sequence[Event]
    crash: str | None = None


def axis_ratio(error: float, sigma: float) -> float:
    """Ratio |error| / sigma; infinite if error or sigma does not permit the comparison."""
    if not (math.isfinite(error) and math.isfinite(sigma) and sigma > 0.0):
        return math.inf
    return abs(error) / sigma


def longest_lie_s(samples: Sequence[Sample]) -> float:
    """Longest unbroken time beyond `MOST_SIGMA`; samples evenly spaced."""
    if len(samples) < 2:
        return 0.0
    longest = now = 0
    for sample in samples:
        now = now + 1 if sample.beyond else 0
        longest = max(longest, now)
    return longest * (samples[1].t_s - samples[0].t_s)


def noticed_s(course: Course, reference: Course, begin_s: float) -> float | None:
    """Seconds from `begin_s` to the first difference in the run's reports, None if never."""
    usual = {s.t_s: s.mode for s in reference.samples}
    times = [e.t_s for e in new_events(course, reference, begin_s)]
    times += [
        s.t_s for s in course.samples if s.t_s >= begin_s and s.mode != usual.get(s.t_s, s.mode)
    ]
    return min(times) - begin_s if times else None


def new_events(course: Course, reference: Course, begin_s: float) -> list[Event]:
    """Events from `begin_s` on, beyond the reference's number of each code."""
    usual = Counter(e.code for e in reference.events if e.t_s >= begin_s)
    found = []
    for event in course.events:
        if event.t_s < begin_s:
            continue
        if usual[event.code] > 0:
            usual[event.code] -= 1
        else:
            found.append(event)
    return found


def recovered_s(samples: Sequence[Sample], end_s: float) -> float | None:
    """Seconds from `end_s` to the first of `SETTLED_SAMPLES` good samples, None if never."""
    good, first_s = 0, 0.0
    for sample in samples:
        if sample.t_s < end_s:
            continue
        good = good + 1 if sample.mode == NAVIGATING and not sample.beyond else 0
        if good == 1:
            first_s = sample.t_s
        if good == SETTLED_SAMPLES:
            return first_s - end_s
    return None


def row_figures(course: Course, reference: Course, begin_s: float, end_s: float) -> dict[str, Any]:
    """Figures of a row with a fault from `begin_s` to `end_s`. Largest errors are in mode
    `navigating` from the begin on, the largest ratio is in any mode."""
    since = [s for s in course.samples if s.t_s >= begin_s]
    vouched = [s for s in since if s.mode == NAVIGATING]
    worst, of = max(
        ((r, q) for s in since if s.ratios for r, q in zip(s.ratios, QUANTITIES, strict=True)),
        default=(0.0, ""),
    )
    noticed = noticed_s(course, reference, begin_s)
    lie_s = longest_lie_s(course.samples)
    verdict: Verdict
    if course.crash is not None:
        verdict = "crashed"
    elif lie_s > LIE_S:
        verdict = "lie"
    else:
        verdict = "survived" if noticed is None else "degraded and said so"
    meanwhile = [s.mode for s in course.samples if begin_s <= s.t_s <= max(end_s, begin_s + 1.0)]
    return {
        "verdict": verdict,
        "noticed_s": noticed,
        "events": [
            {"after_s": e.t_s - begin_s, "code": e.code, "text": e.text}
            for e in new_events(course, reference, begin_s)
        ],
        "modes": dict(Counter(meanwhile)),
        "largest_horizontal_m": _largest(s.horizontal_m for s in vouched),
        "largest_yaw_deg": _largest(s.yaw_deg for s in vouched),
        "largest_ratio": _finite(worst),
        "largest_ratio_of": of,
        "longest_lie_s": lie_s,
        "beyond_s": sum(s.beyond for s in course.samples),
        "lie_modes": dict(Counter(s.mode for s in course.samples if s.beyond)),
        "recovered_s": recovered_s(course.samples, end_s),
        "crash": course.crash,
    }


def _largest(values: Iterable[float]) -> float | None:
    return _finite(max((abs(v) if math.isfinite(v) else math.inf for v in values), default=0.0))


def _finite(value: float) -> float | None:
    """Value if finite, else None, since JSON has no other numbers."""
    return value if math.isfinite(value) else None
