"""Error statistics of a solution against a truth whose errors are known by construction."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from fusiond.commands.compare_report import print_report
from fusiond.files.measurement_csv import TrajectoryTable
from fusiond.offline.compare import NothingToCompareError, compare

LAT, LON, HEIGHT = 0.7, 2.0, 100.0
# Radii of curvature at 0.7 rad from the closed forms with WGS 84's a and f, worked separately.
_E2 = 0.00669437999014
_W = 1.0 - _E2 * np.sin(LAT) ** 2
MERIDIAN = 6378137.0 * (1.0 - _E2) / _W**1.5
TRANSVERSE = 6378137.0 / _W**0.5

Floats = NDArray[np.float64]


def trajectory(
    t: Floats, north: Floats | float = 0.0, east: Floats | float = 0.0, down: Floats | float = 0.0
) -> TrajectoryTable:
    n = len(t)
    nan = np.full((n, 3), np.nan)
    return TrajectoryTable(
        t_s=t,
        lat_rad=np.full(n, LAT) + north / (MERIDIAN + HEIGHT),
        lon_rad=np.full(n, LON) + east / ((TRANSVERSE + HEIGHT) * np.cos(LAT)),
        height_m=np.full(n, HEIGHT) - down,
        v=nan,
        rpy=nan,
        sd_position=nan,
        sd_v=nan,
        sd_rpy=nan,
        status=[],
        rejected=[],
    )


def test_constant_offset_in_metres_and_signs() -> None:
    t = np.arange(0.0, 10.0, 0.1)
    report = compare(trajectory(t, north=3.0, east=-4.0, down=2.0), trajectory(t))
    assert report["epochs"] == 100
    assert report["horizontal_rms_m"] == pytest.approx(5.0, abs=1e-5)
    assert report["north_mean_m"] == pytest.approx(3.0, abs=1e-5)
    assert report["east_mean_m"] == pytest.approx(-4.0, abs=1e-5)
    assert report["down_mean_m"] == pytest.approx(2.0, abs=1e-9)
    assert report["yaw_rms_deg"] is None
    assert report["v_n_rms_m_s"] is None
    assert report["position_nees"] is None


def test_rms_largest_and_95_percent() -> None:
    t = np.arange(100.0)
    error = np.arange(1.0, 101.0)
    report = compare(trajectory(t, down=error), trajectory(t))
    assert report["down_rms_m"] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert report["down_max_m"] == pytest.approx(100.0)
    assert report["down_p95_m"] == pytest.approx(np.percentile(error, 95))


def test_interpolated_linearly_between_rows() -> None:
    solution = trajectory(np.array([0.0, 1.0]), north=np.array([0.0, 10.0]))
    report = compare(solution, trajectory(np.array([0.25])))
    assert report["north_mean_m"] == pytest.approx(2.5, abs=1e-6)


def test_no_extrapolation_and_no_bridge_across_a_gap() -> None:
    solution = trajectory(np.array([1.0, 2.0, 3.5, 4.0]))
    truth = trajectory(np.array([0.9, 1.0, 1.5, 2.0, 2.1, 3.4, 3.5, 3.6, 4.0, 4.1]))
    report = compare(solution, truth)
    assert report["epochs"] == 6  # 1.0, 1.5, 2.0, 3.5, 3.6, 4.0
    assert report["epochs_not_covered"] == 3  # 2.1, 3.4, 4.1; 0.9 is before the start


def test_rows_without_position_are_no_solution() -> None:
    t = np.arange(0.0, 10.0, 0.5)
    solution = trajectory(t)
    solution.lat_rad[:8] = np.nan
    report = compare(solution, trajectory(t))
    assert (report["epochs"], report["epochs_not_covered"]) == (12, 8)
    assert report["horizontal_max_m"] == pytest.approx(0.0, abs=1e-6)


def test_a_height_that_is_not_known_costs_the_vertical_alone() -> None:
    t = np.arange(0.0, 10.0, 0.1)
    solution = trajectory(t, north=3.0, down=2.0)
    solution.height_m[:50] = np.nan
    report = compare(solution, trajectory(t))
    assert report["epochs"] == 100
    assert report["horizontal_rms_m"] == pytest.approx(3.0, abs=1e-5)
    assert report["down_rms_m"] == pytest.approx(2.0, abs=1e-9)
    solution.height_m[:] = np.nan
    report = compare(solution, trajectory(t))
    assert (report["epochs"], report["down_rms_m"]) == (100, None)
    assert report["horizontal_rms_m"] == pytest.approx(3.0, abs=1e-5)


def test_after_counts_from_the_first_row_of_the_solution() -> None:
    t = np.arange(100.0, 200.0)
    solution = trajectory(t, north=np.where(t < 160.0, 50.0, 1.0))
    report = compare(solution, trajectory(np.arange(90.0, 200.0)), after_s=60.0)
    assert report["t_first_s"] == 160.0
    assert report["horizontal_max_m"] == pytest.approx(1.0, abs=1e-6)


def test_angles_go_the_short_way_round() -> None:
    t = np.array([0.0, 1.0])
    solution = replace(
        trajectory(t),
        rpy=np.radians([[0, 0, 179.0], [0, 0, -179.0]]),
        v=np.array([[1.0, 2, 3]] * 2),
    )
    truth = replace(
        trajectory(np.array([0.5, 1.0])),
        rpy=np.radians([[0.5, 0, -179.0], [0, 0, 178.0]]),
        v=np.array([[0.0, 2, 3]] * 2),
    )
    report = compare(solution, truth)
    assert report["yaw_max_deg"] == pytest.approx(3.0)  # -179 to 178, not 357
    assert report["yaw_rms_deg"] == pytest.approx(np.sqrt((1.0 + 9.0) / 2))
    assert report["roll_max_deg"] == pytest.approx(0.5)
    assert report["v_n_rms_m_s"] == pytest.approx(1.0)
    assert report["v_horizontal_max_m_s"] == pytest.approx(1.0)


def test_longitude_across_the_date_line() -> None:
    t = np.array([0.0, 1.0])
    solution = replace(trajectory(t), lon_rad=np.array([np.pi - 1e-7, -np.pi + 1e-7]))
    truth = replace(trajectory(np.array([0.5])), lon_rad=np.array([np.pi]))
    assert compare(solution, truth)["east_max_m"] == pytest.approx(0.0, abs=1e-3)


def test_an_honest_gaussian_error_meets_the_expectations() -> None:
    rng = np.random.default_rng(20)
    n = 40000
    sigma = np.stack([rng.uniform(0.5, 3, n), rng.uniform(0.5, 3, n), rng.uniform(1, 5, n)], axis=1)
    north, east, down = (rng.normal(size=(n, 3)) * sigma).T
    t = np.linspace(0.0, 0.1 * n, n, endpoint=False)
    solution = replace(trajectory(t, north, east, down), sd_position=sigma)
    report = compare(solution, trajectory(t))
    for k, share in ((1, 0.3935), (2, 0.8647), (3, 0.9889)):
        assert report[f"expected_inside_{k}_sigma"] == pytest.approx(share, abs=5e-5)
        # five standard deviations of a binomial share of 40000
        assert report[f"horizontal_inside_{k}_sigma"] == pytest.approx(share, abs=0.013)
    assert report["horizontal_nees"] == pytest.approx(2.0, abs=0.05)
    assert report["position_nees"] == pytest.approx(3.0, abs=0.06)


def test_inside_is_measured_by_the_ellipse() -> None:
    t = np.array([0.0, 0.5])
    solution = replace(
        trajectory(t, north=np.array([1.5, 1.9]), east=np.array([3.0, 0.0])),
        sd_position=np.array([[1.0, 2.0, 1.0]] * 2),
    )
    # (1.5 / 1)^2 + (3 / 2)^2 = 4.5 > 4; each axis alone would pass
    report = compare(solution, trajectory(t))
    assert report["horizontal_inside_2_sigma"] == 0.5
    assert report["horizontal_inside_3_sigma"] == 1.0


def test_nothing_in_common() -> None:
    with pytest.raises(NothingToCompareError, match=r"0\.000 to 9\.000 s, truth 100\.000 to"):
        compare(trajectory(np.arange(10.0)), trajectory(np.arange(100.0, 110.0)))
    with pytest.raises(NothingToCompareError, match="position none"):
        compare(trajectory(np.array([])), trajectory(np.arange(3.0)))


@pytest.mark.parametrize("terminal", [False, True])
def test_report_for_people(terminal: bool) -> None:
    t = np.arange(0.0, 10.0, 0.1)
    solution = replace(trajectory(t, north=3.0, east=-4.0), sd_position=np.full((len(t), 3), 5.0))
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, width=100, no_color=True)
    print_report(compare(solution, trajectory(t)), console)
    text = stream.getvalue()
    assert "100 epochs, 0.000 to 9.900 s; 0 not covered" in text
    assert "5.0000" in text
    assert "86.5 %" in text
    assert "yaw" not in text
    assert ("┃" in text) == terminal
