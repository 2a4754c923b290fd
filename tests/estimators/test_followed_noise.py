"""A filter that states more process noise than there is follows its measurements: it finds no delay
in what it follows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.fault_bank import E_AT, L_AT
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.integrity.catalogue import kinds_of, table_of
from fusiond.models.catalogue import make_model
from tests import runs
from tests.estimators.test_fault_bank import IMU, INITIAL, buffer_of, drive, measurements

EVERY_NS = runs.SECOND // 5
WIDE = 300.0
"""Times the noise of the accelerometers: of a model that has their biases as noise."""


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_it_follows_is_no_delay(seed: int) -> None:
    noise = imu_noise(IMU)
    model = make_model("ins15", replace(noise, force_noise=WIDE * noise.force_noise))
    kinds = kinds_of(model, {"gnss": "gnss"}, slips=False)
    _, samples, start = drive()
    made = KalmanEstimator(model, IMU.gap_s, faults=table_of(kinds))
    p = np.diag(INITIAL**2)
    p[9:, 9:] = 1e-16 * np.eye(model.size - 9)
    made.initialise(0, 0, start.copy(), np.zeros(model.size), p)
    buffer, rng = buffer_of(samples), np.random.default_rng(seed)
    for k in range(1, 150):
        made.propagate(buffer, k * EVERY_NS)
        for measurement in measurements(k * EVERY_NS, rng, "", np.zeros(3)):
            made.update(measurement)
    bank = made.hypotheses
    assert bank is not None
    bank.judge(made.t_ns)
    e, information = bank.each(E_AT), bank.each(L_AT)
    delays = [row for row, kind in enumerate(kinds) if kind.name in ("delay", "velocity_delay")]
    for row in delays:
        shown = information[row] > 1.0
        assert shown.any(), kinds[row].name
        sigmas = np.abs(e[row, shown]) / np.sqrt(information[row, shown])
        assert sigmas.max() < 4.5, (kinds[row].name, kinds[row].lag_s, sigmas)
    found = np.where(bank.explains, bank.log_odds, -np.inf)[delays].max()
    assert found < 0.0 or math.isinf(found)
