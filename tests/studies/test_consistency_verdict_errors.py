"""The study `consistency`: its filter, its drive, its windows, and what it finds."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.integrity.consistency import LAGS, ConsistencyOptions
from fusiond.integrity.innovation_window import ConsistencyMonitor
from fusiond.studies import consistency_verdict_errors as study
from fusiond.studies.single_axis_ins import Fault, innovations, town_drive

Array = NDArray[np.float64]


def test_level_axis_filter_is_the_kalman_filter_it_says() -> None:
    """Matched innovations are white with unit variance; with Q in truth tenfold they are not."""
    source, rng = study.SOURCES[0], np.random.default_rng(17)
    nu = innovations(source, Fault("none"), 2000, 60, 0, rng)
    assert float(np.mean(nu**2)) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / nu.size))
    assert abs(float(np.mean(nu[:, 1:] * nu[:, :-1]))) < 4.0 / math.sqrt(nu.size)
    drifting = innovations(source, Fault("q", q=10.0), 500, 300, 0, rng)[:, 200:]
    assert float(np.mean(drifting[:, 1:] * drifting[:, :-1])) > 0.1


def test_town_drive_turns_and_stops() -> None:
    velocity = town_drive(np.arange(0.0, 400.0, 0.1))
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    assert (float(speed.min()), float(speed.max())) == pytest.approx((0.0, 15.0))
    assert float(velocity[:, 1].max()) > 14.0
    assert float(velocity[:, 0].min()) < -14.0


def test_hysteresis_of_the_study_is_the_monitors() -> None:
    k, epochs = 40, 500
    nu = np.random.default_rng(18).standard_normal((6, epochs, 2))
    nu[:, 250:] *= np.linspace(1.1, 1.6, 6)[:, None, None]
    outside = study.window_verdicts(*study.window_statistics(nu, k), 2, k, 0.01) > 0
    held = study.verdicts_with_hysteresis(outside, k // 2)
    for run in range(len(nu)):
        monitor = ConsistencyMonitor(ConsistencyOptions(window=k))
        found = []
        for row in nu[run]:
            monitor.add(row)
            found.append(monitor.verdict not in {"consistent", "too_few"})
        # From the epoch on at which both have had a full window and have decided.
        assert held[run, k:].tolist() == found[LAGS + k - 1 + k :]
    assert held[-1].any()
    assert not held[0, :100].any()


def test_study_runs_and_is_json(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    result = study.run_study(1000, seed=3, progress=lambda done, of: seen.append((done, of)))
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert seen == [(i + 1, len(seen)) for i in range(len(seen))]
    low, high = result["false_alarm_interval"]
    assert low <= result["alpha"] <= high
    power = {(p["source"], p["fault"]): p["by_window"] for p in result["power"]}
    for source in ("gnss", "rdss"):
        for fault, verdict in (
            ("R half its truth", "optimistic"),
            ("R double its truth", "pessimistic"),
            ("noise correlated by 0.4", "coloured"),
        ):
            found = power[source, fault]["100"]
            assert found["epochs"] < 400
            assert max(found["windows"], key=found["windows"].get) == verdict
        assert power[source, "none"]["100"]["share"] < 0.2
    assert power["gnss", "delay off by 0.5 s"]["100"]["epochs"] < 200
    assert result["paper"]["variance_1_k"]["lags_outside"] == [1]
    assert "rho(1)" in result["finding"]
    study.plot(result, tmp_path / "consistency.png")
    assert (tmp_path / "consistency.png").read_bytes().startswith(b"\x89PNG")


def test_study_repeats_with_its_seed() -> None:
    alarms = [study.false_alarms(300, 0.01, np.random.default_rng([seed, 0])) for seed in (5, 5, 6)]
    assert alarms[0] == alarms[1] != alarms[2]
