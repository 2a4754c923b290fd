r"""Partial renewal of errors that successive measurements share.

    t <- R t + w       t in units of their initial sigmas
    t <- R t + G e + w,  and what the states are is given: a clone of the navigation errors e
    t <- t + c,  e <- e + A c       noise that both take

for covariance P, error estimate, parameters, and the sensitivities V of a bank's hypotheses: the
parts of P and V of t are multiplied by R, and P grows by w and c. P and V of a clone are those of e
multiplied by G. Source: Groves, 2nd edition, 3.2.4; Roumeliotis and Burdick, Stochastic cloning,
ICRA 2002.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Renewal
from fusiond.models.model import Model
from fusiond.navigation.error_model import CORE_SIZE

Array = NDArray[np.float64]


def transition(renewal: Renewal, model: Model) -> tuple[Array, Array, list[int]] | None:
    """Matrix R (k, k), its noise covariance (k, k) in the states' units, and their slots; None
    without such states."""
    slots = model.slots_of_all(renewal.blocks).tolist()
    if len(slots) != len(renewal.kept):
        return None
    sd = model.initial[slots]
    kept = sd[:, None] * renewal.kept / sd
    return kept, sd[:, None] * renewal.new * sd, slots


def renew(renewal: Renewal, model: Model, covs: Iterable[Array], others: Iterable[Array]) -> None:
    """Apply the renewal to P (.., w, w) of each of `covs` and the rows of `others` (n, ..)."""
    found = transition(renewal, model)
    if found is None:
        return
    kept, new, slots = found
    own, cloned = np.ix_(slots, slots), renewal.of_navigation
    shared = _shared_noise(renewal, model, slots)
    for cov in covs:
        rows = _carried(kept, cloned, cov, slots)
        among = product(rows[:, slots], kept.T) + new
        if cloned is not None:
            among += product(rows[:, :CORE_SIZE], cloned.T)
        cov[slots] = rows
        cov[:, slots] = rows.T
        cov[own] = 0.5 * (among + among.T)
        if shared is not None:
            both, noise = shared
            cov[both] += noise
    for rows in others:
        found_rows = _carried(kept, cloned, rows.reshape(len(rows), -1), slots)
        rows[slots] = found_rows.reshape(rows[slots].shape)


def _shared_noise(
    renewal: Renewal, model: Model, slots: list[int]
) -> tuple[tuple[Array, ...], Array] | None:
    """Indices of the navigation errors and the states in `slots`, and the covariance of the noise
    that they share; None without."""
    if renewal.with_navigation is None:
        return None
    matrix, noise = renewal.with_navigation
    taken = np.vstack((matrix * model.active[:CORE_SIZE, None], np.diag(model.initial[slots])))
    found = product(product(taken, noise), taken.T)
    return np.ix_([*range(CORE_SIZE), *slots], [*range(CORE_SIZE), *slots]), 0.5 * (found + found.T)


def _carried(kept: Array, cloned: Array | None, rows: Array, slots: list[int]) -> Array:
    """Renewed rows (k, w) of the states in `slots`, from all `rows` (.., w)."""
    found = product(kept, rows[slots])
    if cloned is not None:
        found += product(cloned, rows[:CORE_SIZE])
    return found


def product(a: Array, b: Array) -> Array:
    """Product A B of few rows, in one order of operations on all machines."""
    found: Array = (a[:, :, None] * b[None, :, :]).sum(axis=1)
    return found
