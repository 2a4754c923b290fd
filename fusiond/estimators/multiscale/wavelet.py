r"""The wavelet transform of a block: an orthonormal matrix W (M, M), M = 2^(N-1).

    W = [ G_(N-1);  G_(N-2) H_(N-1);  ...;  G_1 H_2 ... H_(N-1);  H_1 H_2 ... H_(N-1) ]

H_i (smooth) and G_i (detail) take 2^i elements to 2^(i-1). A block wraps around (periodization): so
W is square, and orthonormal for every orthonormal wavelet, however long its filters.

Source: paper 001, eq. 12 to 18; Mallat, A Wavelet Tour of Signal Processing, 3rd ed., section
7.5.1.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pywt

Array = NDArray[np.float64]

MOST_SCALES = 4
# Tabulated filters are orthonormal to their printed digits: the worst (sym20) is off by 4e-11. The
# discrete Meyer wavelet, a truncated series, is off by 2e-3.
ORTHONORMAL_TO = 1e-6


@lru_cache
def wavelet_matrix(name: str, scales: int) -> Array:
    """Matrix W (M, M) of a wavelet by its PyWavelets name for N = `scales`, rows from fine to
    coarse.

    ValueError for a name that is unknown or not an orthonormal wavelet's. Read-only.
    """
    try:
        import pywt  # noqa: PLC0415 - for whoever filters by scales
    except ImportError as error:
        raise ValueError("the filter multiscale needs PyWavelets") from error
    if not 1 <= scales <= MOST_SCALES:
        raise ValueError(f"scales = {scales}: 1 to {MOST_SCALES}")
    if name not in pywt.wavelist(kind="discrete"):
        raise ValueError(f"no wavelet {name!r}; orthonormal ones: {', '.join(families())}")
    w = _transform(pywt.Wavelet(name), scales)
    if not _is_orthonormal(name):
        raise ValueError(f"wavelet {name!r} is not orthonormal; {', '.join(families())} are")
    # The orthonormal matrix nearest to it, without the last digits of the tables.
    left, _, right = np.linalg.svd(w)
    exact: Array = left @ right
    exact.setflags(write=False)
    return exact


def families() -> list[str]:
    """The families of orthonormal wavelets, as `db1 to db38`."""
    import pywt  # noqa: PLC0415

    found = []
    for family in pywt.families():
        try:
            names = [n for n in pywt.wavelist(family, kind="discrete") if _is_orthonormal(n)]
        except ValueError:  # a family of continuous wavelets
            continue
        if names:
            found.append(names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}")
    return found


def _transform(wavelet: pywt.Wavelet, scales: int) -> Array:
    import pywt  # noqa: PLC0415

    smooth, rows = np.eye(2 ** (scales - 1)), []
    for _ in range(scales - 1):
        smooth, detail = pywt.dwt(smooth, wavelet, mode="periodization", axis=0)
        rows.append(detail)
    return np.vstack([*rows, smooth])


@lru_cache(maxsize=256)
def _is_orthonormal(name: str) -> bool:
    import pywt  # noqa: PLC0415

    wavelet = pywt.Wavelet(name)
    if not wavelet.orthogonal:
        return False
    w = _transform(wavelet, MOST_SCALES)
    return bool(np.abs(w @ w.T - np.eye(len(w))).max() < ORTHONORMAL_TO)
