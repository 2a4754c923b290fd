"""`import fusiond` and `python -m fusiond`: what `docs/python.md` promises."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fusiond
from tests.places import REPOSITORY

PAGE = (REPOSITORY / "docs" / "python.md").read_text()


def python(*arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
        cwd=REPOSITORY,
    )
    return done.stdout


def test_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(REPOSITORY)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    names: dict[str, Any] = {}
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)):
        exec(compile(block, f"docs/python.md, block {number}", "exec"), names)
    mode, horizontal_rms_m, nees = capsys.readouterr().out.splitlines()[0].split()
    assert mode == "navigating"
    sd_n, sd_e, _ = names["gnss"].sd_position.max(axis=0)
    assert 0.0 < float(horizontal_rms_m) < np.hypot(sd_n, sd_e)  # better than a fix by itself
    # 95 % of the mean of 50 s of errors that are correlated over 10 s, so of 5 independent ones
    # of two degrees of freedom: chi squared of 10, over 5.
    assert 0.6 < float(nees) < 4.2
    # The files hold what the arrays held, but for the fix of the last instant itself: 1 cm here.
    by_files, by_arrays = fusiond.read_solution(names["out"]), names["solutions"][-1]
    assert round(by_files.t_s[-1] * 1e9) == by_arrays.t_ns
    assert by_files.lat_rad[-1] == pytest.approx(by_arrays.lat_rad, abs=1e-8)
    assert by_files.lon_rad[-1] == pytest.approx(by_arrays.lon_rad, abs=1e-8)
    assert names["errors"]["horizontal_rms_m"] == pytest.approx(float(horizontal_rms_m), rel=0.1)
    assert names["estimator"].sigmas()[:3] == pytest.approx(0.01)


def test_every_public_name_is_on_the_page() -> None:
    tables = PAGE.partition("## Every public name")[2]
    rows = [line.split("|")[1] for line in tables.splitlines() if line.startswith("| `")]
    documented = {name for row in rows for name in re.findall(r"`(\w+)(?=[`(])", row)}
    assert documented == set(fusiond.__all__)
    methods = re.findall(r"`Navigator\.(\w+)\(", "".join(rows))
    assert methods == ["add_imu", "add", "advance", "solution"]
    assert all(callable(getattr(fusiond.Navigator, method)) for method in methods)


def test_every_public_name_can_be_imported_and_is_described() -> None:
    for name in fusiond.__all__:
        value = getattr(fusiond, name)
        if name not in ("MODELS", "SCENARIOS"):
            assert value.__doc__, name
    assert set(fusiond.__all__) <= set(dir(fusiond))
    with pytest.raises(AttributeError, match="no attribute 'navigate'"):
        _ = fusiond.navigate  # type: ignore[attr-defined]


def test_a_type_checker_sees_the_same_objects() -> None:
    """The imports under TYPE_CHECKING are those that happen at run time."""
    tree = ast.parse((REPOSITORY / "fusiond" / "__init__.py").read_text())
    guarded = next(node for node in tree.body if isinstance(node, ast.If))
    assert ast.unparse(guarded.test) == "TYPE_CHECKING"
    promised = {
        alias.asname: (node.module, alias.name)
        for node in guarded.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert set(promised) == set(fusiond.__all__)
    for name, (module, original) in promised.items():
        assert module is not None
        assert name == original
        assert getattr(import_module(module), name) is getattr(fusiond, name)


def test_importing_costs_nothing() -> None:
    loaded = set(python("-c", "import sys, fusiond; print(*sys.modules)").split())
    assert not {"numpy", "numba", "pydantic", "drivers.measurements"} & loaded
    assert [name for name in loaded if name.startswith("fusiond")] == ["fusiond"]


def test_solutions_become_a_table() -> None:
    known = fusiond.Solution(
        2_500_000_000, fusiond.Mode.NAVIGATING, "", 0.5, 2.0, 30.0, v_ned_m_s=(1.0, 2.0, 3.0)
    )
    waiting = fusiond.Solution(1_000_000_000, fusiond.Mode.WAITING, "")
    table = fusiond.trajectory_of([waiting, known])
    assert table.t_s.tolist() == [1.0, 2.5]
    assert table.status == ["waiting", "navigating"]
    assert np.isnan(table.v[0]).all()
    assert table.v[1].tolist() == [1.0, 2.0, 3.0]
    assert (table.lat_rad[1], table.lon_rad[1], table.height_m[1]) == (0.5, 2.0, 30.0)
    assert fusiond.trajectory_of([]).rpy.shape == (0, 3)


def test_python_m_is_the_command_line() -> None:
    assert python("-m", "fusiond", "--version") == f"fusiond {version('fusiond')}\n"
    text = python("-m", "fusiond", "--help")
    assert "python -m fusiond" in text
    assert "process" in text
