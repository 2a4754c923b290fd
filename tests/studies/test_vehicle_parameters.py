"""What a filter finds of a vehicle is as good as it says: some of the study's cars."""

from __future__ import annotations

import pytest

from fusiond.studies.vehicle_parameters.runs import Run
from fusiond.studies.vehicle_parameters.study import _one, rows_of

# NEES of few cars: a matched filter's mean over four of one state is beyond 6 once in 10,000.
MOST = 6.0


def cars(case: str, count: int) -> list[Run]:
    return [_one(case, 7, number) for number in range(count)]


@pytest.mark.parametrize("case", ["shown", "hidden"])
def test_sigma_is_honest_and_knows_what_was_shown(case: str) -> None:
    rows = {row["block"]: row for row in rows_of(case, cars(case, 4))}
    for block, row in rows.items():
        assert row["nees"] < MOST, block
    kept = {block: max(row["kept"]) for block, row in rows.items()}
    for block in ("axle_lever", "wheel_rounding", "barometer_airflow", "wheel_latency"):
        assert kept[block] > 0.9 if case == "hidden" else kept[block] < 0.5, block
    for block in ("mounting", "gnss_time", "gnss_velocity_time", "wheel_scale"):
        assert case == "hidden" or kept[block] < 0.2, block


def test_axes_out_of_square_are_noise_while_the_vehicle_turns() -> None:
    known = {r["block"]: r["nees"] for r in rows_of("askew", cars("askew", 2))}
    without = cars("askew, no noise for it", 2)
    unknown = {r["block"]: r["nees"] for r in rows_of("askew", without)}
    for block in ("attitude", "velocity", "position", "mounting"):
        assert known[block] < MOST, block
    assert unknown["attitude"] > 3.0 * MOST
