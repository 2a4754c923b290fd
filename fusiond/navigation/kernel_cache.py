"""Compiled kernels on disk: one checked file a kernel.

A file holds the SHA-256 of what follows, then what numba makes of a compiled function. Native code
is linked only after that digest has been found right: a file that is cut short, emptied or altered
by a bit is removed, said so, and the kernel compiled anew. (numba's own cache checks nothing: it
hands what it finds to the linker, which aborts the process.) The digest tells damage, not malice:
whoever may write to the folder may run code here, as with any folder of Python modules.

Files are written under a name of their own and renamed, so that processes that compile side by side
or die while they write leave whole files; a later start removes what a dead one left. Where nothing
can be written, kernels are compiled at each start.

A start that finds all kernels compiles nothing, and so does without what numba needs to compile:
its tables of implementations (a fifth of the processor time of a start) and the bitcode of the
kernels, which others inline (another seventh). Both come when a kernel is missing. A kernel that is
there is linked when it is first called, 2 ms each: of a hundred that are imported a drive on files
calls twenty (fusiond.navigation.compiled).
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
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from llvmlite.binding import add_symbol, parse_bitcode
from numba.core.caching import NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.environment import Environment, lookup_environment
from numba.core.runtime._nrt_python import c_helpers
from numba.core.serialize import dumps

# numba's functions have no types.
_dumps: Any = dumps
_result: Any = CompileResult
_Library: Any = JITCodeLibrary
_parse_bitcode: Any = parse_bitcode
_add_symbol: Any = add_symbol
_Environment: Any = Environment
_known_environment: Any = lookup_environment

_DIGEST_SIZE = hashlib.sha256().digest_size


class KernelCache(NullCache):
    """What a numba dispatcher asks for its one signature; `name` is the kernel's alone.

    `on_missing` is called before the kernel is compiled, since there is nothing sound.
    """

    def __init__(self, folder: Path, name: str, on_missing: Callable[[], None]) -> None:
        self._folder = folder
        self._name = name
        self._on_missing = on_missing

    @property
    def cache_path(self) -> str:
        """The folder of the files."""
        return str(self._folder)

    def file_name(self, signature: object, target: Any) -> str:
        """The name of the kernel's file in the folder."""
        return self._path(signature, target.codegen()).name

    def load_overload(self, signature: object, target: Any) -> Any:
        """What was compiled for this processor, or None where there is nothing sound."""
        found = self._load(signature, target)
        if found is None:
            self._on_missing()
        return found

    def _load(self, signature: object, target: Any) -> Any:
        _name_runtime()
        path = self._path(signature, target.codegen())
        try:
            with path.open("rb") as file:
                data = memoryview(file.read())
                if hashlib.sha256(data[_DIGEST_SIZE:]).digest() != data[:_DIGEST_SIZE]:
                    _discard(path, "its checksum is wrong")
                    return None
                file.seek(_DIGEST_SIZE)  # nobody writes into a file that is there
                made = _Unpickler(file).load()
        except FileNotFoundError:
            return None
        except IsADirectoryError:
            _discard(path, "a folder")
            return None
        except OSError as error:
            _tell(f"{path} cannot be read ({error})")
            return None
        return _linked(target, *made)

    def save_overload(self, signature: object, data: Any) -> None:
        """Write what was compiled; where that fails it is compiled again at the next start."""
        if data.library.has_dynamic_globals:
            return  # it holds addresses of this process
        payload: bytes = _dumps(data._reduce())
        path = self._path(signature, data.codegen)
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

    def _path(self, signature: object, codegen: Any) -> Path:
        """Native code differs by signature, system, processor and its features."""
        made_for = hashlib.sha256(repr((str(signature), _processor(codegen))).encode())
        return self._folder / f"{self._name}-{made_for.hexdigest()[:16]}.kernel"


@cache
def _name_runtime() -> None:
    """Tell the linker where the functions are that kernels make arrays with. What else numba's
    runtime consists of lies in each kernel that needs it; numba compiles it for the first that is
    compiled, which takes as long as linking twenty."""
    for name, address in c_helpers.items():
        _add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


@lru_cache
def _processor(codegen: Any) -> tuple[str, str, str]:
    """System, processor and features, which LLVM is asked for once."""
    made_for: tuple[str, str, str] = codegen.magic_tuple()
    return made_for


class _Unpickler(pickle.Unpickler):
    """Reads a kernel and imports none of numba's own modules that a piece of it came from.

    Their environments hold the constants that the native code takes. Their globals, for which
    numba imports a dozen modules of its implementations, are asked for by object mode alone, which
    no kernel here is compiled in.
    """

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numba.core.environment", "_rebuild_env"):
            return _environment
        return super().find_class(module, name)


def _environment(module: str, constants: list[Any], name: str) -> Any:
    known = _known_environment(name)
    if known is None:
        loaded = sys.modules.get(module)
        known = _Environment({"__name__": module} if loaded is None else loaded.__dict__)
        known.consts[:] = constants
        known.env_name = name
        _Environment._memo[name] = known
    return known


class _Linked(_Library):  # type: ignore[misc]
    """A kernel from its file: native code now, bitcode when one that is compiled calls it."""

    def __init__(self, codegen: Any, name: str, native: bytes, bitcode: bytes) -> None:
        self._bitcode: bytes | None = None  # while numba's own initialisation clears the module
        super().__init__(codegen, name)
        self._bitcode = bitcode
        self.enable_object_caching()
        self._set_compiled_object(native)
        self._finalize_final_module()

    @property
    def _shared_module(self) -> Any:
        if self._bitcode is not None:
            self._module: Any = _parse_bitcode(self._bitcode)
            self._bitcode = None
            self._codegen._engine._load_defined_symbols(self._module)
        return self._module

    @_shared_module.setter
    def _shared_module(self, module: Any) -> None:
        self._module = module


def _linked(
    target: Any,
    library_data: tuple[str, str, tuple[bytes, bytes]],
    function: Any,
    environment: Any,
    signature: Any,
    object_mode: bool,
    lifted: Any,
    annotation: Any,
    reload_init: Any,
    referenced: Any,
) -> Any:
    """What `CompileResult._rebuild` makes of the same arguments, those of `_reduce`."""
    for initialise in reload_init:
        initialise()
    name, _, code = library_data
    codegen = target.codegen()
    library = _Linked(codegen, name, *code)
    codegen._engine._defined_symbols |= {
        function.llvm_func_name,
        function.llvm_cpython_wrapper_name,
    }
    result = _result(
        target_context=target,
        typing_context=target.typing_context,
        library=library,
        environment=environment,
        entry_point=target.get_executable(library, function, environment),
        fndesc=function,
        type_annotation=annotation,
        signature=signature,
        objectmode=object_mode,
        lifted=lifted,
        typing_error=None,
        call_helper=None,
        metadata=None,
        reload_init=reload_init,
        referenced_envs=referenced,
    )
    for other in referenced:
        codegen.set_env(other.env_name, other)
    return result


def remove_strays(folder: Path) -> None:
    """Remove what processes left in `folder` that died while they wrote.

    Where the folder is shared with other hosts, one may lose a file that it writes just now: it
    compiles that kernel again at its next start.
    """
    for written in folder.glob("*.writing"):
        writer = written.suffixes[-2][1:].partition("-")[0]
        with contextlib.suppress(OSError, ValueError):
            try:
                os.kill(int(writer), 0)  # asks whether it lives
            except ProcessLookupError:
                written.unlink()


def _discard(path: Path, reason: str) -> None:
    _tell(f"{path} is damaged ({reason})")
    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _tell(what: str) -> None:
    warnings.warn(f"{what}: the kernel is compiled anew", RuntimeWarning, stacklevel=2)
