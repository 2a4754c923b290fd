"""Series in the page's format: thinned to the points that it can show, four bytes each."""

from __future__ import annotations

import base64

import numpy as np

from fusiond.files.csv_tables import Floats

BUCKETS = 1200
"""Two points a bucket: more than a screen has columns; 13 kB a series in the page."""
_PAUSES = 5.0
"""Ratio of a pause to the median interval from which it is plotted as a gap, if longer than
`_LEAST_GAP_S`."""
_LEAST_GAP_S = 1.0


def packed(values: Floats) -> str:
    """Little-endian 32-bit floats, base64: 1e-7 of a value is finer than a pixel."""
    with np.errstate(over="ignore"):
        return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode("ascii")


def thinned(t_s: Floats, columns: Floats, buckets: int = BUCKETS) -> tuple[Floats, Floats]:
    """Times (m,) and columns (m, k) of at most about two points a bucket, from (n,) and (n, k).

    A bucket's two points are the smallest and the largest value in it, in the order in which the
    column runs through it: no spike is lost. `t_s` must not decrease. A pause becomes a row of NaN.
    """
    breaks = _pauses(t_s)
    if len(t_s) > 2 * buckets:
        edges = np.linspace(t_s[0], t_s[-1], buckets, endpoint=False)
        first = np.unique(np.searchsorted(t_s, edges))
        last = np.append(first[1:], len(t_s)) - 1
        low = np.fmin.reduceat(columns, first)
        high = np.fmax.reduceat(columns, first)
        rising = columns[first] <= columns[last]
        thin = np.empty((2 * len(first), columns.shape[1]))
        thin[0::2] = np.where(rising, low, high)
        thin[1::2] = np.where(rising, high, low)
        columns = thin
        t_s = np.stack([t_s[first], t_s[last]], axis=1).ravel()
    at = np.searchsorted(t_s, breaks)
    return np.insert(t_s, at, breaks), np.insert(columns, at, np.nan, axis=0)


def _pauses(t_s: Floats) -> Floats:
    """The middle of each pause."""
    if len(t_s) < 3:
        return np.empty(0)
    step = np.diff(t_s)
    long = step > max(_LEAST_GAP_S, _PAUSES * float(np.median(step)))
    middle: Floats = t_s[:-1][long] + 0.5 * step[long]
    return middle
