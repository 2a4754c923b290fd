"""The cache of compiled kernels: symbols of several processes side by side, and damage on disk.

Each step is a process of its own, as it is for a user: what one compiles, the next one links. The
kernels are a module made for the test, since the filters' take a minute to compile.
"""

from __future__ import annotations

import ast
import hashlib
import os
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import fusiond
from fusiond.navigation.compiled import ROOMS, compiled

KERNELS = """
from functools import cache

from fusiond.navigation.compiled import compiled


@compiled("f8(f8)")
def halved(x):
    return 0.5 * x


@cache
def scaled_for(factor):
    @compiled("f8(f8)", variant=factor)
    def scaled(x):
        return factor * halved(x)

    return scaled
"""


Run = Callable[[str], subprocess.CompletedProcess[str]]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Runs Python code in a new process, with `kernels` to import and the cache of the test."""
    (tmp_path / "kernels.py").write_text(KERNELS)
    path = os.pathsep.join([str(tmp_path), *sys.path])
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": path,
    }

    def in_a_process(code: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )

    return in_a_process


IN_ORDER = "import kernels; print([kernels.scaled_for(k)(1.0) for k in {}])"


def _kept(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.kernel"))


def test_names_do_not_depend_on_the_order_of_compiling(run: Run, tmp_path: Path) -> None:
    def names(factors: tuple[int, ...]) -> set[str]:
        run(IN_ORDER.format(factors))
        files = _kept(tmp_path / "cache")
        for file in files:
            file.unlink()
        return {file.name for file in files}

    forward = names((4, 6, 8))
    assert len(forward) == 4
    assert names((8, 6, 4)) == forward


def test_no_two_kernels_share_a_symbol_across_processes(run: Run, tmp_path: Path) -> None:
    """The number that numba counts may repeat between processes; the rest of a name must not."""
    code = (
        "import kernels, itertools; from numba.core.bytecode import FunctionIdentity as f;"
        "f._unique_ids = itertools.count(1); kernels.scaled_for({})"
    )
    for factor in (4, 6, 8):
        assert run(code.format(factor)).returncode == 0
    sys.path.insert(0, str(tmp_path))  # the descriptors name their module
    try:
        symbols = [
            pickle.loads(file.read_bytes()[32:])[1].mangled_name
            for file in _kept(tmp_path / "cache")
        ]
    finally:
        sys.path.remove(str(tmp_path))
    assert len(symbols) == 4
    assert len(set(symbols)) == 4


def test_counts_of_two_processes_do_not_meet(run: Run) -> None:
    code = (
        "import fusiond.navigation.compiled; from numba.core.bytecode import FunctionIdentity as f;"
        "print(f.from_function(lambda: 0).unique_id)"
    )
    first, second = int(run(code).stdout), int(run(code).stdout)
    assert abs(first - second) > 100_000


def test_what_compiling_needs_is_loaded_when_a_kernel_is_missing(run: Run) -> None:
    code = IN_ORDER + "; import sys; print('numba.np.linalg' in sys.modules)"
    assert run(code.format((4,))).stdout.split()[-1] == "True"
    assert run(code.format((4,))).stdout.split()[-1] == "False"
    # One of two is new: it calls, and inlines, one that was only linked.
    assert run(code.format((4, 6))).stdout == "[2.0, 3.0]\nTrue\n"


CALLED = "from fusiond.navigation import kernel_cache; kernel_cache.CALLED_FROM = 1; "


def _contents(folder: Path, name: str) -> Any:
    (file,) = folder.rglob(f"{name}-*.kernel")
    return pickle.loads(file.read_bytes()[32:])


def test_large_kernels_are_called_across_processes(run: Run, tmp_path: Path) -> None:
    """Compiled in three processes, linked in a fourth; none holds a copy of what it calls."""
    for factor in (4, 6, 8):
        assert run(CALLED + f"import kernels; kernels.scaled_for({factor})(1.0)").returncode == 0
    used = run(CALLED + IN_ORDER.format((8, 4, 6)))
    assert (used.stdout, used.stderr) == ("[4.0, 2.0, 3.0]\n", "")
    sys.path.insert(0, str(tmp_path))
    try:
        halved = _contents(tmp_path / "cache", "kernels.halved")
        for factor in (4, 6, 8):
            scaled = _contents(tmp_path / "cache", f"kernels.scaled_for.scaled_{factor}")
            assert scaled[-1] == [("kernels.halved", halved[1].llvm_func_name)]
            assert halved[2].count(b"halved") > scaled[2].count(b"halved") > 0
            assert scaled[3] == halved[3] == b""  # bitcode
    finally:
        sys.path.remove(str(tmp_path))


def test_a_called_kernel_compiled_anew_serves_its_callers(run: Run, tmp_path: Path) -> None:
    code = CALLED + IN_ORDER.format((4, 6))
    run(code)
    (halved,) = (tmp_path / "cache").rglob("kernels.halved-*.kernel")
    kept = {file: file.stat().st_mtime_ns for file in _kept(tmp_path / "cache") if file != halved}
    halved.unlink()
    again = run(code)
    assert (again.stdout, again.stderr) == ("[2.0, 3.0]\n", "")
    assert halved.exists()
    assert kept == {file: file.stat().st_mtime_ns for file in kept}


def test_a_call_of_a_symbol_that_is_not_there_compiles_the_caller(run: Run, tmp_path: Path) -> None:
    """Otherwise the linker ends the process."""
    code = CALLED + IN_ORDER.format((4,))
    run(code)
    (file,) = (tmp_path / "cache").rglob("kernels.scaled_for.scaled_4-*.kernel")
    sys.path.insert(0, str(tmp_path))
    try:
        *contents, calls = pickle.loads(file.read_bytes()[32:])
    finally:
        sys.path.remove(str(tmp_path))
    payload = pickle.dumps((*contents, [(name, symbol + "x") for name, symbol in calls]))
    file.write_bytes(hashlib.sha256(payload).digest() + payload)
    again = run(code)
    assert (again.returncode, again.stdout) == (0, "[2.0]\n"), again.stderr
    assert "calls kernels.halved, which is another now" in again.stderr
    assert run(code).stderr == ""


def test_a_second_kernel_of_the_same_name_is_refused() -> None:
    def make() -> None:
        @compiled("f8(f8)")
        def _again(x: float) -> float:
            return x

    make()
    with pytest.raises(ValueError, match=r"two kernels of the name .*_again"):
        make()


def _cut_short(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def _empty(file: Path) -> None:
    file.write_bytes(b"")


def _flip(at: float) -> Callable[[Path], None]:
    def flip(file: Path) -> None:
        data = bytearray(file.read_bytes())
        data[int(at * (len(data) - 1))] ^= 0x10
        file.write_bytes(data)

    return flip


def _folder(file: Path) -> None:
    file.unlink()
    file.mkdir()
    (file / "something").write_text("in the way")


DAMAGES = (_cut_short, _empty, _flip(0.0), _flip(0.3), _flip(0.6), _flip(1.0), _folder)


def test_damaged_kernels_are_compiled_anew(run: Run, tmp_path: Path) -> None:
    """Each file in another way: digest, native code and bitcode among what is altered."""
    code = IN_ORDER.format(range(6))
    right = f"{[0.5 * k for k in range(6)]}\n"
    assert run(code).stdout == right
    for file, damage in zip(_kept(tmp_path / "cache"), DAMAGES, strict=True):
        damage(file)
    result = run(code)
    assert (result.returncode, result.stdout) == (0, right), result.stderr
    assert result.stderr.count("the kernel is compiled anew") == len(DAMAGES)
    again = run(code)
    assert (again.stdout, again.stderr) == (right, "")


def test_kernels_run_where_nothing_can_be_kept(run: Run, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("no folder")  # holds for root as well, unlike permissions
    result = run(IN_ORDER.format((4,)))
    assert (result.returncode, result.stdout) == (0, "[2.0]\n"), result.stderr


def test_a_process_killed_while_it_writes_leaves_no_half_kernel(run: Run, tmp_path: Path) -> None:
    killed = run("import os; os.replace = lambda *_: os.kill(os.getpid(), 9)\nimport kernels")
    assert killed.returncode == -9
    assert not _kept(tmp_path / "cache")
    assert run(IN_ORDER.format((4,))).stdout == "[2.0]\n"


def test_a_later_start_removes_what_a_killed_writer_left(run: Run, tmp_path: Path) -> None:
    run("import os; os.replace = lambda *_: os.kill(os.getpid(), 9)\nimport kernels")
    (left,) = (tmp_path / "cache").rglob("*.writing")
    (writer,) = re.findall(r"\.(\d+)-[0-9a-f]+\.writing$", left.name)
    alive = left.with_name(left.name.replace(f".{writer}-", f".{os.getpid()}-"))
    alive.write_bytes(b"half")
    run("import kernels")
    assert not left.exists()
    assert alive.exists()
    assert len(_kept(tmp_path / "cache")) == 1


def _imports(source: Path) -> set[str]:
    """Names of the modules of fusiond that a module takes something from."""
    found = set()
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
    return {name for name in found if name.startswith("fusiond.")}


def test_the_cache_changes_with_all_that_kernels_import() -> None:
    """A kernel has constants and code of other modules inlined: these are in the digest, too."""
    package = Path(fusiond.__file__).parent
    modules = {
        ".".join(path.relative_to(package.parent).with_suffix("").parts): path
        for path in package.rglob("*.py")
    }
    open_ = [name for name, path in modules.items() if "\n@compiled(" in path.read_text()]
    assert len(open_) > 20
    reached: set[str] = set()
    while open_:
        name = open_.pop()
        if name in reached or name not in modules:
            continue
        reached.add(name)
        open_ += _imports(modules[name])
    rooms = {name.split(".")[1] for name in reached}
    assert rooms <= set(ROOMS)


def test_a_constant_of_another_module_makes_a_new_cache(tmp_path: Path) -> None:
    """Of a copy of the package, in a process that compiles nothing."""
    source = tmp_path / "fusiond"
    shutil.copytree(Path(fusiond.__file__).parent, source, ignore=lambda *_: ["__pycache__"])

    def folder() -> str:
        return subprocess.run(
            [sys.executable, "-c", "from fusiond.navigation.compiled import FOLDER; print(FOLDER)"],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
            capture_output=True,
            text=True,
            timeout=300,
            check=True,
        ).stdout

    before = folder()
    assert folder() == before
    model = source / "models" / "model.py"
    changed = re.sub(r"(?m)^PLAIN.*$", "PLAIN, SCALE = 2, 1", model.read_text())
    assert changed != model.read_text()
    model.write_text(changed)
    assert folder() != before
