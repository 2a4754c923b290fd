"""The package as a vehicle installs it: a wheel in a virtual environment, no checkout beside it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from tests.places import REPOSITORY
from tools import debian_package, licences

CONFIG = REPOSITORY / "config"
PAGE = "fusiond/report/assets"
DASHBOARD = "fusiond/dashboard/static"
PLOTS = f"{DASHBOARD}/uplot"  # a link to the report's


def _run(*command: str | Path, folder: Path) -> str:
    """Run in `folder`, where nothing of the checkout is found; standard output."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    run = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy of what `systemd/README.md` copies: a build leaves folders behind."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE", licences.FILE.name):
        shutil.copy(REPOSITORY / name, folder)
    for name in ("fusiond", "drivers", "config"):
        shutil.copytree(
            REPOSITORY / name,
            folder / name,
            symlinks=True,
            ignore=shutil.ignore_patterns("__pycache__"),
        )
    options = ("--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", "out")
    _run(sys.executable, "-m", "pip", "wheel", *options, ".", folder=folder)
    (built,) = (folder / "out").glob("fusiond-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`bin` of an environment with the wheel; its dependencies are those of the tests."""
    folder = tmp_path_factory.mktemp("installed")
    _run(sys.executable, "-m", "venv", "--without-pip", "venv", folder=folder)
    python = folder / "venv" / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python)
    _run(*pip, "install", "--no-deps", "--quiet", wheel, folder=folder)
    # A line of a .pth file is only looked at after the environment's own packages, and editable
    # installations of what it names do not follow along.
    packages = _run(
        python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", folder=folder
    )
    (Path(packages.strip()) / "tests.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python.parent


def test_the_wheel_holds_every_shipped_file(wheel: Path) -> None:
    linked = (REPOSITORY / PLOTS).resolve()
    pages = {name: REPOSITORY / name for name in (PAGE, DASHBOARD)}
    folders = {"drivers/config": CONFIG, **pages, PLOTS: linked}
    shipped = {
        f"{name}/{path.relative_to(folder)}": path.read_bytes()
        for name, folder in folders.items()
        for path in folder.rglob("*")
        if path.is_file()
    }
    with zipfile.ZipFile(wheel) as archive:
        held = {
            name: archive.read(name)
            for name in archive.namelist()
            if name.startswith(tuple(f"{folder}/" for folder in folders))
        }
    assert held == shipped
    assert {"drivers/config/vehicle.toml", "drivers/config/dbc/xsens_mti600.dbc"} < set(held)
    assert {f"{DASHBOARD}/index.html", f"{PLOTS}/uPlot.iife.min.js", f"{PLOTS}/LICENSE"} < set(held)


def test_the_terms_of_others_travel_with_the_wheel(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = {n.rpartition("/")[2]: n for n in archive.namelist() if "/licenses/" in n}
        assert set(held) == {"LICENSE", licences.FILE.name}
        assert archive.read(held[licences.FILE.name]) == licences.FILE.read_bytes()


def test_every_locked_package_has_terms_that_were_looked_at_and_their_text() -> None:
    assert licences.FILE.read_text() == licences.text(), "run python -m tools.licences"
    names = licences.locked(REPOSITORY / "requirements.lock")
    found = licences.packages(Path(sysconfig.get_path("purelib")), names)
    assert {package.name for package in found} == names
    assert licences.faults(found) == []
    assert ("python-can", "LGPL-3.0-only", True) in [(p.name, p.licence, p.has_text) for p in found]
    strange = licences.Package("new", "1", "AGPL-3.0-only", False)
    assert licences.faults([strange]) == [
        "new: nobody has looked at 'AGPL-3.0-only'",
        "new: the text of its licence is nowhere",
    ]


def test_the_debian_package_states_the_terms_of_python_can() -> None:
    text = debian_package.COPYRIGHT.format(third_party=licences.FILE.name)
    stanzas = text.split("\n\n")
    (python_can,) = [one for one in stanzas if "site-packages/can/" in one]
    for words in ("LGPL-3.0-only", "common-licenses/LGPL-3", "common-licenses/GPL-3"):
        assert words in python_can
    assert licences.FILE.name in debian_package.SOURCES


def test_shipped_files_are_the_installed_ones(installed: Path, tmp_path: Path) -> None:
    where = _run(
        installed / "python",
        "-c",
        "from drivers.can.dbc import find_dbc; print(find_dbc('xsens_mti600'))\n"
        "from drivers.shipped_files import shipped; print(shipped('vehicle.toml'))",
        folder=tmp_path,
    )
    for path in map(Path, where.split()):
        assert path.is_file()
        assert path.is_relative_to(installed.parent)


def test_a_shipped_dbc_is_found_from_anywhere(installed: Path, tmp_path: Path) -> None:
    example = tmp_path / "vehicle.toml"
    shutil.copy(CONFIG / "vehicle.toml", example)
    assert 'dbc = "xsens_mti600"' in example.read_text()
    report = _run(installed / "fusiond", "check", example, folder=tmp_path)
    assert f"{example}: ok" in report.replace("\n", "")


def test_an_installation_leaves_the_bytecode_of_what_commands_import(tmp_path: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment |= {
        "PYTHONPYCACHEPREFIX": str(tmp_path / "bytecode"),
        "NUMBA_CACHE_DIR": str(tmp_path / "kernels"),
    }
    command = (sys.executable, "-m", "tools.bytecode")
    subprocess.run(command, cwd=REPOSITORY, env=environment, check=True)
    left = [path.as_posix() for path in (tmp_path / "bytecode").rglob("*.pyc")]
    for module in (
        *("fusiond/commands/app", "fusiond/live/daemon", "fusiond/offline/process"),
        *(
            "drivers/can/base_driver",
            "drivers/rdss/driver",
            "numba/core/dispatcher",
            "pydantic/main",
        ),
    ):
        assert any(f"{module}.{sys.implementation.cache_tag}" in path for path in left), module
    assert not (tmp_path / "kernels").exists()  # they come with the first command that needs them
