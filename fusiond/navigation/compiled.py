"""Compilation of kernels: explicit signature, on disk, IEEE arithmetic.

With an explicit signature numba compiles when the module is imported and never again: no
compilation can happen inside the navigation loop. A kernel that is in the cache already is linked
when it is first called, or when one that is being compiled calls it; `load_kernels` does that for
all that a loop which keeps time may call, before it. Where somebody waits for the imports,
`gathered` lists what is to be compiled: for other processes, that end and give their memory back.
`error_model="numpy"` drops the zero-division checks that would keep loops from being vectorised;
`fastmath` stays off because it would let results depend on the order that the compiler picks.
References are counted where a kernel makes arrays and nowhere else (`_nrt`): a count is atomic, a
slice or a row costs two, an argument one and a small piece of memory, and a caller's arguments live
longer than the call.

The cache lies in a folder named by a digest of the sources of all rooms that a kernel takes code or
constants from, since it has them inlined: any edit there or upgrade starts a new one.

What is in the cache was compiled by several processes and is linked in one, by symbol. numba forms
a symbol of module, qualified name, argument types and a number that counts the functions compiled
in the process: two closures of one name, compiled in two processes, may get the same symbol, and
one of them then runs in place of the other. So every kernel has a name of its own (a variant of a
closure says which) and the number 0 in every process: its code calls other kernels by symbol. For
numba's own closures the count starts somewhere else in each process, forked ones too.
"""

from __future__ import annotations

import hashlib
import inspect
import itertools
import os
import secrets
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numba
import numpy as np
from numba.core.bytecode import FunctionIdentity
from numba.core.compiler_lock import global_compiler_lock
from numba.core.types import Array
from numba.np.numpy_support import FROM_DTYPE, map_layout

from fusiond.navigation.kernel_cache import (
    KernelCache,
    can_keep,
    kept_in,
    kernel_name,
    waiting,
)
from fusiond.navigation.shipped_kernels import shipped_in

# numba's functions have no types.
_array: Any = Array
_layout: Any = map_layout

P = ParamSpec("P")
R = TypeVar("R")


# Rooms of modules that compile, and of all that these import.
ROOMS = (
    *("navigation", "models", "gnss", "files", "aiding", "estimators"),
    *("integrity", "simulation", "studies"),
)


def _cache_folder() -> Path:
    """Folder `NUMBA_CACHE_DIR`, else the user's cache folder, with the digest of the sources below
    it."""
    digest = hashlib.sha256(f"{sys.implementation.cache_tag} {numba.__version__}".encode())
    package = Path(__file__).resolve().parents[1]
    for room in ROOMS:
        for folder, inner, files in os.walk(package / room):
            inner[:] = sorted({*inner} - {"__pycache__"})
            for name in sorted(files):
                if name.endswith(".py"):
                    with open(f"{folder}/{name}", "rb", buffering=0) as source:
                        digest.update(source.read())
    given = os.environ.get("NUMBA_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fusiond"
    return (Path(given) if given else user) / f"kernels-{digest.hexdigest()[:16]}"


FOLDER = _cache_folder()


class Missing(NamedTuple):
    """A kernel that lies in no cache: `load` compiles it, with those that it calls, and leaves it
    there. `variant` is that of one of several which one piece of source makes."""

    load: Callable[[], None]
    variant: int | None


_names: set[str] = set()
_variants: dict[str, int] = {}
_in_cache = kept_in(FOLDER)
_shipped = shipped_in(Path(__file__).with_name("prebuilt") / FOLDER.name)
_gathered: list[Missing] | None = None


def _count_from_anywhere() -> None:
    """2^48 starts: no two processes that filled a cache count through the same numbers."""
    setattr(FunctionIdentity, "_unique_ids", itertools.count(secrets.randbits(48)))  # noqa: B010


def _number_kernels() -> None:
    """Give each kernel the number 0: its symbol is the same in every process."""
    identify: Any = FunctionIdentity.from_function

    def from_function(_: object, function: Any) -> Any:
        identity = identify(function)
        if getattr(function, "is_kernel", False):
            identity.unique_id, identity.unique_name = 0, f"{identity.func_qualname}$0"
        return identity

    setattr(FunctionIdentity, "from_function", classmethod(from_function))  # noqa: B010


_number_kernels()
_count_from_anywhere()
os.register_at_fork(after_in_child=_count_from_anywhere)


def compiled(
    signature: str, *, variant: int | None = None, allocates: bool = False, **options: Any
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile a function for one signature, ahead of its first call.

    `variant` tells apart the kernels that one piece of source makes. A kernel that makes an array
    or returns one `allocates`; the others count no references to the memory of their arguments,
    which their caller holds. ValueError where a kernel of the same name exists: the cache and the
    linker know kernels by name.
    """

    def compile_function(function: Callable[P, R]) -> Callable[P, R]:
        if variant is not None:
            function.__name__ += f"_{variant}"
            function.__qualname__ += f"_{variant}"
        name = kernel_name(function.__module__, function.__qualname__)
        if name in _names:
            raise ValueError(f"two kernels of the name {name}: give each a variant of its own")
        _names.add(name)
        if variant is not None:
            _variants[name] = variant
        options.update(error_model="numpy", _nrt=allocates, no_cfunc_wrapper=True)
        setattr(function, "is_kernel", True)  # noqa: B010
        setattr(function, "__signature__", inspect.signature(function))  # noqa: B010 - asked twice
        kernel = numba.njit(**options)(function)
        kernel.typeof_pyval = partial(_type_of, kernel)
        kernel._cache = cache = KernelCache(FOLDER, _shipped, name, signature, kernel.targetctx)
        if cache.shipped is not None or cache.file_name in _in_cache:
            _load_when_called(kernel, name, signature)
        elif _gathered is not None:
            _gathered.append(Missing(_load_when_called(kernel, name, signature), variant))
        else:
            kernel.compile(signature)
            kernel.disable_compile()
        finished: Callable[P, R] = kernel
        return finished

    return compile_function


@contextmanager
def gathered() -> Iterator[list[Missing]]:
    """Collect imported kernels without a cached file instead of compiling them: each item compiles
    one kernel, with those that it calls, into the cache. A called kernel is compiled at once."""
    global _gathered  # noqa: PLW0603 - imports have no other way to be told
    missing: list[Missing] = []
    outer, _gathered = _gathered, missing
    try:
        yield missing
    finally:
        _gathered = outer


def needed(
    missing: Iterable[Missing], variants: Collection[int] | None = None
) -> list[Callable[[], None]]:
    """Jobs that compile them; of those one piece of source makes, these `variants` alone. Half of
    the compiler's time is theirs, and a vehicle has one or two of four."""
    return [
        load
        for load, variant in missing
        if variant is None or variants is None or variant in variants
    ]


def kernels_can_be_kept() -> bool:
    """True if compiled kernels can be stored for other processes and the next start."""
    return can_keep(FOLDER)


def load_compiler() -> None:
    """Load the compiler before compiling processes are forked: numba's tables and runtime otherwise
    load with the first function."""
    numba.njit("f8(f8)")(lambda x: x)


def load_kernels(variants: Collection[int]) -> None:
    """Link every imported kernel not called yet, before a loop that keeps time; of those with one
    source only these `variants`. Any other is linked at its call."""
    with global_compiler_lock:
        for name, load in [*waiting.items()]:
            if name not in _variants or _variants[name] in variants:
                load()


def _load_when_called(kernel: Any, name: str, signature: str) -> Callable[[], None]:
    """Link the kernel at its first call, or compile it without a cached file; returns the callable.
    A dispatcher without signature asks `_compile_for_args` for that of a call, and the compiler
    asks `get_call_template` for that of a calling kernel: it would compile for the very types at
    hand."""

    def load() -> None:
        with global_compiler_lock:
            if waiting.pop(name, None) is not None:
                del kernel._compile_for_args, kernel.get_call_template
                found = kernel._cache.load_overload(signature, kernel.targetctx)
                if found is None:
                    kernel.compile(signature)
                else:
                    kernel.targetctx.insert_user_function(
                        found.entry_point, found.fndesc, [found.library]
                    )
                    kernel.add_overload(found)
                kernel.disable_compile()

    def first_call(*_: Any, **__: Any) -> Any:
        load()
        return kernel  # it is what is called next, with the arguments' types looked at

    def called_by_another(*types: Any) -> Any:
        load()
        return kernel.get_call_template(*types)

    kernel._compile_for_args, kernel.get_call_template = first_call, called_by_another
    waiting[name] = load
    return load


def _type_of(kernel: Any, value: Any) -> Any:
    """Type of an argument for numba's dispatcher, cached by kind of array: its test for masked
    arrays imports them, which takes as long as linking twenty kernels."""
    kind = FROM_DTYPE.get(value.dtype) if type(value) is np.ndarray else None
    if kind is None:
        return type(kernel).typeof_pyval(kernel, value)
    found = _array(kind, value.ndim, _layout(value), readonly=not value.flags.writeable)
    kernel._types_active_call.add(found)
    return found
