"""The same runs on Dask: a scheduler and two workers, each a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Client

from fusiond.studies.monte_carlo import map_runs, runner_context
from fusiond.workers.cluster import Cluster, ClusterError
from tests.patience import PATIENCE_S
from tests.places import REPOSITORY
from tests.workers.jobs import dies_once, drawn, mishap

RUNS = 23


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """Address of a scheduler with two workers of one thread."""
    about = str(tmp_path / "scheduler.json")
    cli = [sys.executable, "-m"]
    head = [*cli, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    worker = [*cli, "distributed.cli.dask_worker", "--no-nanny", "--nthreads", "1"]
    worker += ["--host", "127.0.0.1", "--local-directory", str(tmp_path)]
    calls = [head, worker, worker]
    started = [
        subprocess.Popen(
            [*call, "--no-dashboard", "--scheduler-file", about],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=REPOSITORY,
            env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        )
        for call in calls
    ]
    try:
        with Client(scheduler_file=about, timeout=PATIENCE_S, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=PATIENCE_S)
            address = client.scheduler.address
        yield address
    finally:
        for process in started:
            process.kill()
            process.wait()


def test_two_workers_one_killed_in_the_middle(scheduler: str, tmp_path: Path) -> None:
    with Cluster(scheduler) as cluster, runner_context(cluster) as lost:
        assert cluster.workers == 2
        assert map_runs(drawn, RUNS) == [drawn(number) for number in range(RUNS)]
        assert not lost

        items = ["a", "killed", "raises", "b"]
        found = {items[o.index]: o for o in cluster.outcomes(mishap, items, chunk=2)}
        assert {name: o.ended for name, o in found.items()} == {
            "a": "done",
            "killed": "died",
            "raises": "error",
            "b": "done",
        }
        assert "SIGKILL" in found["killed"].reason

        # Dask gives the chunk of the worker that is killed to the other one.
        names = [f"{k}.quiet" for k in range(6)] + ["7.deadly"]
        marks = [str(tmp_path / name) for name in names]
        done = sorted(cluster.outcomes(dies_once, marks, chunk=2), key=lambda o: o.index)
        assert [o.result for o in done] == names
        assert (tmp_path / "7.deadly").exists()
        assert cluster.workers == 1


def test_without_a_scheduler() -> None:
    with pytest.raises(ClusterError, match="no Dask scheduler answers"):
        Cluster("tcp://127.0.0.1:1", connect_s=0.1)
