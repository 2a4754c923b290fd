"""Rewritten assertions of all test files, before the processes of a run share them.

    pytest --noconftest -p tests.rewritten

On a fresh clone each process would rewrite all files, for ten seconds. `pytest --collect-only`
does it as well, but imports what is tested, and so has to wait for the kernels.
"""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path

import pytest
from _pytest.assertion.rewrite import (
    PYC_TAIL,
    _read_pyc,
    _rewrite_test,
    _write_pyc,
    assertstate_key,
    get_cache_dir,
)


def pytest_cmdline_main(config: pytest.Config) -> int:
    """In place of a run."""
    names = [*config.getini("python_files"), "conftest.py"]
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        if any(fnmatch(file.name, name) for name in names):
            rewrite(file, config)
    return 0


def rewrite(file: Path, config: pytest.Config) -> None:
    folder = get_cache_dir(file)
    kept = folder / (file.stem + PYC_TAIL)
    if _read_pyc(file, kept) is None:
        folder.mkdir(parents=True, exist_ok=True)
        source_hash, code = _rewrite_test(file, config)
        _write_pyc(config.stash[assertstate_key], code, source_hash, kept)
