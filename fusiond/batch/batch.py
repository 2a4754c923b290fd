"""`fusiond batch`: one row for each log, also for one that fails.

A row is named by its log, the digest of the configuration and the version of fusiond: a batch with
another configuration adds rows to the same file, and one that has its rows already does nothing.
`ended` is an outcome of `fusiond.workers.runner_interface`, or `not navigated`; `reason` explains
it. Rows do not depend on the number of workers or on their speed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path

from fusiond.batch.log_row import drive_row
from fusiond.configuration.load import config_digest, load_config
from fusiond.files.resumable_parquet import ResumableRows, Row
from fusiond.workers.runner_interface import Outcome, Runner

_NAME = ("log", "config_digest", "version")


def run_batch(
    config_path: Path,
    logs: Sequence[Path],
    out: Path,
    runner: Runner,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, int]:
    """Write a row for each log and return the number of rows by outcome.

    Raises `ConfigError`, `MissingPackageError`, OSError, and `TableError` for an `out` without
    rows; failures of logs are rows.
    """
    digest, release = config_digest(load_config(config_path)), version("fusiond")
    wanted = {str(log.resolve()): log for log in logs}
    ended: Counter[str] = Counter()
    with ResumableRows(out) as file:
        known = {tuple(row.get(name) for name in _NAME) for row in file.rows}
        todo = [name for name in wanted if (name, digest, release) not in known]
        ended["there"] = len(wanted) - len(todo)
        work = partial(drive_row, config_path.resolve())
        paths = [Path(name) for name in todo]
        for done, outcome in enumerate(runner.outcomes(work, paths), 1):
            named = dict(zip(_NAME, (todo[outcome.index], digest, release), strict=True))
            row = named | _row(outcome)
            file.add(row)
            ended[row["ended"]] += 1
            progress(done, len(todo))
        file.rows.sort(key=lambda row: tuple(str(row.get(name)) for name in _NAME))
    return dict(ended)


def _row(outcome: Outcome[Row]) -> Row:
    if outcome.result is None:
        return {"ended": outcome.ended, "reason": outcome.reason}
    row = dict(outcome.result)
    why = row.pop("not_navigated", "")
    return {"ended": "not navigated" if why else "done", "reason": why, **row}
