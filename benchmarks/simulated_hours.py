"""Hours of driving through the navigator, faster than real time, as JSON:

    python benchmarks/simulated_hours.py HOURS [--faults] [--workers N] [--seed S]

Drives of the fault matrix (`fusiond.studies.faults`), each with its own noise: at nominal noise, or
`--faults` with one fault of the matrix in each, drawn. What is told of sources and filter, and
seconds beyond five sigma in mode `navigating`, as rates per 24 hours; without faults all of it is
false alarm.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

from fusiond.studies.faults.judge import Course, longest_lie_s
from fusiond.studies.faults.library import FAULTS, TOWN
from fusiond.studies.faults.recording import DURATION_S
from fusiond.studies.faults.runs import VEHICLE, Row, navigate, run_row

USUAL = ("aligned", "verdict_consistent")
"""Events of a drive in which nothing is wrong."""


def one(seed: int, faults: bool) -> dict[str, Any]:
    """The counts of one drive."""
    if faults:
        dice = random.Random(seed)
        name = dice.choice(tuple(FAULTS))
        found = run_row(Row(name, dice.choice(FAULTS[name].phases)), seed)
        codes = [event["code"] for event in found["events"]]
        return _counts(codes, found["beyond_s"], found["longest_lie_s"], found["verdict"], name)
    truth, recording = TOWN.recorded(VEHICLE, seed)
    course: Course = navigate(VEHICLE, recording, truth)
    codes = [event.code for event in course.events]
    beyond_s = sum(sample.beyond for sample in course.samples)
    verdict = "crashed" if course.crash else "survived"
    return _counts(codes, beyond_s, longest_lie_s(course.samples), verdict, "")


def _counts(
    codes: Sequence[str], beyond_s: float, lie_s: float, verdict: str, name: str
) -> dict[str, Any]:
    told = Counter(code for code in codes if code not in USUAL)
    return {"told": told, "beyond_s": beyond_s, "lie_s": lie_s, "end": f"{verdict} {name}".strip()}


def summary(found: list[dict[str, Any]], took_s: float) -> dict[str, Any]:
    """All drives together."""
    hours = len(found) * DURATION_S / 3600.0
    told: Counter[str] = sum((row["told"] for row in found), Counter())
    return {
        "hours": round(hours, 2),
        "drives": len(found),
        "times_real_time": round(hours * 3600.0 / took_s, 1),
        "told_per_24_h": {code: round(24.0 * n / hours, 2) for code, n in told.most_common()},
        "drives_with_an_event": sum(bool(row["told"]) for row in found),
        "beyond_5_sigma_s_per_24_h": round(24.0 * sum(r["beyond_s"] for r in found) / hours, 1),
        "longest_lie_s": max(row["lie_s"] for row in found),
        "ends": dict(Counter(row["end"] for row in found).most_common()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("hours", type=float)
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1000)
    args = parser.parse_args()
    drives = max(1, round(args.hours * 3600.0 / DURATION_S))
    found, start_s = [], time.monotonic()
    with ProcessPoolExecutor(args.workers) as pool:
        runs = pool.map(partial(one, faults=args.faults), range(args.seed, args.seed + drives))
        for k, row in enumerate(runs, 1):
            found.append(row)
            if k % 20 == 0 or k == drives:
                line = json.dumps(summary(found, time.monotonic() - start_s))
                print(line, file=sys.stderr if k < drives else sys.stdout, flush=True)


if __name__ == "__main__":
    main()
