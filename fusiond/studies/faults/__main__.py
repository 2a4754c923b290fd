"""Command line of the fault matrix and its related studies.

The studies are: rows of the matrix, power of detection, false alarms, occasional faults, loss of
service, bounds of detection, sharpness of sigma, and reports on recorded drives."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fusiond.studies.faults.detection_bounds import bound_run
from fusiond.studies.faults.detection_bounds import jobs as bound_jobs
from fusiond.studies.faults.extra_faults import EVERY
from fusiond.studies.faults.faulty_hours import faulty_hour_of
from fusiond.studies.faults.hours import hour_of
from fusiond.studies.faults.library import ALL, FAULTS
from fusiond.studies.faults.matched_noise_drives import SHARES
from fusiond.studies.faults.power import jobs, power_run
from fusiond.studies.faults.recorded import Place, recorded_rows, run_recorded, smooth
from fusiond.studies.faults.recorded_fault_free import jobs as real_jobs
from fusiond.studies.faults.recorded_fault_free import real_run
from fusiond.studies.faults.runs import rows, run_row
from fusiond.studies.faults.service import jobs as service_jobs
from fusiond.studies.faults.service import service_run
from fusiond.studies.faults.sigma_sharpness import jobs as sharpness_jobs
from fusiond.studies.faults.sigma_sharpness import sharpness_run
from fusiond.studies.faults.tables import TABLES, replace_table
from fusiond.studies.monte_carlo import map_items, runner_context, step_counter
from fusiond.workers.pool import Pool, processor_count

Row = dict[str, Any]


def main() -> int:
    """Run the requested study."""
    parser = argparse.ArgumentParser(prog="python -m fusiond.studies.faults", description=__doc__)
    parser.add_argument("--only", choices=tuple(EVERY), metavar="NAME", help="one fault")
    parser.add_argument("--phase", choices=ALL, help="one phase")
    parser.add_argument("--power", type=int, metavar="RUNS", help="detection, so many runs a size")
    parser.add_argument("--alarms", type=int, metavar="HOURS", help="hours with nothing wrong")
    parser.add_argument("--faulty", type=int, metavar="HOURS", help="hours with faults in them")
    parser.add_argument("--service", type=int, metavar="DRIVES", help="time without service")
    parser.add_argument("--bounds", type=int, metavar="DRIVES", help="how soon any test could tell")
    parser.add_argument("--sharpness", type=int, metavar="DRIVES", help="sigma, so many a cell")
    parser.add_argument("--real", type=Path, metavar="DATA", help="recorded drives, none wrong")
    parser.add_argument(
        "--seeds", choices=SHARES, default=SHARES[0], help="drives of bounds, sharpness, service"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drive", type=int, metavar="N", help="a drawn drive, not the town")
    parser.add_argument("--recording", type=Path, metavar="P", help="tables or a CAN log, instead")
    parser.add_argument("--config", type=Path, metavar="F.toml", help="that of the recording")
    parser.add_argument(
        "--at", type=float, nargs="+", metavar="S", help="faults begin so long after the recording"
    )
    parser.add_argument("--workers", type=int, default=processor_count(), help="processes")
    parser.add_argument("--json", type=Path, metavar="F.json")
    parser.add_argument("--table", type=Path, metavar="F.md")
    parser.add_argument("--page", type=Path, metavar="F.md", help="put the table into this page")
    asked = parser.parse_args()
    if asked.recording is not None:
        if asked.config is None or not asked.at:
            parser.error("--recording needs --config and --at")
        kind, found = "recorded", _recorded(asked)
    elif (study := next((k for k in STUDIES if getattr(asked, k) is not None), None)) is not None:
        kind = study
        try:
            one, those = STUDIES[study](getattr(asked, study), asked)
        except ValueError as error:
            parser.error(str(error))
        found = _run(one, those, asked.workers)
    else:
        kind, wanted = "matrix", rows(asked.only, asked.phase)
        if asked.only not in {None, *FAULTS}:
            parser.error(f"{asked.only} is for a --recording")
        if not wanted:
            parser.error(f"{asked.only} has the phases {', '.join(FAULTS[asked.only].phases)}")
        found = _run(partial(run_row, seed=asked.seed, drive=asked.drive), wanted, asked.workers)
    if asked.json is not None:
        document = {"seed": asked.seed, "seeds": asked.seeds, "rows": found}
        asked.json.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
    text = TABLES[kind](found)
    if asked.table is not None:
        asked.table.write_text(text)
    if asked.page is not None:
        replace_table(asked.page, kind, text)
    print(text, end="")
    return 0


STUDIES: dict[str, Callable[[Any, argparse.Namespace], tuple[Callable[[Any], Row], Sequence[Any]]]]
STUDIES = {
    "power": lambda runs, asked: (power_run, jobs(runs, asked.seed)),
    "alarms": lambda hours, asked: (hour_of, range(asked.seed, asked.seed + hours)),
    "faulty": lambda hours, asked: (faulty_hour_of, range(asked.seed, asked.seed + hours)),
    "service": lambda drives, asked: (
        partial(service_run, share=asked.seeds),
        service_jobs(drives),
    ),
    "sharpness": lambda drives, asked: (
        partial(sharpness_run, share=asked.seeds),
        sharpness_jobs(drives),
    ),
    "bounds": lambda drives, asked: (partial(bound_run, share=asked.seeds), bound_jobs(drives)),
    "real": lambda data, _: (real_run, real_jobs(data)),
}
"""Studies by option: function of a row, and its input."""


def _recorded(asked: argparse.Namespace) -> list[dict[str, Any]]:
    with TemporaryDirectory() as folder:
        place = Place(asked.config, asked.recording, Path(folder) / "smoothed.csv")
        smooth(place)
        wanted = recorded_rows(place, asked.at, asked.only, asked.phase)
        return _run(partial(run_recorded, place=place), wanted, asked.workers)


def _run(
    one: Callable[[Any], dict[str, Any]], wanted: Sequence[Any], workers: int
) -> list[dict[str, Any]]:
    """Run `one` for each input; a lost row is reported on standard error."""

    def show_progress(done: int, total: int) -> None:
        if sys.stderr.isatty():
            print(f"\r{done}/{total}", end="", file=sys.stderr, flush=True)

    with Pool(workers) as pool, runner_context(pool) as lost:
        found = map_items(one, wanted, step_counter(show_progress, len(wanted)))
    for run in lost:
        print(f"row {run.number} {run.ended}: {run.reason}", file=sys.stderr)
    return found


if __name__ == "__main__":
    sys.exit(main())
