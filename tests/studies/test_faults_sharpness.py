"""Sharpness: which instants are of which phase, what NEES is of what is known, and the tables."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from fusiond.studies.faults.matched_noise_drives import CODE, Vehicle, scene
from fusiond.studies.faults.recorded_fault_free import DRIVES, RealJob, real_run
from fusiond.studies.faults.recorded_fault_free import jobs as real_jobs
from fusiond.studies.faults.sigma_sharpness import (
    CELLS,
    DURATION_S,
    FIRST_S,
    MOST_DRIVES,
    OUTAGES_S,
    PHASES,
    figures,
    jobs,
    moments,
    nees_class,
    phases_of,
    sharpness_run,
)
from fusiond.studies.faults.solution_errors import AXES, STEP_S, Published
from fusiond.studies.faults.tables import TABLES
from tests.places import DATA


def drawn(scale: float) -> Published:
    """Errors `scale` times as large as they are stated, from 20 s on."""
    n = round(DURATION_S / STEP_S)
    rng = np.random.default_rng(0)
    sigmas = np.abs(rng.normal(1.0, 0.2, (n, 9))) + 0.1
    errors = scale * sigmas * rng.standard_normal((n, 9))
    t_s = np.arange(1.0, n + 0.5) * STEP_S
    modes = np.where(t_s < 20.0, "aligning", "navigating").astype("<U12")
    errors[t_s < 20.0] = math.nan
    return Published(t_s, errors, sigmas, modes, (), None)


def test_cells_are_all_that_the_page_promises() -> None:
    told = [cell for cell in CELLS if cell.told == "all"]
    assert len(told) == 56
    assert len(set(CELLS)) == len(CELLS) == 68
    assert len(set(jobs(3))) == 204
    with pytest.raises(ValueError, match="100 drives"):
        jobs(MOST_DRIVES + 1)


def test_every_instant_is_of_one_phase() -> None:
    run, recording = drawn(1.0), scene(Vehicle("mems", CODE), "looked", 0, DURATION_S).recording
    for begin_s, length_s in OUTAGES_S.items():
        recording = recording.withheld(begin_s, begin_s + length_s)
    found = phases_of(run, recording)
    assert tuple(found) == PHASES
    assert np.array_equal(np.sum(list(found.values()), axis=0), run.there)
    assert found["first minute"].sum() * STEP_S == pytest.approx(FIRST_S)
    seconds = float(found["outage"].sum()) * STEP_S
    assert 0.0 < seconds - sum(OUTAGES_S.values()) < 3 * 1.3
    assert found["after"].sum() * STEP_S == pytest.approx(90.0)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_nees_is_the_square_of_what_sigma_lacks(scale: float) -> None:
    run = drawn(scale)
    found = moments(run, run.there)
    rows = [{"phases": {"steady": found}}, {"phases": {"steady": found}}]
    for name in AXES:
        nees, half, ratio = figures(rows, "steady", name)
        assert nees == pytest.approx(scale**2, rel=0.1)
        assert half == 0.0
        assert ratio == pytest.approx(1.0 / scale, rel=0.05)


def test_what_is_not_published_is_no_number_and_what_is_not_known_is_left_out() -> None:
    run = drawn(1.0)
    run.errors[:, 5] = math.nan  # the reference has no velocity down
    run.sigmas[500, 8] = math.nan
    found = moments(run, run.there)
    assert found["velocity"]["nees"] == pytest.approx(1.0, rel=0.1)
    assert found["yaw"]["nees"] is None
    assert math.isnan(figures([{"phases": {"steady": found}}], "steady", "yaw")[0])


@pytest.mark.parametrize(
    ("nees", "half", "verdict"),
    [
        (0.7, 0.0, "right"),
        (1.4, 0.0, "right"),
        (0.6, 0.11, "perhaps"),
        (0.6, 0.09, "outside"),
        (2.0, 0.61, "perhaps"),
        (2.0, 0.59, "outside"),
        (2.0, math.inf, "perhaps"),
    ],
)
def test_chance_is_no_verdict(nees: float, half: float, verdict: str) -> None:
    assert nees_class(nees, half) == verdict


def test_the_interval_is_that_of_so_few_drives() -> None:
    nees, half, _ = figures([row(0.9), row(1.1, drive=1)], "steady", "yaw")
    assert nees == pytest.approx(1.0)
    assert half == pytest.approx(12.706 * 0.1, rel=1e-3)
    assert figures([row(0.9)], "steady", "yaw")[1] == math.inf


def test_a_cell_is_run_and_told() -> None:
    cell = CELLS.index(Vehicle("tactical", CODE))
    found = [sharpness_run((cell, drive), "looked") for drive in range(2)]
    assert all(row["crash"] is None for row in found)
    for phase in PHASES:
        nees, _, ratio = figures(found, phase, "position")
        assert 0.01 < nees < 30.0
        assert 0.1 < ratio < 10.0
    text = TABLES["sharpness"](found)
    assert "| tactical | code | 1 | given | outage |" in text
    assert "2 runs, at most 2 a cell; 0 ended the navigator." in text
    assert "the class alone" not in text


def row(nees: float, told: str = "all", drive: int = 0) -> dict[str, Any]:
    parts = {"nees": nees, "error2": 1.0, "sigma2": 4.0}
    named = {"imu": "mems", "receiver": "code", "rate_hz": 1.0, "lever_given": True}
    phases = {phase: dict.fromkeys(AXES, parts) for phase in PHASES}
    return {"cell": 0, **named, "told": told, "drive": drive, "phases": phases, "crash": None}


def test_marks() -> None:
    text = TABLES["sharpness"]([row(0.5), row(0.5, drive=1)])
    assert "| all | steady | 0, 0, 1 |" in text
    assert "| mems | code | 1 | given | steady | **0.50** (2.00) |" in text
    text = TABLES["sharpness"]([row(0.2, "class"), row(1.0, "class", 1)])
    assert "| the class alone | steady | 0, 1, 0 |" in text
    assert "| 0.60? (2.00) |" in text


def test_where_no_drive_is_there_it_says_so(tmp_path: Any) -> None:
    with pytest.raises(ValueError, match="none of the drives drive_0708, css_164"):
        real_jobs(tmp_path)


@pytest.mark.skipif(
    not (DATA / "walk_0827").is_dir(), reason=f"walk_0827 is absent: {DATA} (set FUSIOND_DATA)"
)
def test_a_recorded_walk_is_compared_where_its_fixes_are_withheld() -> None:
    quiet, held = (real_run(RealJob(DATA, "walk_0827", outages)) for outages in (None, 0))
    assert quiet["compared"] == 0
    assert quiet["isolated"] == 0
    assert quiet["phases"]["steady"]["position"]["nees"] is None
    seconds = sum(length_s for _, length_s in DRIVES["walk_0827"].outages[0])
    assert held["compared"] == 4 * seconds
    assert len(held["largest_m"]) == 5
    assert 0.0 < max(held["largest_m"]) < 5.0
    assert quiet["largest_m"] == []
    assert held["phases"]["steady"]["velocity"]["nees"] > 0.0
    assert held["phases"]["steady"]["yaw"]["nees"] is None
    text = TABLES["real"]([quiet, held])
    assert "| walk_0827 | none | 134 | 0 | 0 |" in text
    assert "| walk_0827 | 1 sets | 134 |" in text
