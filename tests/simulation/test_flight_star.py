"""The flight of paper 001 as files, through the navigator with its ten states: `planar10` live."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from fusiond.configuration.schema import Config
from fusiond.navigator.navigator import Navigator
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.studies.navigation_error import nav_error, true_nav
from tests.places import REPOSITORY

FLIGHT = SCENARIOS["flight-star"]
SHIPPED = tomllib.loads((REPOSITORY / "config" / "flight_star.toml").read_text())
SEEDS, SECONDS, FROM_S, EVERY_S = 4, 200.0, 70.0, 5.0


def test_it_flies_level_and_due_east_and_its_imu_is_that_of_the_configuration() -> None:
    truth = FLIGHT.truth()
    states = truth.at(np.array([0.0, 100.0, 400.0]))
    np.testing.assert_allclose(np.degrees(states.rpy[:, :2]), 0.0, atol=1e-6)
    np.testing.assert_allclose(np.degrees(states.rpy[0, 2]), 90.0)
    np.testing.assert_allclose(np.degrees(states.position[0, :2]), [29.0, 118.0])
    np.testing.assert_allclose(states.v_ned[1:], [[0.0, 12.0, 0.0]] * 2, atol=1e-6)
    assert Config.model_validate({**SHIPPED, "sources": {}}).imu == FLIGHT.imu


@pytest.mark.parametrize("kind", ["kalman", "multiscale", "federated"])
def test_planar10_is_honest_on_it(kind: str, tmp_path: Path) -> None:
    """NEES of attitude, velocity and position a degree in [0.7, 1.4], mean of four runs; position
    within half of the receiver's 8 m."""
    config = Config.model_validate(
        {**SHIPPED, "sources": {}, "estimator": {"model": "planar10", "filter": kind}}
    )
    truth, nees, horizontal = FLIGHT.truth(SECONDS), [], []
    for seed in range(SEEDS):
        folder = tmp_path / str(seed)
        files = simulate(FLIGHT, folder, seed=seed, duration_s=SECONDS).files
        last_s = FROM_S - EVERY_S

        def watch(navigator: Navigator) -> None:
            nonlocal last_s
            e = navigator.estimator
            t_s = e.t_ns * 1e-9
            if navigator.started is None or t_s < last_s + EVERY_S:
                return
            last_s = t_s
            slots = np.flatnonzero(navigator.model.active[:9])
            x = nav_error(e.nav, true_nav(truth, np.array([t_s]))[0])
            horizontal.append(np.hypot(x[6], x[7]))
            x = x[slots]
            nees.append(x @ np.linalg.solve(e.covariance[np.ix_(slots, slots)], x) / len(slots))

        measurements = [("gnss", files["gnss"]), ("attitude", files["attitude"])]
        found = process(config, files["imu"], measurements, watch=watch)
        assert found["sources"]["star_tracker"]["fused"] > 150
        assert found["sources"]["gnss"].get("isolated", 0) == 0
    assert len(nees) > SEEDS * 20
    assert 0.7 < np.mean(nees) < 1.4
    assert np.sqrt(np.mean(np.square(horizontal))) < 4.0
