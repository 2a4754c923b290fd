"""The study of paper 001: its keys, and what must come out whatever the draw."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from fusiond.estimators.kalman import KalmanEstimator
from fusiond.studies import STUDIES
from fusiond.studies.multiscale import runs
from fusiond.studies.multiscale import study as multiscale

KEYS = {"position_std_m", "velocity_std_m_s", "attitude_std_deg", "nees_mean", "time_per_step_us"}


@cache
def result() -> dict[str, Any]:
    return multiscale.run(2)


def test_keys_are_those_promised() -> None:
    found = result()
    assert STUDIES["multiscale"] == multiscale.__name__
    assert found["runs"] == 2
    assert "paper 001" in found["paper"]["source"]
    assert found["finding"].endswith(".")
    assert found["paper"]["federated"]["position_std_m"] == [6.0023, 5.2128]
    for case in (found, found["variants"]["bias"]):
        names = {"multiscale", "federated", "centralised", "multiscale_n1", "multiscale_n4"}
        assert names <= set(case["filters"])
        for figures in case["filters"].values():
            assert set(figures) >= KEYS
            assert all(isinstance(figures[key], float) for key in KEYS)
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_one_scale_is_the_centralised_filter() -> None:
    found = result()["filters"]
    for key in KEYS - {"time_per_step_us"}:
        one, centralised = found["multiscale_n1"][key], found["centralised"][key]
        assert abs(one / centralised - 1.0) < 1e-6, key


def test_a_federated_filter_with_fusion_reset_is_the_centralised_filter() -> None:
    found = result()["filters"]
    for key in KEYS - {"time_per_step_us"}:
        reset, centralised = found["federated_fusion_reset"][key], found["centralised"][key]
        assert abs(reset / centralised - 1.0) < 1e-6, key


def test_the_matched_centralised_filter_is_not_beaten() -> None:
    for name, figures in result()["filters"].items():
        assert figures["position_std_ratio"]["overall"] > 0.99, name
        assert figures["attitude_std_ratio"]["overall"] > 0.995, name


def test_multi_scale_states_too_small_an_attitude_sigma() -> None:
    found = result()["filters"]
    block, centralised = found["multiscale"], found["centralised"]
    assert block["attitude_sigma_deg"] < 0.98 * centralised["attitude_sigma_deg"]
    assert block["nees_mean"] > centralised["nees_mean"] + 0.3


def test_a_bias_that_nobody_models_hurts_all_alike() -> None:
    matched, biased = result()["filters"], result()["variants"]["bias"]["filters"]
    for name in matched:
        assert biased[name]["velocity_std_m_s"] > 1.5 * matched[name]["velocity_std_m_s"], name
        assert biased[name]["nees_mean"] > 2.0 * matched[name]["nees_mean"], name


def test_runs_repeat_and_begin_as_the_paper_says() -> None:
    drawn = [runs.draw(multiscale.CASES[0], 0, 3) for _ in range(2)]
    traces = [runs.fly(d, lambda m: KalmanEstimator(m, runs.IMU.gap_s)) for d in drawn]
    assert (traces[0].error == traces[1].error).all()
    first = runs.truth().at(np.zeros(1))
    np.testing.assert_allclose(np.degrees(first.rpy[0]), [0.0, 0.0, 90.0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(first.position[0, :2]), [29.0, 118.0])
    assert drawn[0].model.active.sum() == 10


def test_plot_and_tables(tmp_path: Path) -> None:
    path = tmp_path / "multiscale.png"
    multiscale.plot(result(), path)
    assert path.stat().st_size > 10_000
    titles = [title for title, _, _ in multiscale.tables(result())]
    assert len(titles) == 3
    assert "2 runs" in titles[0]
