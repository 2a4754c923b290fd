"""Covariances as a filter under way has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.models.model import Model

Array = NDArray[np.float64]


def random_covariance(rng: np.random.Generator, model: Model) -> Array:
    """A full covariance of plausible size with correlations everywhere; inactive slots empty."""
    scale = np.concatenate([[0.02] * 3, [0.3] * 3, [5.0] * 3, np.maximum(model.initial[9:], 1e-6)])
    a = rng.standard_normal((model.size, model.size + 5))
    p = scale[:, None] * (a @ a.T / (model.size + 5)) * scale
    p[~model.active] = 0.0
    p[:, ~model.active] = 0.0
    return np.asarray(0.5 * (p + p.T))
