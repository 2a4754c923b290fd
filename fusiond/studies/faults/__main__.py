"""Run the fault matrix or rows of it; print it as a table, and write it as JSON if asked."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from fusiond.studies.faults.library import ALL, FAULTS
from fusiond.studies.faults.runs import rows, run_row

HEADER = (
    "fault",
    "phase",
    "verdict",
    "noticed, s",
    "events",
    "modes meanwhile",
    "largest, m",
    "largest yaw, deg",
    "largest error/sigma",
    "longest lie, s",
    "recovered, s",
)


def table(found: list[dict[str, Any]]) -> str:
    """The rows as Markdown, and the count of each verdict."""
    lines = [HEADER, ("---",) * len(HEADER)]
    for row in found:
        codes = Counter(event["code"] for event in row["events"])
        lines.append(
            (
                row["fault"],
                row["phase"],
                row["verdict"],
                _number(row["noticed_s"], "never"),
                ", ".join(f"{code} x{n}" if n > 1 else code for code, n in codes.items()) or "-",
                ", ".join(row["modes"]) or "-",
                _number(row["largest_horizontal_m"], "inf"),
                _number(row["largest_yaw_deg"], "inf"),
                f"{_number(row['largest_ratio'], 'inf')} {row['largest_ratio_of']}".strip(),
                _number(row["longest_lie_s"], "-"),
                _number(row["recovered_s"], "never"),
            )
        )
    counts = Counter(row["verdict"] for row in found).most_common()
    text = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"{text}\n\n{len(found)} rows: {', '.join(f'{n} {v}' for v, n in counts)}.\n"


def _number(value: float | None, none: str) -> str:
    return none if value is None else f"{value:.3g}"


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m fusiond.studies.faults", description=__doc__)
    parser.add_argument("--only", choices=tuple(FAULTS), metavar="NAME", help="one fault")
    parser.add_argument("--phase", choices=ALL, help="one phase")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--json", type=Path, metavar="F.json")
    parser.add_argument("--table", type=Path, metavar="F.md")
    asked = parser.parse_args()
    wanted = rows(asked.only, asked.phase)
    if not wanted:
        parser.error(f"{asked.only} has the phases {', '.join(FAULTS[asked.only].phases)}")
    found = []
    with ProcessPoolExecutor(min(asked.workers, len(wanted))) as pool:
        for k, row in enumerate(pool.map(partial(run_row, seed=asked.seed), wanted), 1):
            found.append(row)
            if sys.stderr.isatty():
                print(f"\r{k}/{len(wanted)}", end="", file=sys.stderr, flush=True)
    if asked.json is not None:
        document = {"seed": asked.seed, "rows": found}
        asked.json.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
    text = table(found)
    if asked.table is not None:
        asked.table.write_text(text)
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
