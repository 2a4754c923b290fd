"""The one way in which numerics are compiled: explicit signature, on disk, IEEE arithmetic.

With an explicit signature numba compiles when the module is imported, or loads from its cache, and
never again: no compilation can happen inside the navigation loop. `error_model="numpy"` drops the
zero-division checks that would keep loops from being vectorised; `fastmath` stays off because it
would let results depend on the order that the compiler picks.

The cache lies in a folder named by a digest of the sources of all rooms that a kernel takes code or
constants from, since it has them inlined: any edit there or upgrade starts a new one.

What is in the cache was compiled by several processes and is linked in one, by symbol. numba forms
a symbol of module, qualified name, argument types and a number that counts the functions compiled
in the process: two closures of one name, compiled in two processes, may get the same symbol, and
one of them then runs in place of the other. So every kernel has a name of its own (a variant of a
closure says which), and the count starts somewhere else in each process, for numba's own closures.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import secrets
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
from numba.core.bytecode import FunctionIdentity

from fusiond.navigation.kernel_cache import KernelCache, remove_strays

P = ParamSpec("P")
R = TypeVar("R")


# Rooms of modules that compile, and of all that these import.
ROOMS = (
    *("navigation", "models", "gnss", "files", "aiding", "estimators"),
    *("integrity", "simulation", "studies"),
)


def _cache_folder() -> Path:
    """`NUMBA_CACHE_DIR`, else the user's cache folder, with the digest of the sources below it."""
    digest = hashlib.sha256(f"{sys.implementation.cache_tag} {numba.__version__}".encode())
    package = Path(__file__).resolve().parents[1]
    for room in ROOMS:
        for source in sorted((package / room).rglob("*.py")):
            digest.update(source.read_bytes())
    given = os.environ.get("NUMBA_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fusiond"
    return (Path(given) if given else user) / f"kernels-{digest.hexdigest()[:16]}"


FOLDER = _cache_folder()
remove_strays(FOLDER)
_names: set[str] = set()

# 2^48 starts: no two processes that filled a cache count through the same numbers.
setattr(FunctionIdentity, "_unique_ids", itertools.count(secrets.randbits(48)))  # noqa: B010


def compiled(
    signature: str, *, variant: int | None = None, **options: Any
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile a function for one signature, ahead of its first call.

    `variant` tells apart the kernels that one piece of source makes. ValueError where a kernel of
    the same name exists: the cache and the linker know kernels by name.
    """

    def compile_function(function: Callable[P, R]) -> Callable[P, R]:
        if variant is not None:
            function.__name__ += f"_{variant}"
            function.__qualname__ += f"_{variant}"
        name = f"{function.__module__}.{function.__qualname__}".replace("<locals>.", "")
        if name in _names:
            raise ValueError(f"two kernels of the name {name}: give each a variant of its own")
        _names.add(name)
        kernel = numba.njit(error_model="numpy", **options)(function)
        kernel._cache = KernelCache(FOLDER, name)
        kernel.compile(signature)
        kernel.disable_compile()
        finished: Callable[P, R] = kernel
        return finished

    return compile_function
