"""Every ordered pair of commands from an empty kernel cache: `make pairs`.

The first command of a pair compiles what it needs from nothing, in a cache of its own; the second
finds those kernels in a copy of that cache, compiles what is missing, and must write what it writes
where one process has compiled everything. Takes some forty minutes of processor time, so the suite
has a shorter way through the same commands (`tests/commands/test_kernel_cache.py`).
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from tests.commands.cached_commands import COMMANDS, start


def main() -> int:
    failures = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        work = folder / "work"
        expected = {c: start(c, work, folder / "whole") for c in ("simulate", "process")}
        expected |= {c: start(c, work, folder / "whole") for c in COMMANDS if c not in expected}
        for first in COMMANDS:
            cache = folder / first
            failures += _differs(
                f"{first} from nothing", start(first, work, cache), expected[first]
            )
            for second in COMMANDS:
                if second == first:
                    continue
                both = Path(shutil.copytree(cache, folder / "both"))
                found = start(second, work, both)
                failures += _differs(f"{first}, {second}", found, expected[second])
                shutil.rmtree(both)
    print(f"{len(COMMANDS) * (len(COMMANDS) - 1)} pairs, {failures} failures")
    return min(failures, 1)


def _differs(pair: str, found: list[str], expected: list[str]) -> bool:
    print(f"{pair}: {'as expected' if found == expected else 'DIFFERS'}", flush=True)
    return found != expected


if __name__ == "__main__":
    sys.exit(main())
