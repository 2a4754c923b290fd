r"""Robust update: less weight for rows with large residuals.

Noise is Student's with m degrees of freedom, not Gaussian: an update minimises, instead of the sum
of squares,

    (x - dx)^T P^-1 (x - dx) / 2 + sum_i (m + 1) / 2 ln(1 + t_i^2 / m)
    t_i = (z_i - h_i x) / sqrt(r_i)

by iterated weights: with r / w for r the residuals follow from

    e = z - H x = R_w (H P H^T + R_w)^-1 (z - H dx),   R_w = diag(r / w)

and new weights w = (m + 1) / (m + t^2) from them, until they converge. This is
expectation-maximisation: every iteration lowers the sum. Of several minima the one reached from w =
1 is used. The update and its covariance are then the ordinary ones with R_w.

A jump of a receiver's clock moves all ranges without a fault of any: for the weights its offset is
unknown.

Source: Lange, Little, Taylor, Robust Statistical Modeling Using the t Distribution, JASA 84 (1989),
881.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation
from fusiond.models.blocks import CLOCK_OFFSET
from fusiond.models.model import Model

Array = NDArray[np.float64]

# Degrees of freedom that Lange, Little and Taylor recommend where the data do not tell better.
DEGREES = 4.0
# Weights that change by less in a turn are found.
SETTLED, MOST_TURNS = 1e-6, 100


def reweighted(rows: Innovation, model: Model, p: Array, dx: Array) -> Innovation:
    """Rows with r / w for r, for P (n, n) and the error estimate `dx` (n,) before the update.

    Unchanged if an innovation is not finite, which the filter rejects.
    """
    z, h, r = rows
    innovation = z - h @ dx
    if not np.isfinite(innovation).all():
        return rows
    spread = h @ p @ h.T
    for offset in model.slots_of(CLOCK_OFFSET):
        spread += np.outer(h[:, offset], h[:, offset]) * model.initial[offset] ** 2
    weight = np.ones(len(z))
    for _ in range(MOST_TURNS):
        noise = r / weight
        residual = noise * np.linalg.solve(spread + np.diag(noise), innovation)
        before, weight = weight, (DEGREES + 1.0) / (DEGREES + residual * residual / r)
        if np.abs(weight - before).max() < SETTLED:
            break
    return Innovation(z, h, r / weight)
