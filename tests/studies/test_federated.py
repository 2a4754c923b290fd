"""The study `federated`: its keys, the relations that theory gives, and its pictures."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from fusiond.studies.federated import linear_experiments as federated_papers
from fusiond.studies.federated import study as federated


@cache
def result() -> dict[str, Any]:
    seen: list[tuple[int, int]] = []
    found = federated.run_study(2, seed=1, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(k, 16) for k in range(1, 17)]
    return found


def test_every_fault_has_its_figures() -> None:
    found = result()
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["runs"] == 2
    assert "paper 004" in found["paper"]["source"]
    assert set(found["faults"]) == {"step", "drift", "frozen"}
    for name, fault in found["faults"].items():
        assert 0.0 < fault["detected_after_s"] < 60.0
        if name != "frozen":  # which the local filters' gates keep out by themselves
            assert fault["rms_isolated_m"] < 0.5 * fault["rms_unisolated_m"]
        assert fault["rms_isolated_m"] < 2.5
        assert fault["rms_centralised_m"] < 2.5
        assert fault["rms_isolated_m"] == fault["modes"]["no_reset"]["rms_m"]
    assert ". " not in found["finding"]
    for name in ("step", "drift", "frozen"):
        assert name in found["finding"]


def test_with_a_reset_the_filter_is_the_centralised_one() -> None:
    """The one that is judged by its gate alone, too: an estimated noise is not the federated's."""
    for honest in result()["honesty"].values():
        f = honest["filters"]
        for mode in ("fusion_reset", "zero_reset"):
            for key in ("nees_mean", "horizontal_rms_m"):
                assert f[mode][key] == pytest.approx(f["centralised_gate_only"][key], rel=1e-4)


def test_active_and_passive_receiver_fuse_to_better_than_either() -> None:
    e = result()["experiments"]["4_active_and_passive"]
    assert e["federated_rms_m"] < e["active_alone_rms_m"] < e["rdss_fixes_rms_m"]
    assert e["federated_rms_m"] < e["gnss_fixes_rms_m"]
    assert e["federated_rms_m"] == pytest.approx(e["centralised_rms_m"], rel=0.1)


def test_two_receivers_without_an_inertial_unit() -> None:
    """Experiments 3 and 4 live. What the estimates share is the vehicle's motion, and of two active
    terminals an error: taken for uncorrelated, with nothing shared out, they state too little."""
    for name, live in result()["without_imu"].items():
        e = live["estimates"]
        for label in ("federated", "federated, correlated"):
            assert e[label]["rms_m"] == pytest.approx(e["one filter"]["rms_m"], rel=0.1)
            for source, rms in live["fixes_rms_m"].items():
                assert e[label]["rms_m"] < rms
                assert e[label]["sigma_m"] < e[f"{source} alone"]["sigma_m"], (name, source)
            assert e["as if uncorrelated"]["sigma_m"] < 0.95 * e[label]["sigma_m"]
            assert e["as if uncorrelated"]["nees_mean"] > 1.2 * e[label]["nees_mean"]
        # One of a bound and one of what is shared: alike where the sources are.
        assert e["federated, correlated"]["sigma_m"] == pytest.approx(
            e["federated"]["sigma_m"], rel=0.1
        )


def test_experiments_of_the_paper() -> None:
    one = federated_papers.random_truth(200, 0)
    assert one["filtered_rms_m"] == pytest.approx(one["filter_sigma_m"], rel=0.03)
    assert one["filtered_rms_m"] < 0.5 * one["measured_rms_m"]
    two = federated_papers.constant_truth(200, 0)
    for rms, theory in zip(two["rms_m"], two["theory_m"], strict=True):
        assert rms == pytest.approx(theory, rel=0.2)


def test_fusion_of_two_sensors_that_share_their_process_noise() -> None:
    """Only the uncorrelated formula on correlated estimates states too little."""
    found = federated_papers.two_sensors(300, 0)
    e = found["estimates"]
    # 150 steps of 300 runs; errors stay alike for some ten steps: 15 independent instants a run.
    half = 3.3 * math.sqrt(2.0 * 2.0 / (300 * 15))
    for name in ("sensor_1", "sensor_2", "correlated", "centralised"):
        assert e[name]["nees_mean"] == pytest.approx(2.0, abs=half), name
    assert e["uncorrelated"]["nees_mean"] > 2.4
    assert e["federated"]["nees_mean"] <= 2.0 + half
    for name in ("uncorrelated", "correlated", "federated"):
        assert e[name]["rms_m"] < 0.95 * e["sensor_1"]["rms_m"]
        assert e[name]["rms_m"] == pytest.approx(e["centralised"]["rms_m"], rel=0.05)
    assert (
        e["centralised"]["rms_m"] <= min(e["correlated"]["rms_m"], e["federated"]["rms_m"]) * 1.01
    )


def test_pictures_and_tables(tmp_path: Path) -> None:
    path = tmp_path / "federated.png"
    federated.plot(result(), path)
    assert path.read_bytes().startswith(b"\x89PNG")
    titles = [title for title, _, _ in federated.tables(result())]
    assert sum("fault" in title for title in titles) == 5
    for _, header, rows in federated.tables(result()):
        assert all(len(row) == len(header) for row in rows)


def test_too_few_runs_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        federated.run_study(1)
