"""Recordings whose solution is kept: `make golden` writes it anew, `git diff` shows what changed.

    python -m tests.golden.golden            the solutions of all logs, as they are now
    python -m tests.golden.golden --record   and first the demo's log itself

A fault that was seen on a vehicle becomes a test: cut it out (`fusiond log trim`), put it here, and
add its line to `LOGS`.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from fusiond.recording.edit import merge
from fusiond.replay.run import SOLUTION, Wish, replay
from tests.recording.driven import Drive

FOLDER = Path(__file__).parent
LOGS = (
    # The demo's car: rest, heading by the first motion, RDSS and GNSS.
    "demo.mcap",
)
EVERY_S = 1.0


def solution(log: Path) -> list[dict[str, str]]:
    """The solution of a log once a second, as `solution.csv` has it."""
    with TemporaryDirectory() as folder:
        replay([log], Wish(settings=("mqtt.enabled=false",), out=Path(folder)))
        with (Path(folder) / SOLUTION).open(newline="") as file:
            rows = list(csv.DictReader(file))
    first_s = float(rows[0]["t_s"])
    chosen: dict[int, dict[str, str]] = {}
    for row in rows:
        chosen.setdefault(int((float(row["t_s"]) - first_s) / EVERY_S), row)
    return list(chosen.values())


def kept(log: Path) -> Path:
    return log.with_suffix(".csv")


def _write(log: Path) -> None:
    rows = solution(log)
    with kept(log).open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print(f"{kept(log).name}: {len(rows)} rows")


def _record(log: Path) -> None:
    with TemporaryDirectory() as folder:
        drive = Drive(Path(folder), 20.0)
        drive.run(16.0)
        log.unlink(missing_ok=True)
        merge(drive.close(), log)


if __name__ == "__main__":
    if "--record" in sys.argv[1:]:
        _record(FOLDER / LOGS[0])
    for name in LOGS:
        _write(FOLDER / name)
