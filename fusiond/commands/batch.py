"""Command `batch`, and the workers that it shares with `study`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusiond.commands.compile_progress import compiling
from fusiond.commands.shared import (
    EXIT_DATA,
    EXIT_UNAVAILABLE,
    ConfigPath,
    config_errors,
    data_errors,
    progress_bar,
)

if TYPE_CHECKING:
    from fusiond.workers.runner_interface import Runner

Workers = Annotated[
    int | None, typer.Option(min=1, help="Processes; as many as there are processors by default.")
]
ClusterAddress = Annotated[
    str | None,
    typer.Option("--cluster", metavar="ADDRESS", help="Of a Dask scheduler, such as tcp://h:8786."),
]
Timeout = Annotated[
    float | None, typer.Option(metavar="S", min=0.001, help="Longest time that a run may take.")
]


@contextmanager
def runner_of(
    workers: int | None, cluster: str | None, timeout_s: float | None
) -> Iterator[Runner]:
    """Runner on local processes or on a cluster; exit 69 where none is available."""
    from fusiond.workers.cluster import Cluster, ClusterError  # noqa: PLC0415
    from fusiond.workers.pool import Pool, PoolError, processor_count  # noqa: PLC0415

    if workers is not None and cluster is not None:
        raise typer.BadParameter("--workers or --cluster: a cluster has its own workers")
    try:
        if cluster is None:
            with Pool(workers or processor_count(), timeout_s) as pool:
                yield pool
            return
        with Cluster(cluster, timeout_s) as dask:
            yield dask
    except (PoolError, ClusterError) as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_UNAVAILABLE) from error


@contextmanager
def row_errors() -> Iterator[None]:
    """Handle errors as `data_errors`; exit 69 where the package for rows is missing."""
    from fusiond.files.csv_tables import MissingPackageError  # noqa: PLC0415

    try:
        with data_errors():
            yield
    except MissingPackageError as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_UNAVAILABLE) from error


def outcome_counts(ended: Mapping[str, int]) -> str:
    """Count of rows by outcome."""
    return ", ".join(f"{count} {how}" for how, count in ended.items() if count) or "no rows"


def batch(
    config: ConfigPath,
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Drives: recordings, CAN logs or folders."),
    ],
    out: Annotated[Path, typer.Option(metavar="F.parquet", help="File of the rows.")],
    workers: Workers = None,
    cluster: ClusterAddress = None,
    timeout: Timeout = None,
) -> None:
    """Navigate through many drives, a row of figures each.

    A stopped batch continues where it stopped."""
    with compiling():
        from fusiond.batch.batch import run_batch  # noqa: PLC0415

    with (
        runner_of(workers, cluster, timeout) as runner,
        config_errors(),
        row_errors(),
        progress_bar("drives") as bar,
    ):
        ended = run_batch(config, logs, out, runner, bar or (lambda done, total: None))
    typer.echo(f"{out}: {outcome_counts(ended)}")
    if not ended.get("done") and not ended["there"]:
        raise typer.Exit(EXIT_DATA)
