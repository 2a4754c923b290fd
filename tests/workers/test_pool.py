"""The pool of workers: the same results from any number of them, and none is brought down."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from fusiond.studies.monte_carlo import map_runs, runner_context
from fusiond.workers.pool import Pool
from tests.patience import PATIENCE_S
from tests.workers.jobs import dies_once, drawn, mishap, pid, third_dies, threads

RUNS = 23


def test_results_do_not_depend_on_the_number_of_workers() -> None:
    here = map_runs(drawn, RUNS)
    for workers in (1, 3):
        with Pool(workers) as pool, runner_context(pool) as lost:
            assert map_runs(drawn, RUNS) == here
        assert not lost


def test_workers_stay_warm_with_one_thread() -> None:
    with Pool(1) as pool:
        first, *others = [o.result for k in range(3) for o in pool.outcomes(pid, [k])]
        assert {first} == set(others)
        assert [o.result for o in pool.outcomes(threads, [0])] == ["1"]


def test_a_failure_costs_only_its_own_item() -> None:
    items = ["a", "killed", "b", "crashed", "raises", "exit", "c"]
    with Pool(1) as pool:
        found = {items[o.index]: o for o in pool.outcomes(mishap, items, chunk=len(items))}
    assert {name: o.ended for name, o in found.items()} == {
        "a": "done",
        "b": "done",
        "c": "done",
        "killed": "died",
        "crashed": "died",
        "exit": "died",
        "raises": "error",
    }
    assert "SIGKILL" in found["killed"].reason
    assert "SIGSEGV" in found["crashed"].reason
    assert "code 3" in found["exit"].reason
    assert found["raises"].reason.startswith("ValueError: a mistake (jobs.py:")


def test_an_endless_item_is_killed() -> None:
    with Pool(1, timeout_s=0.25) as pool:
        found = list(pool.outcomes(mishap, ["endless", "endless"], chunk=2))
    assert [(o.index, o.ended, o.reason) for o in found] == [
        (k, "timeout", "no end after 0.25 s") for k in range(2)
    ]


def test_a_study_says_which_runs_it_lost() -> None:
    with Pool(2) as pool, runner_context(pool) as lost:
        assert map_runs(third_dies, 4) == [0, 1, 3]
    assert [(run.number, run.ended) for run in lost] == [(2, "died")]


def test_workers_end_with_whoever_started_them(tmp_path: Path) -> None:
    """Killed in the middle of a run that never ends, it leaves nothing behind."""
    mark = tmp_path / "run.deadly"
    code = (
        "from fusiond.workers.pool import Pool; from tests.workers.jobs import dies_once\n"
        f"list(Pool(1).outcomes(dies_once, [{str(mark)!r}]))"
    )
    # The worker holds the pipe's other end for as long as it lives.
    done = subprocess.run(
        [sys.executable, "-c", code], stderr=subprocess.PIPE, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == -9
    assert dies_once(str(mark)) == mark.name  # it did begin
