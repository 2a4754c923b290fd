"""Commands one after another from an empty kernel cache, each a process, as a user starts them.

What a command finds in the cache it links with what it compiles itself. Commands that load the same
kernels leave the same cache: `run` and `check --compile` import the daemon, so one stands for both.
The others are started in an order in which each one adds kernels, but for the last, which navigates
with what four processes compiled:

    simulate -> study rdss-static -> model -> check --compile -> process

`simulate` starts from nothing, and compiles a quarter of all kernels. Of those that it leaves,
seven of eight are then laid in from the tests' own cache, as other processes compiled them, and the
rest is left to the commands that follow: each links what it compiles with kernels of all before it
and of others. To compile everything anew would take a minute more and show the same; `make pairs`
does.

`process` loads all that any of them loads but three kernels of the simulation, so the other pairs
(`simulate` and `process`, `model` and `process` ...) differ from these steps only in which of two
processes compiled a kernel. That choice is covered without compiling: `process` runs once more with
every other kernel of the commands exchanged for that of the tests' own cache. Kernels call each
other by symbol: one symbol each, in every process the same; none of numba's own may be in both.
"""

from __future__ import annotations

import pickle
import re
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fusiond.navigation.compiled import FOLDER
from tests.commands.cached_commands import RESULTS, run_here, start


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """What each command writes with the kernels of the tests' own cache, all in one process."""
    folder = tmp_path_factory.mktemp("expected")
    return {command: run_here(command, folder) for command in IN_TURN if RESULTS[command]}


IN_TURN = ("simulate", "study", "model", "check", "process")


class InTurn(NamedTuple):
    """The cache after the commands ran in turn, what each wrote, the files that they compiled."""

    cache: Path
    wrote: dict[str, list[str]]
    compiled: list[str]


@pytest.fixture(scope="module")
def in_turn(tmp_path_factory: pytest.TempPathFactory, expected: dict[str, list[str]]) -> InTurn:
    """Also asks for `expected`, which fills the tests' own cache."""
    folder = tmp_path_factory.mktemp("in_turn")
    cache = folder / "cache" / FOLDER.name
    wrote: dict[str, list[str]] = {}
    compiled: list[str] = []
    laid_in: set[str] = set()
    for command in IN_TURN:
        wrote[command] = start(command, folder, cache.parent)
        new = {file.name for file in cache.glob("*.kernel")} - laid_in - set(compiled)
        needs_none = command in ("model", "process")
        assert new or needs_none, f"{command} compiled nothing: choose another order"
        compiled += sorted(new)
        if not laid_in:
            others = sorted(f.name for f in FOLDER.glob("fusiond.*.kernel") if f.name not in new)
            laid_in = {name for k, name in enumerate(others) if k % 8}
            for name in laid_in:
                shutil.copy(FOLDER / name, cache)
    return InTurn(cache, wrote, compiled)


def test_each_command_works_with_what_those_before_it_compiled(
    in_turn: InTurn, expected: dict[str, list[str]]
) -> None:
    for command, lines in expected.items():
        assert in_turn.wrote[command] == lines, command
    rows = in_turn.wrote["process"][1:]
    numbers = np.array([row.split(",")[:-1] for row in rows], dtype=float)
    assert len(numbers) > 500
    assert np.isfinite(numbers).all()


def test_kernels_of_different_processes_work_together(
    in_turn: InTurn, expected: dict[str, list[str]], tmp_path: Path
) -> None:
    """Every other kernel that the commands compiled is now of the tests' own cache."""
    mixed = tmp_path / "cache" / FOLDER.name
    shutil.copytree(in_turn.cache, mixed)
    for name in in_turn.compiled[::2]:
        shutil.copy(FOLDER / name, mixed)
    shutil.copytree(in_turn.cache.parents[1] / "drive", tmp_path / "drive")
    kernels = len(list(mixed.iterdir()))
    assert start("process", tmp_path, mixed.parent) == expected["process"]
    assert len(list(mixed.iterdir())) == kernels, "it compiled: the files were of no use"


def _symbols(file: Path) -> tuple[str, set[bytes]]:
    """The symbol of a kernel, and those of numba's own functions that its native code holds."""
    _, function, native = pickle.loads(file.read_bytes()[32:])[:3]
    return function.mangled_name, set(re.findall(rb"_ZN5numba[\w.$]*", native))


def test_no_symbol_of_the_kernels_is_used_twice(in_turn: InTurn) -> None:
    """A symbol is one kernel's, in every process the same; none of numba's own functions is another
    process's: what holds one is large, and called by others instead of copied."""
    here = {name: _symbols(in_turn.cache / name) for name in in_turn.compiled}
    there = {file.name: _symbols(file) for file in FOLDER.glob("fusiond.*.kernel")}
    both = here.keys() & there.keys()
    assert len(both) > 50
    assert all(here[name][0] == there[name][0] for name in both)
    of_all = {name: symbol for name, (symbol, _) in (here | there).items()}
    assert len(set(of_all.values())) == len(of_all)
    of_here = {symbol for _, held in here.values() for symbol in held}
    of_there = {symbol for _, held in there.values() for symbol in held}
    assert of_here | of_there
    assert not of_here & of_there
