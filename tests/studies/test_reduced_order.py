"""Study `reduced-order`: its flight, the relations that must hold, live filters and analysis."""

from __future__ import annotations

import json
import math
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from fusiond.aiding.base import State
from fusiond.navigation.strapdown import STEP_SIZE
from fusiond.studies import STUDIES
from fusiond.studies.covariance_analysis import analyse
from fusiond.studies.reduced_order import flight, study
from fusiond.studies.reduced_order.cost import costs
from fusiond.studies.reduced_order.runs import combinations, fly, started_filter
from fusiond.studies.reduced_order.study import plot, run_study, tables

RUNS = 6


@cache
def result() -> dict[str, Any]:
    """The study; how long steps take is the benchmark's matter, so they are timed but twice."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "costs", partial(costs, rounds=2))
        return run_study(RUNS)


def test_study_has_its_keys() -> None:
    found = result()
    assert "reduced-order" in STUDIES
    assert found["runs"] == RUNS
    for name in ("23", "17"):
        figures = found["models"][name]
        for key in ("attitude_sigma_arcsec", "velocity_sigma_m_s"):
            assert len(figures[key]) == len(found["paper"]["models"][name][key]) == 3
        assert figures["time_per_step_us"] > 0.0
    assert found["paper"]["time_ratio"] == 0.45
    assert "\n" not in found["finding"]
    json.dumps(found, allow_nan=False)


def test_no_reduced_filter_beats_the_full_one_and_the_bare_one_believes_too_much() -> None:
    models = result()["models"]
    for key in ("attitude_sigma_arcsec", "velocity_sigma_m_s"):
        full = np.array(models["23"][key])
        np.testing.assert_allclose(full, models["23"][f"believed_{key}"], rtol=1e-6)
        for name in ("17", "17_bare"):
            assert (np.array(models[name][key]) > full).all()
        bare = models["17_bare"]
        assert (np.array(bare[key]) > np.array(bare[f"believed_{key}"])).all()
        # The biases as white noise are better than nothing, where the bias shows most.
        assert models["17"]["velocity_sigma_m_s"][2] < models["17_bare"]["velocity_sigma_m_s"][2]


@pytest.mark.parametrize("variant", [None, *study.VARIANTS])
def test_the_reduced_filter_knows_its_error(variant: str | None) -> None:
    """NEES of attitude, velocity and position by the analysis, with every radar; the position is
    nearly that of the 23 states."""
    found = result() if variant is None else result()["variants"][variant]
    models = found["models"]
    assert models["23"]["expected_nees_per_dof"] == pytest.approx(1.0, abs=1e-6)
    assert 0.7 < models["17"]["expected_nees_per_dof"] < 1.4
    assert models["17_bare"]["expected_nees_per_dof"] > 1000.0
    assert models["17"]["horizontal_sigma_m"] < 1.2 * models["23"]["horizontal_sigma_m"]


def test_level_tilt_of_the_reduced_filter_is_the_accelerometer_bias() -> None:
    """A bias b that nobody estimates tilts by b / g: 1e-4 rad, 20.6 arc seconds. As noise it lets
    the radar say more of the tilt, and its own noise in."""
    tilt = flight.IMU.accel_bias_initial_mg * 1e-3 / flight.ARC_SECOND
    for axis in (0, 1):
        found = result()["models"]["17_bare"]["attitude_sigma_arcsec"][axis]
        assert tilt < found < 1.1 * tilt
        believed = result()["models"]["17"]["believed_attitude_sigma_arcsec"][axis]
        assert 0.7 * tilt < believed < 1.4 * tilt


def test_noises_that_are_not_printed_make_table_2() -> None:
    """Those of 23 states within a sixth, by two sets of them; of 17 the level tilt and the velocity
    east within a tenth, azimuth and velocity north within a quarter, the vertical velocity not."""
    of, paper = result()["implied"]["models"], result()["paper"]["models"]

    def off(name: str, printed: str) -> np.ndarray:
        ratios = [np.array(of[name][key]) / paper[printed][key] for key in of[name]]
        return np.abs(np.log(np.concatenate(ratios)))

    assert off("23", "23").max() < math.log(1.19)
    assert off("23_other", "23").max() < math.log(1.14)
    assert off("17", "17")[[0, 1, 3]].max() < math.log(1.1)
    assert off("17", "17")[[2, 4]].max() < math.log(1.26)
    assert off("17", "17")[5] > math.log(5.0)


def test_both_level_axes_of_table_2_imply_one_gyro() -> None:
    """By a filter of two states in closed form, which its Riccati equation has."""
    by_hand = result()["implied"]["by_hand"]
    east, north = by_hand["phi_n_dv_e"], by_hand["phi_e_dv_n"]
    assert east["gyro_deg_sqrt_h"] == pytest.approx(0.104, abs=1e-3)
    assert north["gyro_deg_sqrt_h"] == pytest.approx(0.100, abs=1e-3)
    assert 5.5 < by_hand["azimuth_ratio"] < 5.6
    g, n = 9.80665, math.radians(east["gyro_deg_sqrt_h"]) / 60.0
    r = east["velocity_m_s_sqrt_hz"] ** 2
    p = solve_continuous_are(
        np.array([[0.0, g], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.diag([n**2, 0.0]), [[r]]
    )
    tilt = math.hypot(math.sqrt(p[0, 0]), 1e-4) / flight.ARC_SECOND
    assert (tilt, math.sqrt(p[1, 1])) == pytest.approx((36.25, 0.023), rel=1e-3)


def test_ranks_at_rest() -> None:
    """By GNSS the 16 of the paper's 23: the radar's angles, level tilt and accelerometers, azimuth
    and east gyro hide."""
    still = result()["at_rest"]
    assert (still["gnss"]["states"], still["gnss"]["rank"]) == (23, 16)
    assert still["gnss_sar"]["rank"] == 19
    hidden = {name.split(".")[0] for d in still["gnss"]["hidden"] for name in d}
    assert {"accel_bias", "attitude", "sar_misalignment"} <= hidden
    assert "clock_offset" not in hidden
    assert "accel_bias.z" not in still["gnss"]["not_estimated"]


def test_straight_flight_hides_three_directions_of_attitude_bias_and_misalignment() -> None:
    driven = result()["variants"]["sar_driven"]["observability"]
    # That it decays tells a driven misalignment from a constant bias, in the strict sense alone.
    assert (driven["states"], driven["rank"], driven["informative"]) == (23, 22, 20)
    variants = [v for name, v in result()["variants"].items() if name != "sar_driven"]
    for case in (result(), *variants):
        seen = case["observability"]
        assert (seen["states"], seen["rank"], seen["informative"]) == (23, 20, 20)
        hidden = {s.split(".")[0] for d in seen["weakest"][-3:] for s in d["states"]}
        assert hidden <= {"attitude", "accel_bias", "sar_misalignment"}
        assert all(d["sigma_left"] == pytest.approx(1.0) for d in seen["weakest"][-3:])
        left = {name: v["without_process_noise"] for name, v in seen["sigma_left"].items()}
        # What paper 002 calls unobservable, and is not.
        assert max(left[f"gyro_bias.{a}"] for a in "xyz") < 0.4
        assert left["accel_bias.z"] < 0.01
        assert left["clock_offset.receiver"] < 0.01
        assert all(0.0 < v <= 1.0 + 1e-9 for v in left.values())


def test_live_filters_err_as_the_analysis_says_and_the_bare_one_does_not_know() -> None:
    checked = result()["validation"]
    low, high = checked["nees_interval"]
    for figures in checked["models"].values():
        assert low < figures["nees_mean"] < high
    own = {name: figures["believed_nees_per_dof"] for name, figures in checked["models"].items()}
    assert 0.6 < own["23"] < 1.5
    assert 0.6 < own["17"] < 1.5
    assert own["17_bare"] > 100.0


def test_runs_repeat() -> None:
    models = {"23": flight.model("ins23")}
    a, b, other = (fly(models, 100.0, 100, False, 1, k)["23"].error for k in (4, 4, 5))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, other)


def test_measured_values_are_those_of_the_true_state() -> None:
    """A filter in the true state, parameters and all, sees no innovation."""
    of = flight.model("ins23")
    scene = flight.scenes(40.0)[20]
    nav = flight.true_nav(flight.truth(40.0))[21]
    xi = np.zeros(of.size)
    xi[of.slots_of("clock_offset")], xi[of.slots_of("clock_drift")] = 2e5, -120.0
    xi[of.slots_of("sar_misalignment")] = 1e-4, -2e-4, 3e-4
    true = State(nav, xi, np.zeros(STEP_SIZE), of)
    measurements = flight.measured(scene, true, np.zeros(scene.rows))
    np.testing.assert_allclose(flight.rows(measurements, true).z, 0.0, atol=1e-7)
    z = flight.rows(flight.measured(scene, true, np.ones(scene.rows)), true).z
    sd = [5.0] * 4 + [0.05] * 4 + [1e-3] * 2
    np.testing.assert_allclose(z, -np.array(sd), rtol=1e-6)


def test_transition_of_a_second_is_that_of_the_running_filter() -> None:
    """Propagated with its Phi and Q, a covariance is what the filter's own kernel makes of it."""
    for name in ("ins17", "ins23"):
        of = flight.model(name)
        steps = list(flight.systems(of, 5.0))
        p = np.diag(flight.initial_sd(of) ** 2)
        rowless = [s._replace(h=np.zeros((0, of.size)), r=np.zeros(0)) for s in steps]
        *_, last = analyse(
            zip(rowless, rowless, strict=True), np.arange(of.size), p, p, np.arange(9)
        )
        path = flight.truth(5.0)
        estimator = started_filter(of, flight.true_nav(path)[0])
        estimator.propagate(
            flight.imu_buffer(np.hstack([path.gyro, path.accel])), 5 * flight.EPOCH_NS
        )
        sd = np.sqrt(np.diag(estimator.covariance))
        np.testing.assert_allclose(
            last.true / np.outer(sd, sd), estimator.covariance / np.outer(sd, sd), atol=1e-7
        )


def test_combinations_are_what_truth_and_filters_share() -> None:
    full, small = combinations(flight.model("ins23")), combinations(flight.model("ins17"))
    assert (full.shape, small.shape) == ((20, 23), (20, 17))
    # Constant and Markov drift of an axis together; the reduced model has no accelerometer bias.
    assert full[9].sum() == 2.0
    assert small[9].sum() == 1.0
    assert not small[12:15].any()
    assert np.linalg.matrix_rank(full) == 20


def test_costs_of_step_and_live_second() -> None:
    """How large they are is the benchmark's matter; a second holds a hundred propagations."""
    found = costs({n: flight.model(n) for n in ("ins17", "ins23")}, rounds=2)
    for cost in found.values():
        assert cost.live_second_s > cost.step_s > 0.0


def test_tables_and_picture(tmp_path: Path) -> None:
    found = tables(result())
    assert len(found) == 2 * (1 + len(study.VARIANTS)) + 4
    for _, header, rows in found:
        assert all(len(row) == len(header) for row in rows)
    picture = tmp_path / "r.png"
    plot(result(), picture)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_too_few_runs() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        run_study(1)


def test_azimuth_of_the_points_stays_where_the_text_says() -> None:
    """Abeam, 30 km aside, to 37 deg before and behind: |azimuth| from 53 to 127 deg."""
    of = flight.model("ins23")
    nav = flight.true_nav(flight.truth(600.0))
    angles = []
    for k, scene in enumerate(flight.scenes(600.0)):
        state = State(nav[k + 1], np.zeros(of.size), np.zeros(STEP_SIZE), of)
        angles.append(flight.rows(flight.measurements(scene, np.zeros(scene.rows)), state).z[8])
    degrees = np.degrees(np.abs(angles))
    assert 52.0 < degrees.min() < 54.5
    assert 125.5 < degrees.max() < 128.0
    assert math.isclose(abs(np.sign(angles).sum()), 0.0, abs_tol=10.0)
