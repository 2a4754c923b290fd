"""The one way in which numerics are compiled: explicit signature, on disk, IEEE arithmetic.

With an explicit signature numba compiles when the module is imported, or loads from its cache, and
never again: no compilation can happen inside the navigation loop. `error_model="numpy"` drops the
zero-division checks that would keep loops from being vectorised; `fastmath` stays off because it
would let results depend on the order that the compiler picks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numba

P = ParamSpec("P")
R = TypeVar("R")


def compiled(signature: str, **options: Any) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile a function for one signature, ahead of its first call."""
    decorate: Callable[[Callable[P, R]], Callable[P, R]] = numba.njit(
        signature, cache=True, error_model="numpy", **options
    )
    return decorate
