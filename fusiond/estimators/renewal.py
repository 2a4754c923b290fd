r"""Errors that successive measurements share, where in part they become others.

    t <- R t + w       t in units of their initial sigmas

of states with covariance P, error estimate and parameters, and of the sensitivities V of a bank's
hypotheses: what of P and V belongs to t is multiplied by R, and P grows by w. Source: Groves, 2nd
edition, 3.2.4.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Renewal
from fusiond.models.model import Model

Array = NDArray[np.float64]


def transition(renewal: Renewal, model: Model) -> tuple[Array, Array, list[int]] | None:
    """R (k, k) and its noise's covariance (k, k) in the states' units, and their slots; None where
    the model has no such states."""
    slots = model.slots_of_all(renewal.blocks).tolist()
    if len(slots) != len(renewal.kept):
        return None
    sd = model.initial[slots]
    kept = sd[:, None] * renewal.kept / sd
    return kept, sd[:, None] * renewal.new * sd, slots


def renew(renewal: Renewal, model: Model, covs: Iterable[Array], others: Iterable[Array]) -> None:
    """Carry P (.., w, w) of each of `covs` over, and the rows of `others` (n, ..)."""
    found = transition(renewal, model)
    if found is None:
        return
    kept, new, slots = found
    own = np.ix_(slots, slots)
    for cov in covs:
        among = product(product(kept, cov[own]), kept.T) + new
        cov[slots] = product(kept, cov[slots])
        cov[:, slots] = cov[slots].T
        cov[own] = 0.5 * (among + among.T)
    for rows in others:
        rows[slots] = product(kept, rows[slots].reshape(len(slots), -1)).reshape(rows[slots].shape)


def product(a: Array, b: Array) -> Array:
    """A B of few rows, in one order of operations on all machines."""
    found: Array = (a[:, :, None] * b[None, :, :]).sum(axis=1)
    return found
