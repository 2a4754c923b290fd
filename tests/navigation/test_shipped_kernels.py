"""Kernels that came with the package: linked instead of compiled, checked, left alone.

As in a vehicle: a copy of the package with kernels of a level in it, and an empty cache.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import fusiond
from fusiond.navigation.shipped_kernels import LEVELS, shipped_in
from tests.navigation.test_compiled import KERNELS

USE = "import kernels; print(kernels.scaled_for(4)(1.0), kernels.halved(3.0))"
WHERE = "from fusiond.navigation.compiled import FOLDER; print(FOLDER)"
WRITTEN = "2.0 1.5\n"
# What every processor of the architecture has that fusiond runs on here.
LEVEL = list(LEVELS[platform.machine()])[-1]


class Vehicle:
    """A package, its cache and processes that import it."""

    def __init__(self, folder: Path) -> None:
        self.package = folder / "site" / "fusiond"
        self.cache = folder / "cache"
        shutil.copytree(
            Path(fusiond.__file__).parent,
            self.package,
            ignore=shutil.ignore_patterns("__pycache__", "prebuilt"),
        )
        (folder / "site" / "kernels.py").write_text(KERNELS)

    def run(self, code: str, cache: Path | None = None, **more: str) -> str:
        """Standard output, and standard error if there is any."""
        path = os.pathsep.join([str(self.package.parent), *sys.path])
        environment = {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(cache or self.cache), **more}
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=self.package.parent,
            env=os.environ | environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=True,
        )
        return done.stdout + done.stderr

    def ship(self, level: str, folder: Path) -> list[Path]:
        """Compile for a level, elsewhere, and put it into the package."""
        self.run(USE, folder, NUMBA_CPU_NAME=level, NUMBA_CPU_FEATURES="")
        (made,) = folder.iterdir()
        there = self.package / "navigation" / "prebuilt" / made.name / level
        shutil.copytree(made, there)
        return sorted(there.iterdir())

    @property
    def compiled(self) -> list[Path]:
        return sorted(self.cache.rglob("*.kernel"))


@pytest.fixture
def vehicle(tmp_path: Path) -> Vehicle:
    return Vehicle(tmp_path)


def test_nothing_is_compiled_where_kernels_came_with_the_package(
    vehicle: Vehicle, tmp_path: Path
) -> None:
    assert len(vehicle.ship(LEVEL, tmp_path / "made")) == 2
    assert vehicle.run(USE) == WRITTEN
    assert not vehicle.cache.exists()
    code = USE + "; import sys; print('numba.np.linalg' in sys.modules)"
    assert vehicle.run(code) == WRITTEN + "False\n"  # what compiling needs was not even loaded


def test_a_damaged_one_is_left_told_and_compiled_here(vehicle: Vehicle, tmp_path: Path) -> None:
    files = vehicle.ship(LEVEL, tmp_path / "made")
    data = bytearray(files[0].read_bytes())
    data[len(data) // 2] ^= 0x10
    files[0].write_bytes(data)
    said = vehicle.run(USE)
    assert said.startswith(WRITTEN)
    assert "is damaged (its checksum is wrong): install the package again" in said
    assert files[0].read_bytes() == bytes(data)
    assert len(vehicle.compiled) == 1
    assert vehicle.run(USE) == WRITTEN  # by what was compiled here


def test_a_kernel_that_did_not_come_is_compiled_with_those_that_did(
    vehicle: Vehicle, tmp_path: Path
) -> None:
    vehicle.ship(LEVEL, tmp_path / "made")
    assert vehicle.run(USE.replace("scaled_for(4)(1.0)", "scaled_for(6)(1.0)")) == "3.0 1.5\n"
    assert [file.name.split("-")[0] for file in vehicle.compiled] == ["kernels.scaled_for.scaled_6"]


def test_those_of_other_sources_are_of_no_use(vehicle: Vehicle, tmp_path: Path) -> None:
    vehicle.ship(LEVEL, tmp_path / "made")
    with (vehicle.package / "models" / "model.py").open("a") as file:
        file.write("# changed\n")
    assert vehicle.run(USE) == WRITTEN
    assert len(vehicle.compiled) == 2


def test_a_processor_takes_the_best_level_that_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def features(*names: str) -> None:
        there = dict.fromkeys(names, True) | {"avx512f": False}
        monkeypatch.setattr("fusiond.navigation.shipped_kernels._host_features", lambda: there)

    levels = LEVELS["x86_64"]
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    for level in levels:
        (tmp_path / level).mkdir()
    features(*levels["x86-64-v2"], *levels["x86-64-v3"])
    best = shipped_in(tmp_path)
    assert best is not None
    assert best.level == "x86-64-v3"
    features(*levels["x86-64-v2"], *levels["x86-64-v3"][:-1])
    poorer = shipped_in(tmp_path)
    assert poorer is not None
    assert poorer.level == "x86-64-v2"
    features("sse3")
    assert shipped_in(tmp_path) is None
    assert shipped_in(tmp_path / "none") is None
    monkeypatch.setattr(platform, "machine", lambda: "riscv64")
    assert shipped_in(tmp_path) is None


@pytest.mark.skipif(platform.machine() != "x86_64", reason="levels are those of x86-64")
def test_the_names_of_features_are_those_of_this_llvm() -> None:
    from llvmlite.binding import get_host_cpu_features  # noqa: PLC0415

    known = set(get_host_cpu_features())
    for level, needs in LEVELS["x86_64"].items():
        assert set(needs) <= known, level
