"""Study `ins-gnss-sar`: its skies, and the relations that a few short flights must show."""

from __future__ import annotations

import json
from functools import cache, partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from fusiond.gnss.best_four_satellites import gdop_squared
from fusiond.gnss.ecef import ned_axes, to_ecef
from fusiond.studies import STUDIES, ins_gnss_sar
from fusiond.studies.reduced_order import flight
from fusiond.studies.reduced_order.cost import costs
from fusiond.studies.reduced_order.runs import fly

RUNS, SECONDS = 6, 400.0
AXES = range(3)


@cache
def result() -> dict[str, Any]:
    """The study; steps are timed but twice, as in test_reduced_order."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ins_gnss_sar, "costs", partial(costs, rounds=2))
        return ins_gnss_sar.run_study(RUNS, 1, seconds=SECONDS)


def test_keys_of_the_issue() -> None:
    found = result()
    assert STUDIES["ins-gnss-sar"] == "fusiond.studies.ins_gnss_sar"
    assert (found["runs"], found["nees_dof"], found["nees_expected"]) == (RUNS, 9, 9.0)
    assert set(found["cases"]) == {"four", "all"}
    for case in found["cases"].values():
        assert set(case) == {"23", "17"}
        for f in case.values():
            assert len(f["attitude_std_arcsec"]) == len(f["velocity_std_m_s"]) == 3
            assert f["horizontal_rms_m"] > 0.0
            assert f["live_second_us"] > f["time_per_step_us"] > 0.0
    assert found["paper"]["models"]["17"]["attitude_sigma_arcsec"] == [36.52, 65.62, 56.11]
    assert "\n" not in found["finding"]
    json.dumps(found, allow_nan=False)


def test_23_states_know_their_error() -> None:
    """Mean of the runs, 99.99 %: the instants of one run count as one."""
    low, high = (float(chi2.ppf(q, 9 * RUNS)) / RUNS for q in (5e-5, 1.0 - 5e-5))
    for case in result()["cases"].values():
        assert low < case["23"]["nees_mean"] < high


def test_17_states_know_theirs() -> None:
    """The accelerometer biases are noise to the filter: what it errs by more than 23 states, it
    says. Between 0.7 and 1.4 a degree, each as far off as the runs leave open, 99.99 %."""
    low, high = (float(chi2.ppf(q, 9 * RUNS)) / RUNS for q in (5e-5, 1.0 - 5e-5))
    for case in result()["cases"].values():
        f = case["17"]
        assert 0.7 * low < f["nees_mean"] < 1.4 * high
        assert f["nees_to_expected"] == pytest.approx(f["nees_mean"] / 9.0)
        assert f["horizontal_rms_m"] < 1.2 * case["23"]["horizontal_rms_m"]
        assert f["velocity_std_m_s"][2] > case["23"]["velocity_std_m_s"][2]


def test_all_in_view_are_not_worse_than_four() -> None:
    cases = result()["cases"]
    for name in ("23", "17"):
        four, every = cases["four"][name], cases["all"][name]
        assert every["horizontal_rms_m"] < four["horizontal_rms_m"]
        assert every["believed_horizontal_m"] < four["believed_horizontal_m"]
        for axis in AXES:
            for what in ("attitude_sigma_arcsec", "velocity_sigma_m_s"):
                key = f"believed_{what}"
                assert every[key][axis] < four[key][axis]
            # Attitude hangs on radar and accelerometer: alike within a tenth.
            assert every["attitude_std_arcsec"][axis] < 1.1 * four["attitude_std_arcsec"][axis]


def test_integration_at_the_imu_rate_errs_little() -> None:
    found = result()["integration"]
    assert (found["rate_hz"], found["fine_rate_hz"]) == (20.0, 100.0)
    assert 0.0 < found["error_to_sigma"] < 0.01
    assert 0.0 < found["sigma_change"] < 0.001


def test_all_in_view_hold_the_best_four() -> None:
    """At a choice no other four of those in view have a smaller GDOP."""
    nav = flight.true_nav(flight.truth(SECONDS))
    both = zip(flight.scenes(SECONDS), flight.scenes(SECONDS, True), strict=True)
    for k, (four, every) in enumerate(both):
        rows = [every.names.index(name) for name in four.names]
        np.testing.assert_array_equal(every.position[rows], four.position)
        assert (four.rows, every.rows) == (10, 2 * len(every.names) + 2)
        if k % flight.CHOICE_S:
            continue
        lat, lon, height = (float(x) for x in nav[k + 1, :3])
        apart = every.position - np.array(to_ecef(lat, lon, height))
        unit = apart / np.linalg.norm(apart, axis=1)[:, None]
        assert (-(unit @ ned_axes(lat, lon))[:, 2] > np.sin(flight.MASK_RAD)).all()
        sets = np.array(list(combinations(range(len(unit)), 4)))
        least = gdop_squared(unit, sets).min()
        assert gdop_squared(unit, np.array([rows]))[0] == pytest.approx(least)


def test_noise_of_a_satellite_is_the_same_in_both_skies() -> None:
    drawn = np.random.default_rng(0).standard_normal((flight.DRAWN, 2))
    four, every = (flight.scenes(SECONDS, a)[200] for a in (False, True))
    a, b = four.noise(drawn), every.noise(drawn)
    assert (len(a), len(b)) == (four.rows, every.rows)
    for k, name in enumerate(four.names):
        j = every.names.index(name)
        assert (a[k], a[4 + k]) == (b[j], b[len(every.names) + j])
    np.testing.assert_array_equal(a[-2:], b[-2:])


def test_runs_repeat() -> None:
    models = {"23": flight.model("ins23")}
    a, b = (fly(models, 100.0, 50, True, 3, 2)["23"].error for _ in range(2))
    np.testing.assert_array_equal(a, b)
    assert a.shape == (2, 20)


def test_tables_and_picture(tmp_path: Path) -> None:
    for _, header, rows in ins_gnss_sar.tables(result()):
        assert {len(row) for row in rows} == {len(header)}
    ins_gnss_sar.plot(result(), tmp_path / "i.png")
    assert (tmp_path / "i.png").read_bytes().startswith(b"\x89PNG")


def test_too_few_runs() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        ins_gnss_sar.run_study(1)
