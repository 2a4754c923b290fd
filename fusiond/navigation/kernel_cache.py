"""Compiled kernels on disk: one checked file a kernel.

A file holds a SHA-256, then numba's form of a compiled function. Native code is linked only if that
digest is right: a file that is cut, emptied or altered by a bit is removed, reported, and the
kernel compiled again. (numba's own cache checks nothing: it passes any content to the linker, which
aborts the process.) The digest detects damage, not malice: a user with write access to the folder
may run code here, as with any folder of Python modules.

Files are written under a temporary name and renamed, so that parallel or dying processes leave
complete files; a later start removes the leftovers. If nothing can be written, kernels are compiled
at each start.

A package may include kernels compiled at its build, for a level of processors: they are checked and
linked like those of the cache, and never removed. The cache has precedence.

A start that finds all kernels compiles nothing, and does not load what numba needs to compile: its
tables of implementations (a fifth of the processor time of a start) and the bitcode of the kernels,
which others inline (another seventh). Both come when a kernel is missing. A cached kernel is linked
at its first call, 0.3 ms each: of 170 imported ones a drive on files calls 36
(fusiond.navigation.compiled). The linker receives the native code directly; numba's own way through
an LLVM module takes three times as long.

A large kernel is called by others, by its symbol; numba would copy it into each of them, and
optimise it again there: the largest held 600 kB of others' code, and half of the compiler's time
went into copies. Such a symbol is the same in every process (fusiond.navigation.compiled). A file
names the kernels that its code calls, which are linked before it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import secrets
import shutil
import sys
import warnings
import zlib
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any
from weakref import WeakSet

from llvmlite.binding import (
    ObjectFileRef,
    add_symbol,
    parse_assembly,
    parse_bitcode,
)
from numba.core.caching import NullCache
from numba.core.codegen import CodeLibrary, JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.environment import Environment, lookup_environment
from numba.core.runtime._nrt_python import c_helpers
from numba.core.serialize import dumps

from fusiond.navigation.shipped_kernels import Shipped

# numba's functions have no types.
_dumps: Any = dumps
_result: Any = CompileResult
_Library: Any = JITCodeLibrary
_initialise_library: Any = CodeLibrary.__init__
_object_file: Any = ObjectFileRef.from_data
_parse_bitcode: Any = parse_bitcode
_parse_assembly: Any = parse_assembly
_add_symbol: Any = add_symbol
_Environment: Any = Environment
_known_environment: Any = lookup_environment

_DIGEST_SIZE = hashlib.sha256().digest_size
_BITCODE = 3
"""Place of the bitcode in a file's contents (`_kept`)."""
_FORMAT = 2
"""Of a file's contents."""
CALLED_FROM = 16_384
"""Native code (bytes) from which a kernel is called by others. LLVM inlines functions of some 50
instructions, a tenth of it: nothing that it would inline."""
_libraries: WeakSet[_Linked] = WeakSet()
_called: dict[str, str] = {}
"""Names of the kernels that others call, by symbol."""
waiting: dict[str, Callable[[], None]] = {}
"""Functions that link the imported kernels not linked yet, by name of the kernel."""


class KernelCache(NullCache):
    """Cache for numba's dispatcher with its one signature; `name` is the kernel's alone.

    `shipped`: the package's own file with it, or None.
    """

    def __init__(
        self, folder: Path, shipped: Shipped | None, name: str, signature: str, target: Any
    ) -> None:
        triple, *processor = _processor(target.codegen())
        self.file_name = _file_name(name, signature, triple, *processor)
        self._folder = folder
        self.shipped: Path | None = None
        if shipped is not None:
            file_name = _file_name(name, signature, triple, shipped.level, "")
            if file_name in shipped.names:
                self.shipped = shipped.folder / file_name

    @property
    def cache_path(self) -> str:
        """The folder of the files."""
        return str(self._folder)

    def load_overload(self, _signature: object, target: Any) -> Any:
        """Load code compiled for this processor, else that shipped for its level; None without
        intact code."""
        _name_runtime()
        path = self._folder / self.file_name
        kept = _sound(path, _discard)
        if kept is None and self.shipped is not None:
            path = self.shipped
            kept = _sound(path, _leave)
        return None if kept is None else _linked(target, path, *pickle.loads(kept))

    def save_overload(self, _signature: object, data: Any) -> None:
        """Write compiled code; after a failure the next start compiles again."""
        if data.library.has_dynamic_globals:
            return  # it holds addresses of this process
        payload: bytes = _dumps(_kept(data))
        if _is_called(data.fndesc, data.library._get_compiled_object()):
            _call(data.fndesc, data.library)
        path = self._folder / self.file_name
        written = path.with_suffix(f".{os.getpid()}-{secrets.token_hex(8)}.writing")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with written.open("xb") as file:
                file.write(hashlib.sha256(payload).digest())
                file.write(payload)
            os.replace(written, path)
        except OSError:
            with contextlib.suppress(OSError):
                written.unlink()


def _file_name(name: str, signature: str, *processor: str) -> str:
    """File name of native code: by signature, system, processor and its features."""
    made_for = repr((_FORMAT, signature, processor)).encode()
    return f"{name}-{hashlib.sha256(made_for).hexdigest()[:16]}.kernel"


def _sound(path: Path, damaged: Callable[[Path, str], None]) -> memoryview | None:
    """Contents of a file with a correct digest."""
    try:
        data = memoryview(path.read_bytes())
    except FileNotFoundError:
        return None
    except IsADirectoryError:
        damaged(path, "a folder")
        return None
    except OSError as error:
        _report(f"{path} cannot be read ({error})")
        return None
    kept = data[_DIGEST_SIZE:]
    if hashlib.sha256(kept).digest() != data[:_DIGEST_SIZE]:
        damaged(path, "its checksum is wrong")
        return None
    return kept


@cache
def _name_runtime() -> None:
    """Name the functions that kernels make arrays with to the linker.

    The rest of numba's runtime is part of each kernel that needs it; numba compiles it for the
    first one, which takes as long as linking twenty."""
    for name, address in c_helpers.items():
        _add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


@lru_cache
def _processor(codegen: Any) -> tuple[str, str, str]:
    """System, processor and features, queried from LLVM once."""
    made_for: tuple[str, str, str] = codegen.magic_tuple()
    return made_for


def _kept(made: Any) -> tuple[Any, ...]:
    """Contents of a file, the arguments of `_linked`: of what numba keeps that which a kernel
    needs.

    The bitcode, most of it, is read when another kernel is compiled that gets a copy. Environments
    are what `_environment` takes, the kernel's own first: numba would import a dozen modules of its
    implementations with them. Of those of inlined functions few hold a constant.
    """
    library, function, environment, signature, *_, initialisers, referenced = made._reduce()
    name, _, (native, bitcode) = library
    environments = [
        (one.globals["__name__"], one.consts, one.env_name)
        for one in (environment, *(inlined for inlined in referenced if inlined.consts))
    ]
    copied = b"" if _is_called(function, native) else zlib.compress(bitcode)
    declared = (one.name for one in made.library._final_module.functions if one.is_declaration)
    calls = [(_called[symbol], symbol) for symbol in declared if symbol in _called]
    return name, function, native, copied, signature, initialisers, environments, calls


def kernel_name(module: str, qualified_name: str) -> str:
    """Name of a kernel in the cache."""
    return f"{module}.{qualified_name}".replace("<locals>.", "")


def _is_called(function: Any, native: bytes) -> bool:
    """True if other kernels call this one, False if they get a copy of it."""
    return len(native) >= CALLED_FROM and not function.inline


def _call(function: Any, library: Any) -> None:
    """Give those that link this kernel's library nothing of it but its symbol."""
    _called[function.llvm_func_name] = kernel_name(function.modname, function.qualname)
    library._shared_module = _nothing()


@cache
def _nothing() -> Any:
    return _parse_assembly("")


def _environment(module: str, constants: list[Any], name: str) -> Any:
    """Environment with the constants of native code. Its globals serve object mode only, which no
    kernel uses."""
    known = _known_environment(name)
    if known is None:
        imported = sys.modules.get(module)
        known = _Environment({"__name__": module} if imported is None else imported.__dict__)
        known.consts[:] = constants
        known.env_name = name
        _Environment._memo[name] = known
    return known


class _Linked(_Library):  # type: ignore[misc]
    """Kernel loaded from its file: native code now, bitcode when a compiled kernel calls it."""

    def __init__(self, codegen: Any, name: str, path: Path, native: bytes, bitcode: bytes) -> None:
        _initialise_library(self, codegen, name)
        self._linking_libraries: list[Any] = []
        self._path = path
        self._bitcode: bytes | None = bitcode
        _libraries.add(self)
        self._shared_module: Any = None
        self._finalized = True
        codegen._engine._ee.add_object_file(_object_file(native))
        codegen._engine.finalize_object()

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None:
            self._shared_module = _parse_bitcode(zlib.decompress(self._compressed()))
            self._codegen._engine._load_defined_symbols(self._shared_module)
        return self._shared_module

    def _compressed(self) -> bytes:
        if self._bitcode is None:
            kept = _sound(self._path, _leave)
            if kept is None:
                raise FileNotFoundError(f"{self._path} is gone: start again")
            self._bitcode = pickle.loads(kept)[_BITCODE]
        return self._bitcode

    def release(self) -> None:
        self._bitcode = None


def release_bitcode() -> None:
    """Release the bitcode of all linked kernels, 7 MB, in a process that compiles no more. A later
    compilation reads it again."""
    for library in _libraries:
        library.release()


def _linked(
    target: Any,
    path: Path,
    name: str,
    function: Any,
    native: bytes,
    bitcode: bytes,
    signature: Any,
    initialisers: Any,
    environments: list[tuple[str, list[Any], str]],
    calls: list[tuple[str, str]],
) -> Any:
    """Inverse of `CompileResult._rebuild`; None if a kernel that this one calls is missing."""
    codegen = target.codegen()
    for called, symbol in calls:
        if called in waiting:
            waiting[called]()
        if not codegen._engine.is_symbol_defined(symbol):  # the linker would end the process
            _report(f"{path} calls {called}, which is another now")
            return None
    for initialise in initialisers:
        initialise()
    library = _Linked(codegen, name, path, native, bitcode)
    if not bitcode:
        _call(function, library)
    codegen._engine._defined_symbols |= {
        function.llvm_func_name,
        function.llvm_cpython_wrapper_name,
    }
    own, *referenced = [_environment(*made) for made in environments]
    result = _result(
        target_context=target,
        typing_context=target.typing_context,
        library=library,
        environment=own,
        entry_point=target.get_executable(library, function, own),
        fndesc=function,
        type_annotation=None,
        signature=signature,
        objectmode=False,
        lifted=(),
        typing_error=None,
        call_helper=None,
        metadata=None,
        reload_init=initialisers,
        referenced_envs=referenced,
    )
    for other in referenced:
        codegen.set_env(other.env_name, other)
    return result


def can_keep(folder: Path) -> bool:
    """True if compiled code can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def kept_in(folder: Path) -> set[str]:
    """Names of the files in `folder`, after removal of unfinished files of dead processes.

    If the folder is shared with other hosts, a file being written by one may be removed: that host
    compiles the kernel again at its next start.
    """
    try:
        names = set(os.listdir(folder))
    except OSError:
        return set()
    for name in [name for name in names if name.endswith(".writing")]:
        writer = name.split(".")[-2].partition("-")[0]
        with contextlib.suppress(OSError, ValueError):
            try:
                os.kill(int(writer), 0)  # asks whether it lives
            except ProcessLookupError:
                (folder / name).unlink()
                names.remove(name)
    return names


def _leave(path: Path, reason: str) -> None:
    _report(f"{path} is damaged ({reason}): install the package again")


def _discard(path: Path, reason: str) -> None:
    _report(f"{path} is damaged ({reason})")
    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _report(what: str) -> None:
    warnings.warn(f"{what}: the kernel is compiled anew", RuntimeWarning, stacklevel=2)
