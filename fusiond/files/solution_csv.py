"""Writer of solution files: the columns of `truth.csv`, one sigma of each, and the mode."""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from fusiond.files.csv_tables import Flags, Floats
from fusiond.files.fixed_decimal import MAX_CELL, format_rows
from fusiond.navigation.compiled import compiled
from fusiond.navigation.rotation import rpy_from_quaternion
from fusiond.navigation.solution import Mode
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, Q0, VN

SMOOTHED = "smoothed"
"""Status of a smoothed row, in place of a mode."""
STATUS: tuple[str, ...] = (*Mode, SMOOTHED)
"""The words of the column `status`; a row's status code is an index into them."""

# Decimals resolve 1 us, 0.1 mm (1e-9 deg), 0.1 mm/s and 0.04 arc seconds.
_COLUMNS = (
    ("t_s", 6),
    ("lat_deg", 9),
    ("lon_deg", 9),
    ("height_m", 4),
    *((f"v_{axis}_m_s", 4) for axis in "ned"),
    *((f"{angle}_deg", 5) for angle in ("roll", "pitch", "yaw")),
    *((f"sd_{axis}_m", 4) for axis in "ned"),
    *((f"sd_v{axis}_m_s", 4) for axis in "ned"),
    *((f"sd_{angle}_deg", 5) for angle in ("roll", "pitch", "yaw")),
)
COLUMNS: tuple[str, ...] = (*(name for name, _ in _COLUMNS), "status")
_DECIMALS = np.array([decimals for _, decimals in _COLUMNS], dtype=np.int64)
_CHUNK_ROWS = 2048
_BLOCK = 1 << 19
"""Bytes written at once: the kernel caches small pieces in small pages."""
_DEG = 180.0 / np.pi


def _label_table(labels: tuple[str, ...]) -> NDArray[np.uint8]:
    table = np.zeros((len(labels), max(map(len, labels))), dtype=np.uint8)
    for row, label in zip(table, labels, strict=True):
        row[: len(label)] = np.frombuffer(label.encode("ascii"), dtype=np.uint8)
    return table


@compiled("void(i8[::1], f8[:, ::1], f8[:, ::1], b1[::1], f8[:, ::1])")
def _tabulate(
    times: NDArray[np.int64], nav: Floats, sigmas: Floats, stated: Flags, values: Floats
) -> None:
    """Write `values` (n, 19), the numbers of a file's rows, from states as in
    `SolutionWriter.states`."""
    for i in range(times.shape[0]):
        values[i, 0] = times[i] * 1e-9
        values[i, 1] = nav[i, LAT] * _DEG
        turned = nav[i, LON] + np.pi
        if not 0.0 <= turned < 2.0 * np.pi:
            turned %= 2.0 * np.pi
        values[i, 2] = (turned - np.pi) * _DEG
        values[i, 3] = nav[i, HEIGHT]
        q = nav[i, Q0:]
        rpy = rpy_from_quaternion(q[0], q[1], q[2], q[3])
        for axis in range(3):
            values[i, 4 + axis] = nav[i, VN + axis]
            values[i, 7 + axis] = rpy[axis] * _DEG
        for k in range(9):
            sd = sigmas[i, k] if stated[k] else np.nan
            values[i, 10 + k] = sd if k < 6 else sd * _DEG


class SolutionWriter:
    """Writer of solution rows to a path, a binary stream, or standard output ("-")."""

    def __init__(self, target: Path | str | BinaryIO) -> None:
        self._owned = isinstance(target, Path | str) and str(target) != "-"
        if not isinstance(target, Path | str):
            self._stream: BinaryIO = target
        elif self._owned:
            self._stream = Path(target).open("wb", buffering=_BLOCK)  # noqa: SIM115 - closed by close()
        else:
            self._stream = sys.stdout.buffer
        self._labels = _label_table(STATUS)
        row_bytes = MAX_CELL * len(_COLUMNS) + self._labels.shape[1] + 1
        self._values = np.empty((_CHUNK_ROWS, len(_COLUMNS)))
        self._buffer = np.empty(_CHUNK_ROWS * row_bytes, dtype=np.uint8)
        self._stream.write((",".join(COLUMNS) + "\n").encode("ascii"))

    def rows(
        self,
        t_s: Floats,
        lat_rad: Floats,
        lon_rad: Floats,
        height_m: Floats,
        v_ned_m_s: Floats,
        rpy_rad: Floats,
        sd: Floats,
        status_code: NDArray[np.int64],
    ) -> None:
        """Append n rows: velocity and attitude (n, 3), one sigma (n, 9), the rest (n,).

        `sd` holds metres north, east, down; m/s north, east, down; rad roll, pitch, yaw.
        `status_code` indexes `STATUS`. NaN becomes an empty cell.
        """
        for start in range(0, len(t_s), _CHUNK_ROWS):
            part = slice(start, min(start + _CHUNK_ROWS, len(t_s)))
            values = self._values[: part.stop - start]
            values[:, 0] = t_s[part]
            np.multiply(lat_rad[part], _DEG, out=values[:, 1])
            np.multiply(lon_rad[part], _DEG, out=values[:, 2])
            values[:, 3] = height_m[part]
            values[:, 4:7] = v_ned_m_s[part]
            np.multiply(rpy_rad[part], _DEG, out=values[:, 7:10])
            values[:, 10:16] = sd[part, :6]
            np.multiply(sd[part, 6:], _DEG, out=values[:, 16:19])
            self._write(values, status_code[part])

    def states(
        self,
        times: NDArray[np.int64],
        nav: Floats,
        sigmas: Floats,
        stated: Flags,
        status_code: NDArray[np.int64],
    ) -> None:
        """Append n rows: times (n,) ns, navigation states (n, 10) and one sigma (n, 9) as in
        `rows`. Only the `stated` (9,) sigmas are written."""
        for start in range(0, len(times), _CHUNK_ROWS):
            part = slice(start, min(start + _CHUNK_ROWS, len(times)))
            values = self._values[: part.stop - start]
            _tabulate(times[part], nav[part], sigmas[part], stated, values)
            self._write(values, status_code[part])

    def _write(self, values: Floats, status_code: NDArray[np.int64]) -> None:
        codes = np.ascontiguousarray(status_code, dtype=np.int64)
        size = format_rows(values, _DECIMALS, codes, self._labels, self._buffer)
        self._stream.write(self._buffer[:size].data)

    def close(self) -> None:
        """Flush, and close the file if this writer opened it."""
        if self._owned:
            self._stream.close()
        else:
            self._stream.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
