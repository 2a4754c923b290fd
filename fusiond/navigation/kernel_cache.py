"""Compiled kernels on disk: one checked file a kernel.

A file holds the SHA-256 of what follows, then what numba makes of a compiled function. Native code
is linked only after that digest has been found right: a file that is cut short, emptied or altered
by a bit is removed, said so, and the kernel compiled anew. (numba's own cache checks nothing: it
hands what it finds to the linker, which aborts the process.) The digest tells damage, not malice:
whoever may write to the folder may run code here, as with any folder of Python modules.

Files are written under a name of their own and renamed, so that processes that compile side by side
or die while they write leave whole files; a later start removes what a dead one left. Where nothing
can be written, kernels are compiled at each start.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import secrets
import shutil
import warnings
from pathlib import Path
from typing import Any

from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

# numba's functions have no types.
_rebuild: Any = CompileResult._rebuild
_dumps: Any = dumps

_DIGEST_SIZE = hashlib.sha256().digest_size


class KernelCache(NullCache):
    """What a numba dispatcher asks for its one signature; `name` is the kernel's alone."""

    def __init__(self, folder: Path, name: str) -> None:
        self._folder = folder
        self._name = name

    @property
    def cache_path(self) -> str:
        """The folder of the files."""
        return str(self._folder)

    def load_overload(self, signature: object, target: Any) -> Any:
        """What was compiled for this processor, or None where there is nothing sound."""
        target.refresh()
        path = self._path(signature, target.codegen())
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return None
        except IsADirectoryError:
            _discard(path, "a folder")
            return None
        except OSError as error:
            _tell(f"{path} cannot be read ({error})")
            return None
        payload = memoryview(data)[_DIGEST_SIZE:]
        if hashlib.sha256(payload).digest() != data[:_DIGEST_SIZE]:
            _discard(path, "its checksum is wrong")
            return None
        return _rebuild(target, *pickle.loads(payload))

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
        made_for = hashlib.sha256(repr((str(signature), codegen.magic_tuple())).encode())
        return self._folder / f"{self._name}-{made_for.hexdigest()[:16]}.kernel"


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
