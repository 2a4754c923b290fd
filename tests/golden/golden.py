"""Recordings whose solution is kept: `make golden` writes it anew, `git diff` shows what changed.

    python -m tests.golden.golden            the solutions of all logs, as they are now
    python -m tests.golden.golden --record   and first the demo's log itself

A fault that was seen on a vehicle becomes a test: cut it out (`fusiond log trim`), put it here, and
add its line to `LOGS`. Of recorded vehicles the log is made when it is needed
(`tests.golden.recorded`).
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from fusiond.recording.edit import merge
from fusiond.replay.replay_output import SOLUTION, ReplayOptions, replay
from tests.golden.recorded import Bus, Walk
from tests.recording.driven import Drive
from tests.recording.rig import Rig

FOLDER = Path(__file__).parent
LOGS = (
    # The demo's car: rest, heading by the first motion, RDSS and GNSS.
    "demo.mcap",
)
VEHICLES: dict[str, Callable[[Path], Rig]] = {
    # A car in a town, its module and the OBD speed on one bus: heading by its course.
    "css_164": lambda folder: Bus(folder, 190.0, 60.0),
    # A walk with a receiver's raw stream: heading by the first steps, satellites tightly coupled.
    "walk_0827": lambda folder: Walk(folder, 408645.0, 40.0),
}
"""Made of the data of that name."""
EVERY_S = 1.0


def solution(logs: Sequence[Path]) -> list[dict[str, str]]:
    """The solution of a log once a second, as `solution.csv` has it."""
    with TemporaryDirectory() as folder:
        replay(logs, ReplayOptions(settings=("mqtt.enabled=false",), out=Path(folder)))
        with (Path(folder) / SOLUTION).open(newline="") as file:
            rows = list(csv.DictReader(file))
    first_s = float(rows[0]["t_s"])
    chosen: dict[int, dict[str, str]] = {}
    for row in rows:
        chosen.setdefault(int((float(row["t_s"]) - first_s) / EVERY_S), row)
    return list(chosen.values())


def driven(name: str, folder: Path) -> list[Path]:
    """The log of a recorded vehicle, made in `folder`."""
    rig = VEHICLES[name](folder)
    rig.run_to(rig.end_ns)
    return rig.close()


def kept(name: str) -> Path:
    return FOLDER / f"{name.removesuffix('.mcap')}.csv"


def _write(name: str, rows: list[dict[str, str]]) -> None:
    with kept(name).open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print(f"{kept(name).name}: {len(rows)} rows")


def _record(log: Path) -> None:
    with TemporaryDirectory() as folder:
        drive = Drive(Path(folder), 20.0)
        drive.run(16.0)
        log.unlink(missing_ok=True)
        merge(drive.close(), log)


if __name__ == "__main__":
    if "--record" in sys.argv[1:]:
        _record(FOLDER / LOGS[0])
    for log in LOGS:
        _write(log, solution([FOLDER / log]))
    for vehicle in VEHICLES:
        with TemporaryDirectory() as made:
            _write(vehicle, solution(driven(vehicle, Path(made))))
