"""A daemon that is killed (SIGKILL) at random instants of a drive and started again:

    python benchmarks/kill_nine.py [TIMES] [--seed S]

In between the state files are spoilt in every way of `tests.live.conditions`, and some daemons
cannot write any. A line of JSON for each restart (`tests.live.kill_nine.Restart`), and last a
summary: how many were warm, how long it took from the start of the process to the first output, on
the clock and of processor (median, one in twenty and greatest), and from the first data to the
solution, how many first errors, and errors of the two seconds after them, were beyond three sigma,
and why starts were cold whose warm state nobody had touched.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.live.kill_nine import Restart, as_row, driving, killed
from tests.live.rig import network_of_its_own

# A restart, what is watched after it, and a new alignment where the gap was too long.
SECONDS_EACH = 60.0


async def measure(folder: Path, times: int, seed: int) -> list[Restart]:
    """The restarts of one drive, told as they come."""
    found: list[Restart] = []
    async with driving(folder, 60.0 + SECONDS_EACH * times, seed) as vehicle:
        async for restart in killed(folder, vehicle, times, seed, spoilt=True):
            print(as_row(restart), flush=True)
            found.append(restart)
    return found


def summary(found: list[Restart]) -> dict[str, object]:
    """Counts and greatest figures."""
    warm = [r for r in found if not math.isnan(r.gap_s)]
    expected = [r for r in found if r.warm == "untouched"]
    return {
        "kills": len(found),
        "warm": len(warm),
        "warm_states_untouched": len(expected),
        "cold_though_untouched": dict(Counter(r.cold for r in expected if r.cold)),
        "conditions": dict(Counter(r.warm for r in found)),
        "first_beyond_3_sigma": sum(r.first_ratio > 3.0 for r in found),
        "first_greatest_ratio": round(max(r.first_ratio for r in found), 2),
        "later_beyond_3_sigma": sum(r.ratio > 3.0 for r in found),
        "later_greatest_ratio": round(max(r.ratio for r in found), 2),
        "start_to_first_output_s": _spread([r.load_s + r.first_output_s for r in found]),
        "start_to_first_output_cpu_s": _spread(
            [r.load_cpu_s + r.first_output_cpu_s for r in found]
        ),
        "loaded_to_first_output_s": _spread([r.first_output_s for r in found]),
        "warm_solution_s": round(max((r.solution_s for r in warm), default=math.nan), 3),
        "warm_first_error_m": round(max((r.first_error_m for r in warm), default=math.nan), 1),
        "cold_solution_s": _spread([r.solution_s for r in found if math.isnan(r.gap_s)]),
    }


def _spread(values: list[float]) -> list[float]:
    """Median, the value that one in twenty passes, and the greatest."""
    ordered = sorted(values)
    n = len(ordered)
    at = (n // 2, min(n - 1, round(0.95 * n)), n - 1) if n else ()
    return [round(ordered[k], 2) for k in at]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("times", type=int, nargs="?", default=20)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    subprocess.run([sys.executable, "-c", "import fusiond.live.daemon"], check=True)  # compiles
    network_of_its_own()
    with tempfile.TemporaryDirectory(prefix="fusiond-kill-") as folder:
        found = asyncio.run(measure(Path(folder), args.times, args.seed))
    print(json.dumps(summary(found), indent=2))


if __name__ == "__main__":
    main()
