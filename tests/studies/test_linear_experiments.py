"""Study `papers`: every paper's model through the navigator, and what it states of itself."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from fusiond.models.catalogue import MODELS
from fusiond.simulation.papers import PAPERS
from fusiond.studies.paper_models_nees import (
    CASES,
    GROUPS,
    HONEST,
    WITHOUT_IMU,
    plot,
    run_case,
    run_study,
    tables,
)

SHORT = ("001 planar10", WITHOUT_IMU)


def test_every_model_and_every_paper_is_flown() -> None:
    made = {name: case.made() for name, case in CASES.items()}
    assert {config.estimator.model for config, _ in made.values()} == set(MODELS)
    assert {case.paper for case in CASES.values()} == set(PAPERS)
    for name, (config, scenario) in made.items():
        assert scenario.imu == config.imu, name
        raw = {"raw"} & {section.kind for section in config.aiding.values()}
        assert bool(raw) is CASES[name].raw, name
    for model in MODELS:  # what a class has goes to each
        config, _ = CASES[f"mems {model}"].made()
        assert config.imu.sensor_class == "mems"
        assert config.imu.gyro_scale_ppm == 5000.0


def test_a_run_repeats_and_another_is_another() -> None:
    first, again, other = (run_case("001 planar10", 5, k) for k in (0, 0, 1))
    assert first == again != other


def test_its_result_its_tables_and_its_picture(tmp_path: Path) -> None:
    result = run_study(2, cases=SHORT)
    json.dumps(result, allow_nan=False)
    assert set(result["cases"]) == set(SHORT)
    for name, case in result["cases"].items():
        for group, of in case["groups"].items():
            assert of["nees"] == pytest.approx(np.mean(of["nees_of_runs"])), (name, group)
            assert 0.3 < of["rms"] / of["sigma"] < 3.0
    assert "attitude" not in result["cases"][WITHOUT_IMU]["groups"]
    ((_, header, rows),) = tables(result)
    assert all(len(row) == len(header) for row in rows)
    outside = [
        of["nees"]
        for case in result["cases"].values()
        for of in case["groups"].values()
        if not HONEST[0] <= of["nees"] <= HONEST[1]
    ]
    assert f"of {5 - len(outside)} of 5 lies" in result["finding"]
    plot(result, tmp_path / "p.png")
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("case", ["mems ins15", "mems ins23", "003 ins20 fixes"])
def test_models_without_scale_factors_know_their_attitude_and_velocity(case: str) -> None:
    """A unit of 5000 ppm in a town: 0.45 deg of heading a corner. Mean of three runs; an attitude
    in error is one draw a run, of which three have a spread of 0.47."""
    rows = [run_case(case, 0, k) for k in range(3)]
    mean = {group: math.fsum(row[f"{group}_nees"] for row in rows) / 3.0 for group in GROUPS}
    assert 0.7 < mean["position"] < 1.4
    assert 0.65 < mean["velocity"] < 1.4
    assert 0.5 < mean["attitude"] < 1.6
