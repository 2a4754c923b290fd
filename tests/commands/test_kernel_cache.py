"""Commands one after another from an empty kernel cache, each a process, as a user starts them.

What a command finds in the cache it links with what it compiles itself. Commands that load the same
kernels leave the same cache: `run` and `check --compile` import the daemon, so one stands for both.
The others are started in an order in which each one adds kernels, but for the last, which navigates
with what four processes compiled:

    simulate -> study rdss-static -> model -> check --compile -> process

`process` loads all that any of them loads but three kernels of the simulation, so the other pairs
(`simulate` and `process`, `model` and `process` ...) differ from these steps only in which of two
processes compiled a kernel. That choice is covered without compiling anew: kernels of these
processes and of the ones that filled the tests' own cache are laid together, every other one from
each, and no symbol may be in both. All kernels are compiled once: 75 s of CPU time, nearly all of
what this module takes.
"""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import llvmlite.binding as llvm  # type: ignore[import-untyped]
import numpy as np
import pytest

from fusiond.navigation.compiled import FOLDER

CONFIG = """
[imu]
axes = ["+x", "-y", "-z"]
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
[constraints.non_holonomic]
enabled = true
lever_arm_m = [-1.0, 0.0, 0.5]
[estimator]
model = "ins21"
[alignment]
heading = ["config"]
heading_deg = 40.0
"""
COMMANDS = {
    "simulate": ("simulate", "drive", "--duration", "30", "--out", "drive"),
    "study": ("study", "rdss-static", "--runs", "2", "--json", "study.json"),
    "model": ("model", "ins21", "--config", "C.toml", "--json", "model.json"),
    "check": ("check", "--compile", "C.toml"),
    "process": (
        *("process", "C.toml", "--imu", "drive/imu.csv", "--aid", "gnss=drive/gnss.csv"),
        *("--out", "solution.csv"),
    ),
}
RESULTS = {
    "simulate": ("drive/imu.csv", "drive/gnss.csv"),
    "study": ("study.json",),
    "model": ("model.json",),
    "check": (),
    "process": ("solution.csv",),
}


def _start(command: str, folder: Path, cache: Path | None) -> list[str]:
    """Run a command in `folder`, with the tests' own cache if none; the lines that it wrote."""
    (folder / "C.toml").write_text(CONFIG)
    own = {} if cache is None else {"NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run(
        [sys.executable, "-m", "fusiond", *COMMANDS[command]],
        env=os.environ | own,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=1800,  # only bounds a run that hangs; four minutes of compiling were seen
        check=False,
    )
    assert done.returncode == 0, f"{command}: {done.returncode} {done.stderr}"
    assert "compiled anew" not in done.stderr
    lines = [line for name in RESULTS[command] for line in (folder / name).read_text().splitlines()]
    return [line for line in lines if "time_per_step_us" not in line]  # what a study took


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """What each command writes with kernels that are all in the cache before it starts."""
    folder = tmp_path_factory.mktemp("expected")
    return {command: _start(command, folder, None) for command in COMMANDS}


@pytest.fixture(scope="module")
def in_turn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, list[str]]]:
    """The cache that the commands filled in turn, from nothing, and what each wrote."""
    folder = tmp_path_factory.mktemp("in_turn")
    cache = folder / "cache"
    wrote: dict[str, list[str]] = {}
    kept = 0
    for command in COMMANDS:
        wrote[command] = _start(command, folder, cache)
        now = len(list(cache.rglob("*.kernel")))
        assert now > kept or command == "process", (
            f"{command} compiled nothing: choose another order"
        )
        kept = now
    return cache / FOLDER.name, wrote


def test_each_command_works_with_what_those_before_it_compiled(
    in_turn: tuple[Path, dict[str, list[str]]], expected: dict[str, list[str]]
) -> None:
    _, wrote = in_turn
    for command in COMMANDS:
        assert wrote[command] == expected[command], command
    rows = wrote["process"][1:]
    numbers = np.array([row.split(",")[:-1] for row in rows], dtype=float)
    assert len(numbers) > 500
    assert np.isfinite(numbers).all()


@pytest.mark.parametrize("first", [0, 1])
def test_kernels_of_different_processes_work_together(
    in_turn: tuple[Path, dict[str, list[str]]],
    expected: dict[str, list[str]],
    tmp_path: Path,
    first: int,
) -> None:
    """Every other kernel from the processes that filled the tests' own cache."""
    cache, _ = in_turn
    mixed = tmp_path / "cache" / FOLDER.name
    mixed.mkdir(parents=True)
    for i, file in enumerate(sorted(cache.glob("*.kernel"))):
        shutil.copy((cache, FOLDER)[(first + i) % 2] / file.name, mixed)
    shutil.copytree(cache.parents[1] / "drive", tmp_path / "drive")
    kernels = len(list(mixed.iterdir()))
    assert _start("process", tmp_path, mixed.parent) == expected["process"]
    assert len(list(mixed.iterdir())) == kernels, "it compiled: the files were of no use"


def _symbols(file: Path) -> tuple[str, set[str]]:
    """The symbol of a kernel, and all that its native code defines under numba's mangled names."""
    library, function = pickle.loads(file.read_bytes()[32:])[:2]
    bitcode = library[2][1]
    functions = llvm.parse_bitcode(bitcode).functions
    defined = {f.name for f in functions if not f.is_declaration and f.name.startswith("_ZN")}
    return function.mangled_name, defined


def _kernels(*folders: Path) -> Iterator[tuple[Path, str, set[str]]]:
    for folder in folders:
        for file in sorted(folder.glob("fusiond.*.kernel")):
            yield file, *_symbols(file)


@pytest.mark.usefixtures("expected")  # fills the tests' own cache
def test_no_symbol_of_the_kernels_is_used_twice(
    in_turn: tuple[Path, dict[str, list[str]]],
) -> None:
    """A symbol is one kernel's; and none, of numba's own functions either, is another process's."""
    cache, _ = in_turn
    here, there = list(_kernels(cache)), list(_kernels(FOLDER))
    assert len({symbol for _, symbol, _ in here}) == len(here)
    assert len({symbol for _, symbol, _ in there}) == len(there)
    of_here = {symbol for _, _, defined in here for symbol in defined}
    of_there = {symbol for _, _, defined in there for symbol in defined}
    assert len(of_here) > len(here)
    assert not of_here & of_there
