"""Odds of the fault bank: evidence is chi-square, a fault is found with its size and its end."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    E_AT,
    E_ROWS,
    J_AT,
    L_AT,
    L_ROWS,
    N_AT,
    RESTARTS,
    group_at,
)
from fusiond.estimators.fault_odds import APART, identified, solve
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.integrity.catalogue import table_of
from tests import runs
from tests.estimators.fault_bank_drive import (
    IMU,
    INITIAL,
    KINDS,
    LAST_NS,
    MODEL,
    RESTART,
    Array,
    buffer_of,
    drive,
    measurements,
    row_of,
    run,
)


def test_evidence_is_chi_square_if_nothing_is_wrong() -> None:
    """Of each kind of three numbers, over 60 runs: mean within 4.5 of its own sigmas."""
    names = ("gyro", "accelerometer", "position", "velocity", "velocity_drift")
    found: dict[str, list[float]] = {name: [] for name in names}
    m = np.empty(12)
    for seed in range(60):
        made = run(seed=100 + seed)
        bank = made.hypotheses
        assert bank is not None
        for name in names:
            row = row_of(name)
            assert bank.each(N_AT)[row, RESTART] == 24.0  # four epochs of six rows
            at = group_at(bank.bank, RESTARTS * row + RESTART)
            found[name].append(solve(bank.bank, at, 3, bank.table.numbers[row], 1e-9, m))
            assert bank.each(E_AT)[row, RESTART] != 0.0
            assert bank.each(L_AT)[row, RESTART] > 0.0
    for name, values in found.items():
        sigma = math.sqrt(2.0 * 3.0 / len(values))
        assert abs(np.mean(values) - 3.0) < 4.5 * sigma, (name, np.mean(values))


@pytest.mark.parametrize(
    ("fault", "size"),
    [
        ("gyro", (math.radians(1.0), 0.0, 0.0)),
        ("accelerometer", (0.5, 0.0, 0.0)),
        ("position", (20.0, 0.0, 0.0)),
        ("velocity", (0.0, 2.0, 0.0)),
    ],
)
def test_a_fault_is_found_with_its_size(fault: str, size: tuple[float, ...]) -> None:
    """By odds, three seconds after its onset, which is a restart's."""
    made = run(fault, np.array(size))
    bank = made.hypotheses
    assert bank is not None
    bank.judge(LAST_NS)
    odds = np.where(bank.explains, bank.log_odds, -np.inf)
    row, restart = np.unravel_index(int(np.argmax(odds)), odds.shape)
    # Kinds of one class are taken together; of others none may fit much better.
    fits = np.where(bank.explains, bank.log_likelihood, -np.inf)
    assert fits[row_of(fault)].max() > fits.max() - APART, KINDS[row].name
    best = bank.estimated(RESTARTS * row_of(fault) + RESTART)
    apart = (best.size - np.array(size)) / np.sqrt(np.diagonal(best.covariance))
    assert np.abs(apart).max() < 4.0
    assert odds[row, restart] > 7.0


@pytest.mark.parametrize(
    ("fault", "size"),
    [
        ("gyro", (math.radians(1.0), 0.0, 0.0)),
        ("accelerometer", (0.5, 0.0, 0.0)),
        ("position", (20.0, 0.0, 0.0)),
        ("velocity", (0.0, 2.0, 0.0)),
    ],
)
def test_the_likeliest_is_of_the_faults_class(fault: str, size: tuple[float, ...]) -> None:
    bank = run(fault, np.array(size)).hypotheses
    assert bank is not None
    bank.judge(LAST_NS)
    odds = np.where(bank.explains, bank.log_odds, -np.inf)
    row = int(np.argmax(odds)) // RESTARTS
    assert KINDS[row].of == KINDS[row_of(fault)].of, KINDS[row].name


def test_odds_are_those_of_schwarz_or_of_a_size_that_is_known() -> None:
    """Of a position's group and of a delay's, each by dense products."""
    made = run("position", np.array([4.0, 0.0, 0.0]))
    bank = made.hypotheses
    assert bank is not None
    bank.judge(LAST_NS)

    def group_of(row: int) -> tuple[Array, Array, float, float]:
        at, p = group_at(bank.bank, RESTARTS * row + RESTART), KINDS[row].size
        information = bank.bank[at + L_ROWS[:p, :p]]
        rate = math.log(2.0 * KINDS[row].per_hour / 3600.0)
        return information, bank.bank[at + E_ROWS[:p]], float(bank.bank[at + N_AT]), rate

    row = row_of("position")
    information, e, rows, rate = group_of(row)
    gained = 0.5 * e @ np.linalg.solve(information, e)
    s = np.diag(np.array(KINDS[row].sd) ** 2)
    by_size = 0.5 * np.linalg.slogdet(np.eye(3) + s @ information)[1]
    expected = rate + gained - max(1.5 * math.log(rows), by_size)
    assert math.isclose(bank.log_odds[row, RESTART], expected, rel_tol=1e-6)
    assert math.isclose(bank.log_likelihood[row, RESTART], gained, rel_tol=1e-6)
    row = next(k for k, kind in enumerate(KINDS) if kind.name == "delay" and kind.lag_s == 1.0)
    information, e, rows, rate = group_of(row)
    of, beyond, about = information.item(), e.item() - information.item(), KINDS[row].sd[0] ** 2
    gained = e.item() - 0.5 * of + 0.5 * beyond**2 / (of + 1.0 / about)
    expected = rate + gained - 0.5 * math.log1p(about * of)
    assert math.isclose(bank.log_odds[row, RESTART], expected, rel_tol=1e-9)


def test_the_end_of_a_fault_that_was_followed_is_found() -> None:
    """A position runs away for eight seconds and is right again: the fault is over, and what it has
    done to the filter is taken out."""
    times, samples, start = drive()
    del times
    rng = np.random.default_rng(3)
    made = KalmanEstimator(MODEL, IMU.gap_s, faults=table_of(KINDS))
    p = np.diag(INITIAL**2)
    p[9:, 9:] = 1e-16 * np.eye(MODEL.size - 9)
    made.initialise(0, 0, start.copy(), np.zeros(MODEL.size), p)
    buffer, over = buffer_of(samples), row_of("over")
    bank = made.hypotheses
    assert bank is not None
    for second in range(1, 28):
        t_ns = second * runs.SECOND
        made.propagate(buffer, t_ns)
        fault = "position_drift" if t_ns < 24 * runs.SECOND else ""
        for measurement in measurements(t_ns, rng, fault, np.array([1.5, 0.0, 0.0])):
            made.update(measurement)
        bank.judge(t_ns)
        likely = np.where(bank.explains, bank.log_odds, -np.inf).max(axis=1)
        if t_ns < 24 * runs.SECOND:
            assert likely[over] < 0.0, second
    assert int(np.argmax(likely)) == over, dict(zip(KINDS, likely, strict=True))
    found = bank.estimated(RESTARTS * over + int(np.argmax(bank.log_odds[over])))
    assert abs(found.size[0] - 1.0) < 4.0 * math.sqrt(found.covariance[0, 0])
    truth = runs.true_nav(runs.town_truth(30.0, IMU.rate_hz), np.array([27.0]))[0]
    before = np.abs(runs.nav_error(made.nav, truth)[6])
    made.adopt(found.mean, found.spread)
    after = np.abs(runs.nav_error(made.nav, truth)[6])
    assert after < 0.5 * before


def test_weights_are_a_distribution() -> None:
    made = run("velocity", np.array([0.3, 0.0, 0.0]))
    bank = made.hypotheses
    assert bank is not None
    bank.judge(LAST_NS)
    weights = bank.weights
    assert (weights >= 0.0).all()
    assert 0.0 < weights.sum() <= 1.0
    opened = bank.opened()
    assert np.allclose(opened, opened.T)
    assert np.linalg.eigvalsh(opened).min() > -1e-12


def test_two_faults_at_once_stay_open_though_none_explains_them() -> None:
    """A position and a velocity, each off by far more than the other's fault allows."""
    bank = run("both", np.array([60.0, 8.0, 0.0])).hypotheses
    assert bank is not None
    found = bank.judge(LAST_NS)
    assert not bank.explains[bank.log_odds > 0.0].any()
    assert bank.weights.sum() > 0.99
    assert not identified(found)


@pytest.mark.parametrize(("turn_deg", "explains"), [(30.0, True), (60.0, False)])
def test_a_turn_may_leave_what_its_rows_have_not(turn_deg: float, explains: bool) -> None:
    """Of a turn b, linear rows leave a quarter of b^2: no chance at 7 % of 10,000."""
    bank = run().hypotheses
    assert bank is not None
    row, turn = row_of("mount"), math.radians(turn_deg)
    at = group_at(bank.bank, RESTARTS * row + RESTARTS - 1)
    l_0 = 1e4 / turn**2
    bank.bank[at + L_ROWS[range(3), range(3)]] = l_0
    bank.bank[at + E_ROWS] = np.array([0.0, 0.0, turn]) * l_0
    bank.bank[at + J_AT], bank.bank[at + N_AT] = 1e4 * (1.0 + 0.24 * turn**2), 30.0
    bank.judge(LAST_NS)
    assert bank.explains[row, -1] == explains


def known(size_m: float, sd_m: float) -> tuple[Array, NDArray[np.bool_]]:
    """Log odds and fit of both sizes of a position's fault that is known so well."""
    bank = run().hypotheses
    assert bank is not None
    rows = [row for row, kind in enumerate(KINDS) if kind.name == "position"]
    assert [KINDS[row].sd[0] for row in rows] == [20.0, 2.0]
    for row in rows:
        at = group_at(bank.bank, RESTARTS * row + RESTARTS - 1)
        bank.bank[at + L_ROWS[range(3), range(3)]] = sd_m**-2.0
        bank.bank[at + E_ROWS] = np.array([size_m, 0.0, 0.0]) * sd_m**-2.0
        bank.bank[at + J_AT], bank.bank[at + N_AT] = (size_m / sd_m) ** 2, 300.0
    bank.judge(LAST_NS)
    return bank.log_odds[rows, -1], bank.explains[rows, -1]


def test_a_step_of_metres_is_open_before_it_can_be_told() -> None:
    """Of 2 m, known to half a metre: chi-square 18, of which nobody is accused."""
    odds, explains = known(2.0, 2.0 / math.sqrt(18.0))
    assert explains.all()
    assert odds[0] < -6.0
    assert -2.0 < odds[1] < 2.0


@pytest.mark.parametrize(("size_m", "sd_m"), [(0.3, 0.02), (20.0, 1.0)])
def test_a_step_of_another_size_is_none_of_metres(size_m: float, sd_m: float) -> None:
    """What is far smaller is what no model knows of a sound receiver."""
    _, explains = known(size_m, sd_m)
    assert explains.tolist() == [True, False]


def test_a_fault_that_may_last_begins_with_what_is_known() -> None:
    bank = run().hypotheses
    assert bank is not None
    for name, b, sd in (
        ("velocity", [0.2, -0.1, 0.0], [0.02, 0.03, 0.04]),
        ("position_drift", [2.0, 0.1, 0.0], [0.1, 0.1, 0.2]),
        ("delay", [0.9], [0.05]),
    ):
        row, since_s = row_of(name), LAST_NS * 1e-9 - 7.0
        bank.begin_lasting(LAST_NS, row, since_s, np.array(b), np.array(sd), math.log(0.1))
        [restart] = np.flatnonzero(np.abs(bank.log_odds[row] - math.log(0.1)) < 1e-9)
        assert restart >= RESTARTS - 2
        assert bank.explains[row, restart]
        found = bank.estimated(RESTARTS * row + int(restart))
        assert found.size == pytest.approx(b, abs=1e-6)
        assert np.sqrt(np.diagonal(found.covariance)) == pytest.approx(sd)
        assert found.onset_s == since_s
