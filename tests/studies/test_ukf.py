"""Study `ukf`: its problems are what they say, and its figures hold together."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.raw.messages import SPEED_OF_LIGHT_M_S
from fusiond.aiding.base import Innovation, State
from fusiond.aiding.pseudorange import PseudorangeMeasurement, epoch_values
from fusiond.navigation.strapdown import STEP_RATE_B, STEP_SIZE
from fusiond.studies import STUDIES
from fusiond.studies.daemon_fed_filter import DaemonFedFilter, drive_samples, drive_truth
from fusiond.studies.ukf import runs as ukf_runs
from fusiond.studies.ukf import study as ukf


@cache
def result() -> dict[str, Any]:
    return ukf.run_study(2)


def test_keys_of_the_issue() -> None:
    found = result()
    assert STUDIES["ukf"] == "fusiond.studies.ukf.study"
    assert found["runs"] == 2
    assert found["paper"]["filter"] == "UKF"
    assert set(found["problems"]) == {p.name for p in ukf_runs.PROBLEMS}
    for problem in found["problems"].values():
        for name in ("ukf", "ekf"):
            assert {"horizontal_rms_m", "nees_mean", "converged_rate"} <= set(problem[name])
    json.dumps(found, allow_nan=False)


def test_from_a_fair_start_both_filters_agree() -> None:
    for name in ("double_star", "pseudorange"):
        p = result()["problems"][name]
        for key in ("horizontal_rms_m", "nees_mean"):
            assert p["ukf"][key] == pytest.approx(p["ekf"][key], rel=0.02)
        assert p["ukf"]["converged_rate"] == p["ekf"]["converged_rate"] == 1.0


def test_tables_and_picture(tmp_path: Path) -> None:
    ((_, header, rows),) = ukf.tables(result())
    assert len(rows) == len(ukf_runs.PROBLEMS) * len(ukf_runs.FILTERS) == 20
    assert {len(row) for row in rows} == {len(header)}
    pytest.importorskip("matplotlib")
    ukf.plot(result(), tmp_path / "ukf.png")
    assert (tmp_path / "ukf.png").stat().st_size > 10_000


def test_measurements_fit_the_truth() -> None:
    """At the true state the innovations of a run are the noise that was drawn."""
    for problem, sd in ((ukf_runs.PROBLEMS[2], ukf_runs.RANGE_SD_M), (ukf_runs.PROBLEMS[0], 15.3)):
        rng = np.random.default_rng(8)
        if problem.clock:
            measurements, epoch_sd = ukf_runs._pseudoranges(rng, 5)
        else:
            measurements, epoch_sd = ukf_runs._double_star(rng)
        assert 0.5 * sd < epoch_sd < 6.0 * sd
        model = ukf_runs._model(problem)
        rng = np.random.default_rng(8)
        xi, offset, drift = np.zeros(model.size), np.zeros(1), np.zeros(1)
        if problem.clock:
            ukf_runs.draw_satellites(rng, 5)
            offset, drift = ukf_runs.draw_clock(rng)
        nav = ukf_runs._true_states(problem.every_s)[0]
        whitened = []
        for k, epoch in enumerate(measurements):
            measurement = epoch[0]
            assert isinstance(measurement, PseudorangeMeasurement)
            step = np.zeros(STEP_SIZE)
            sample = round((k + 1) * problem.every_s * ukf_runs.IMU.rate_hz) - 1
            step[STEP_RATE_B : STEP_RATE_B + 3] = drive_truth().gyro[sample]
            if problem.clock:
                xi[model.slots_of("clock_offset")] = offset[sample]
                xi[model.slots_of("clock_drift")] = drift[sample]
            found = measurement.innovation(State(nav[k + 1], xi, step, model))
            assert isinstance(found, Innovation)
            whitened.append(found.z / np.sqrt(found.r))
        z = np.concatenate(whitened)
        # Mean and variance of n unit normals, four sigma.
        assert abs(z.mean()) < 4.0 / math.sqrt(z.size)
        assert abs(z.var() - 1.0) < 4.0 * math.sqrt(2.0 / z.size)


def test_satellites_are_4_to_10_of_good_geometry() -> None:
    rng = np.random.default_rng(0)
    counts = []
    for number in range(14):
        chosen, hdop = ukf_runs.draw_satellites(rng, number)
        counts.append(len(set(chosen.tolist())))
        assert hdop < ukf_runs.MOST_PDOP
    assert set(counts) == set(range(4, 11))


def test_clock_drift_is_the_markov_process_of_the_filter() -> None:
    ends = [ukf_runs.draw_clock(np.random.default_rng(k)) for k in range(200)]
    starts, drifts = (np.array([e[1][i] for e in ends]) for i in (0, -1))
    # Stationary, and after half a correlation time correlated by exp(-1/2); four sigma of 200.
    assert np.std(drifts) == pytest.approx(30.0, rel=4.0 / math.sqrt(400.0))
    correlation = float(np.corrcoef(starts, drifts)[0, 1])
    assert abs(correlation - math.exp(-0.5)) < 4.0 * (1.0 - math.exp(-1.0)) / math.sqrt(200.0)
    offset, drift = ends[0]
    assert np.diff(offset) * ukf_runs.IMU.rate_hz == pytest.approx(drift[:-1], abs=5.0)


@pytest.mark.parametrize("name", ["ekf", "ukf_measurements", "ukf"])
def test_a_clock_that_is_set_unannounced_is_found(name: str) -> None:
    """By a millisecond at the eleventh epoch: all ranges move, no rate does, nothing is refused."""
    problem = ukf_runs.PROBLEMS[2]
    rng = np.random.default_rng(4)
    samples = drive_samples(ukf_runs.IMU, rng)
    measurements = ukf_runs._pseudoranges(rng, 5)[0][:20]
    model = ukf_runs._model(problem)
    sd = model.initial.copy()
    sd[:9] = [0.003, 0.003, 0.03, 0.5, 0.5, 0.5, 30.0, 30.0, 30.0]
    start = ukf_runs._true_states(problem.every_s)[0][0]
    live = DaemonFedFilter(ukf_runs.FILTERS[name](model), ukf_runs.IMU.gap_s, samples, start, sd)
    (slot,) = model.slots_of("clock_offset")
    for k, epoch in enumerate(measurements):
        measurement = epoch[0]
        assert isinstance(measurement, PseudorangeMeasurement)
        before = live.estimator.xi[slot]
        if k >= 10:
            jumped = measurement.ranges + SPEED_OF_LIGHT_M_S * 1e-3
            variances = measurement.range_variance, measurement.rate_variance
            values = epoch_values(
                measurement.position, measurement.velocity, jumped, measurement.rates, *variances
            )
            measurement = replace(measurement, values=values)
        live.advance(k + 1.0, [measurement])
        if k == 10:
            moved = live.estimator.xi[slot] - before
            assert moved == pytest.approx(SPEED_OF_LIGHT_M_S * 1e-3, abs=200.0)
    assert [ukf_runs._refused(entry) for entry in live.entries] == [0] * 20
