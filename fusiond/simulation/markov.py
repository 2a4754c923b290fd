r"""First-order Gauss-Markov processes: time-correlated errors of sensors and measurements.

    x' = -x / T + w,   x_k = x_(k-1) exp(-dt / T) + w_k,   var(w_k) = sigma^2 (1 - exp(-2 dt / T))

and a second-order process, which follows a first-order one of sqrt(2) sigma and whose rate is
continuous:

    s' = (x - s) / T,   var(s) = cov(s, x) = var(x) / 2

Source: Groves, 2nd ed., section 4.4; Brown and Hwang, 4th ed., eq. 3.4.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]


@compiled("void(f8[:, ::1], f8)")
def _decaying(process: Array, decay: float) -> None:
    """Add to each row of the processes' input (n, columns) the decayed row before.

    The result equals that of scipy's `lfilter` to the bit; scipy takes a second to load."""
    for k in range(1, process.shape[0]):
        for j in range(process.shape[1]):
            process[k, j] += decay * process[k - 1, j]


def gauss_markov(
    rng: np.random.Generator,
    shape: tuple[int, int],
    *,
    step_s: float,
    correlation_s: float,
    sigma: float,
) -> Array:
    """First-order Gauss-Markov processes (n, columns) in steady state, sampled every `step_s`.

    `correlation_s` 0 gives white noise.
    """
    n, columns = shape
    decay = math.exp(-step_s / correlation_s) if correlation_s > 0.0 else 0.0
    process: Array = rng.standard_normal((n, columns)) * (sigma * math.sqrt(1.0 - decay * decay))
    process[0] = rng.standard_normal(columns) * sigma
    _decaying(process, decay)
    return process


def smooth_markov(
    rng: np.random.Generator,
    shape: tuple[int, int],
    *,
    step_s: float,
    correlation_s: float,
    sigma: float,
) -> Array:
    """Second-order processes (n, columns) in steady state, which follow first-order ones."""
    wide = math.sqrt(2.0) * sigma
    rough = gauss_markov(rng, shape, step_s=step_s, correlation_s=correlation_s, sigma=wide)
    decay = math.exp(-step_s / correlation_s)
    process = (1.0 - decay) * rough
    # Drawn apart: whatever else is drawn from `rng` stays what it was.
    own = rng.spawn(1)[0].standard_normal(shape[1])
    process[0] = 0.5 * rough[0] + 0.5 * wide * own
    _decaying(process, decay)
    return process
