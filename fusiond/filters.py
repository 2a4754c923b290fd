"""From a vehicle's configuration to its error-state model and its estimator.

A new estimator is one module in `fusiond.estimators` and one case here; nothing else knows which
one runs.
"""

from __future__ import annotations

from fusiond.config import Config
from fusiond.estimators.base import Estimator
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.model import Block, Model, make_model
from fusiond.estimators.multiscale import MultiscaleEstimator
from fusiond.settings import imu_noise


def model_of(config: Config, *extra: Block) -> Model:
    """The error-state model of a configuration, with the blocks that its aids need."""
    return make_model(config.estimator.model, imu_noise(config.imu), *extra)


def estimator_of(config: Config, model: Model) -> Estimator:
    """The estimator that `[estimator] filter` names."""
    match config.estimator.filter:
        case "kalman":
            return KalmanEstimator(model, config.imu.gap_s)
        case "multiscale":
            m = config.estimator.multiscale
            return MultiscaleEstimator(model, config.imu.gap_s, m.scales, m.wavelet)
