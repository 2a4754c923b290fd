"""Faults of wires, clocks and the host on the daemon's own process, as a table:

    python benchmarks/wire_faults.py [--only NAME] [--phase PHASE] [--json F.json] [--table F.md]

A row takes a minute or two of real time. Faults that need `vcan0` or a machine whose clock may be
set are left out where there is none; `python -m tests.hil.uml python benchmarks/wire_faults.py`
runs them in a guest. `--json` keeps what other runs have written there, row by row.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fusiond.studies.faults.tables import matrix_table
from tests.live.rig import network_of_its_own
from tests.live.wire_faults import ALL, FAULTS
from tests.live.wire_runs import judged, rows, run_row


def merged(path: Path | None, found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows, and those of the file that have not been run now, in the order of `FAULTS`."""
    kept: dict[tuple[str, str], dict[str, Any]] = {}
    if path is not None and path.exists():
        kept = {(r["fault"], r["phase"]): r for r in json.loads(path.read_text())["rows"]}
    kept |= {(r["fault"], r["phase"]): r for r in found}
    order = [(name, phase) for name in FAULTS for phase in ALL]
    return [kept[row] for row in order if row in kept]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=tuple(FAULTS), metavar="NAME", action="append")
    parser.add_argument("--phase", choices=ALL)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="at a time")
    parser.add_argument("--json", type=Path, metavar="F.json")
    parser.add_argument("--table", type=Path, metavar="F.md")
    asked = parser.parse_args()
    names = asked.only or [name for name in FAULTS if name != "nothing"]
    wanted = [row for name in names for row in rows(name, asked.phase)]
    if not wanted:
        parser.error("none of these can be run here")
    phases = dict.fromkeys(phase for _, phase in wanted)
    wanted = [*(("nothing", phase) for phase in phases), *(r for r in wanted if r[0] != "nothing")]
    subprocess.run([sys.executable, "-c", "import fusiond.live.daemon"], check=True)  # compiles
    found, references = [], {}
    with (
        tempfile.TemporaryDirectory(prefix="fusiond-wires-") as folder,
        ProcessPoolExecutor(asked.workers, initializer=network_of_its_own) as pool,
    ):
        runs = pool.map(partial(run_row, folder=Path(folder), seed=asked.seed), wanted)
        for run in runs:
            if run.fault == "nothing":
                references[run.phase] = run.course
            row = judged(run, references[run.phase])
            print(json.dumps(row), file=sys.stderr, flush=True)
            found.append(row)
            if asked.json is not None:
                document = {"seed": asked.seed, "rows": merged(asked.json, found)}
                asked.json.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
    text = matrix_table(merged(asked.json, found))
    if asked.table is not None:
        asked.table.write_text(text)
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
