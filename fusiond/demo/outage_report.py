"""Summary of the demo's GNSS outages: error growth, and its ratio to sigma."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def outage_report(
    t_s: Array, error_m: Array, sigma_m: Array, outages: Sequence[tuple[float, float]]
) -> Iterator[str]:
    """Describe each outage that the solution bridged, in one sentence.

    `t_s`, `error_m` and `sigma_m` (n,): instants, true horizontal errors, and their stated one
    sigma (root of the sum of both variances). `outages` begin and end on the same clock.
    """
    if not len(t_s):
        yield "No solution: the vehicle had not driven off yet"
        return
    for begin_s, end_s in outages:
        inside = np.flatnonzero((t_s >= begin_s) & (t_s <= end_s))
        if not len(inside) or t_s[0] > begin_s:
            continue
        worst = inside[np.argmax(error_m[inside])]
        before = max(0, inside[0] - 1)
        yield (
            f"{end_s - begin_s:.0f} s without GNSS: the error grew from {error_m[before]:.2f} to "
            f"{error_m[worst]:.2f} m at most, and sigma said {sigma_m[worst]:.2f} m there"
        )
    inside_two = float(np.mean(error_m <= 2.0 * sigma_m))
    yield (
        f"the vehicle was within two sigma for {100.0 * inside_two:.0f} % of the "
        f"{t_s[-1] - t_s[0]:.0f} s that it was navigated"
    )
