"""The one way in which numerics are compiled: explicit signature, on disk, IEEE arithmetic.

With an explicit signature numba compiles when the module is imported, or loads from its cache, and
never again: no compilation can happen inside the navigation loop. `error_model="numpy"` drops the
zero-division checks that would keep loops from being vectorised; `fastmath` stays off because it
would let results depend on the order that the compiler picks.

numba's cache notices a change of the file that holds a function, not a change of a file that holds
what the function calls and has inlined. So the cache lies in a folder named by a digest of all the
package's sources: any edit or upgrade starts a new one.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba

P = ParamSpec("P")
R = TypeVar("R")


def _cache_folder() -> Path:
    """`NUMBA_CACHE_DIR`, else the user's cache folder, with the digest of the sources below it."""
    digest = hashlib.sha256(numba.__version__.encode())
    package = Path(__file__).resolve().parents[1]
    for source in sorted(package.rglob("*.py")):
        if b"compiled(" in (text := source.read_bytes()):
            digest.update(text)
    given = os.environ.get("NUMBA_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fusiond"
    return (Path(given) if given else user) / f"kernels-{digest.hexdigest()[:16]}"


setattr(numba.config, "CACHE_DIR", str(_cache_folder()))  # noqa: B010 - a name made at run time


def compiled(signature: str, **options: Any) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile a function for one signature, ahead of its first call."""
    decorate: Callable[[Callable[P, R]], Callable[P, R]] = numba.njit(
        signature, cache=True, error_model="numpy", **options
    )
    return decorate
