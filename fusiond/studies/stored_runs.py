"""Store of a study's runs as rows of a file, so that each run is computed once.

A row is named by study, part of it, digest of what its runs are given, version of fusiond, seed and
number. The digest is of the function that makes a run and of all its arguments: a case that has
been changed has new rows, as a configuration has in `fusiond batch`. Constants of modules are not
in it: those belong to the version.

A run that is a record of numbers is stored as it is. Any other run is stored by the columns of its
arrays: all values up to `AS_IT_IS`, else mean and root mean square of the finite ones. `result`
holds all that the study's summary needs, so that a stopped study continues where it was.
"""

from __future__ import annotations

import base64
import hashlib
import io
import pickle
import zlib
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np

from fusiond.files.csv_tables import TableError
from fusiond.files.resumable_parquet import ResumableRows, Row, flattened
from fusiond.workers.runner_interface import Outcome

NAME = ("study", "part", "config_digest", "version", "seed", "run")
AS_IT_IS = 3
"""Longest array stored value by value: a vector of space."""
_OURS = "fusiond.studies."
_PLAIN = {
    ("collections", "Counter"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
}


class StoredRuns:
    """Stored and added runs of `study` with `seed` in `file`."""

    def __init__(self, file: ResumableRows, study: str, seed: int) -> None:
        self._file = file
        self._named: Row = {"study": study, "version": version("fusiond"), "seed": seed}
        self.there = 0
        self.ended: dict[str, int] = {}

    def of(self, work: Callable[[Any], Any]) -> StoredPart:
        """Stored runs of `work`."""
        digest = hashlib.sha256(stable_text(work).encode()).hexdigest()[:12]
        named = self._named | {"part": _part(work), "config_digest": digest}
        return StoredPart(self, self._file, {name: named[name] for name in NAME[:-1]})


class StoredPart:
    """Stored runs of one function."""

    def __init__(self, kept: StoredRuns, file: ResumableRows, named: Row) -> None:
        self._kept, self._file, self._named = kept, file, named

    def known(self, runs: int) -> dict[int, Outcome[Any]]:
        """Outcomes of runs below `runs` by number. Raises `TableError`."""
        wanted = tuple(self._named.values())
        found = {}
        for row in self._file.rows:
            if tuple(row.get(name) for name in NAME[:-1]) == wanted and row["run"] < runs:
                found[row["run"]] = _outcome(row)
        self._kept.there += len(found)
        return found

    def add(self, number: int, outcome: Outcome[Any]) -> None:
        ended = self._kept.ended
        ended[outcome.ended] = ended.get(outcome.ended, 0) + 1
        row = self._named | {"run": number, "ended": outcome.ended, "reason": outcome.reason}
        if outcome.ended == "done":
            row |= _figures(outcome.result)
        self._file.add(row)


def stable_text(value: Any) -> str:
    """Text that is equal for equal values in every process, and different otherwise."""
    if isinstance(value, partial):
        return stable_text((value.func, value.args, value.keywords))
    if is_dataclass(value) and not isinstance(value, type):
        value_of = {f.name: getattr(value, f.name) for f in fields(value)}
        return f"{type(value).__qualname__}{stable_text(value_of)}"
    if isinstance(value, Mapping):
        return f"({','.join(f'{stable_text(k)}:{stable_text(v)}' for k, v in value.items())})"
    if isinstance(value, list | tuple):
        return f"({','.join(map(stable_text, value))})"
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}{hashlib.sha256(value.tobytes()).hexdigest()}"
    if callable(value):
        return f"{value.__module__}.{value.__qualname__}"
    if hasattr(value, "model_dump_json"):
        return str(value.model_dump_json())
    return repr(value)


def _part(work: Callable[[Any], Any]) -> str:
    """Names of the arguments: texts, and what has a name."""
    args = work.args if isinstance(work, partial) else ()
    named = [arg if isinstance(arg, str) else getattr(arg, "name", "") for arg in args]
    return " ".join(str(name) for name in named if name)


def _figures(result: Any) -> Row:
    if isinstance(result, dict) and all(isinstance(v, str | int | float) for v in result.values()):
        return flattened(result)
    packed = base64.b64encode(zlib.compress(pickle.dumps(result, protocol=5))).decode("ascii")
    return flattened(_reported(result)) | {"result": packed}


def _reported(value: Any) -> Any:
    """A result as nested names and plain numbers."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _reported(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): _reported(item) for name, item in value.items()}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return _of_array(value)
    if isinstance(value, list | tuple):
        if all(isinstance(item, int | float) for item in value):
            return _of_array(np.array(value, dtype=float))
        return {str(k): _reported(item) for k, item in enumerate(value)}
    return value


def _of_array(values: np.ndarray[Any, Any]) -> Any:
    if values.ndim == 0 or not values.size:
        return values.item() if values.size else None
    if values.ndim > 2 or values.dtype.kind not in "fiub":
        return None
    if values.size <= AS_IT_IS:
        return {str(k): v for k, v in enumerate(values.ravel().tolist())}
    reported = {}
    for k, column in enumerate(values.reshape(len(values), -1).T.astype(float)):
        finite = column[np.isfinite(column)]
        if len(finite):
            rms = float(np.sqrt(np.mean(finite * finite)))
            reported[str(k)] = {"mean": float(finite.mean()), "rms": rms}
    return reported if values.ndim == 2 else reported.get("0")


def _outcome(row: Row) -> Outcome[Any]:
    ended = row["ended"]
    if ended != "done":
        return Outcome(row["run"], ended, row["reason"])
    if "result" not in row:
        named = {*NAME, "ended", "reason"}
        figures = {name: value for name, value in row.items() if name not in named}
        return Outcome(row["run"], ended, result=figures)
    try:
        data = zlib.decompress(base64.b64decode(row["result"]))
        return Outcome(row["run"], ended, result=_Results(io.BytesIO(data)).load())
    except (ValueError, zlib.error, pickle.UnpicklingError, AttributeError, EOFError) as error:
        raise TableError(f"the result of run {row['run']} cannot be read: {error}") from error


class _Results(pickle.Unpickler):
    """Unpickler for records of studies and arrays only, since a file may come from anyone."""

    def find_class(self, module: str, name: str) -> Any:
        found = super().find_class(module, name) if (module, name) in _PLAIN else None
        if module.startswith(_OURS) and "." not in name:
            found = super().find_class(module, name)
            found = found if isinstance(found, type) and is_dataclass(found) else None
        if found is None:
            raise pickle.UnpicklingError(f"{module}.{name} is no part of a result")
        return found
