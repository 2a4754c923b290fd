"""Biases of the inertial unit with sigma, from the filter's states in a log (one each 30 s)."""

from __future__ import annotations

import json
from math import degrees
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from fusiond.configuration.estimator import Estimator
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.models.catalogue import make_model
from fusiond.navigation.error_model import RATE_ERROR
from fusiond.report.channel_arrays import number
from fusiond.report.run import Estimated

_AXES = tuple(f"{what} {axis}" for what in ("gyro", "accel") for axis in "xyz")
_TO_UNIT = (*(degrees(3600.0),) * 3, *(1e3 / 9.80665,) * 3)
_UNITS = (*("deg/h",) * 3, *("mg",) * 3)
_NUMBERS = TypeAdapter(tuple[float, ...])


class Biases:
    """Biases from `/fusiond/state`. The bias of an axis is the sum of the model's terms (turn-on,
    Markov). Blocks of measurements follow in the state."""

    def __init__(self, config: bytes | None) -> None:
        self._slots = _bias_slots(config)
        self._rows: list[tuple[float, list[float], list[float]]] = []

    def read(self, t_s: float, said: dict[str, Any]) -> None:
        navigation = said.get("navigation")
        if self._slots is None or not isinstance(navigation, dict):
            return
        try:
            xi = np.array(_NUMBERS.validate_python(navigation.get("xi")))
            lower = np.array(_NUMBERS.validate_python(navigation.get("covariance")))
        except ValidationError:
            return
        n = len(xi)
        if len(lower) != n * (n + 1) // 2 or any(s[-1] >= n for s in self._slots if len(s)):
            return
        p = np.zeros((n, n))
        p[np.tril_indices(n)] = lower
        p = p + np.tril(p, -1).T
        values, sigmas = [], []
        for slots, unit in zip(self._slots, _TO_UNIT, strict=True):
            variance = float(p[np.ix_(slots, slots)].sum())
            values.append(number(float(xi[slots].sum()) * unit))
            sigmas.append(number(np.sqrt(max(variance, 0.0)) * unit))
        self._rows.append((t_s, values, sigmas))

    def by_axis(self) -> dict[str, Estimated]:
        if self._slots is None or not self._rows:
            return {}
        t_s = np.array([row[0] for row in self._rows])
        return {
            axis: Estimated(
                _UNITS[k],
                t_s,
                np.array([row[1][k] for row in self._rows]),
                np.array([row[2][k] for row in self._rows]),
            )
            for k, axis in enumerate(_AXES)
            if len(self._slots[k])
        }


def _bias_slots(config: bytes | None) -> list[np.ndarray[tuple[int], np.dtype[np.int64]]] | None:
    """Slots of the biases of each axis (gyro x, y, z, accel x, y, z); None for an unknown model."""
    try:
        data = json.loads(config or b"")
        estimator = Estimator.model_validate(data["estimator"])
        imu = Imu.model_validate(data["imu"])
    except (ValueError, KeyError, TypeError):
        return None
    model = make_model(estimator.model, imu_noise(imu))
    return [np.flatnonzero(model.column_of == RATE_ERROR + axis) for axis in range(6)]
