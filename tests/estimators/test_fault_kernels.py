"""Kernels of the bank, eight groups side by side, against the same in plain matrices."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    BOUNDED,
    CLASS,
    COUNTS_BY,
    E_ROWS,
    HEAD,
    J_AT,
    KIND_INTS,
    KIND_NUMBERS,
    L_ROWS,
    LEVEL_OF,
    LOG_RATE,
    MEAN,
    N_AT,
    PATH,
    PERIODS_S,
    PHI,
    POINT,
    PRIOR,
    RESTARTS,
    RING,
    SIZE,
    WAITS,
    fault_table,
    turned_by,
)
from fusiond.estimators.fault_bank_interface import Hypotheses
from fusiond.estimators.fault_carried import mix, settle
from fusiond.estimators.fault_odds import LEAST_SQUARE, MOST_OF_UNIT, MOST_SQUARE
from fusiond.estimators.fault_update import _at_past, _past, walk_path
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.published_state import MOVING, moving, opened_variances
from fusiond.estimators.tilt_axes_rotation_after_update import turn_covariance
from fusiond.integrity.catalogue import kinds_of, table_of
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle_parameter_blocks import MOUNTING, mounting_block
from fusiond.navigation.rotation import quaternion_from_rpy
from tests.estimators.test_fault_bank import IMU, LAST_NS, MODEL, imu_noise, run

Array = NDArray[np.float64]


def faulty() -> tuple[KalmanEstimator, Hypotheses]:
    """A filter three seconds after its velocities have stepped, judged."""
    made = run("velocity", np.array([0.4, -0.2, 0.0]))
    assert made.hypotheses is not None
    made.hypotheses.judge(LAST_NS)
    return made, made.hypotheses


def matrices(bank: Hypotheses, number: int) -> tuple[Array, Array]:
    """L and e of a group."""
    row, restart = divmod(number, RESTARTS)
    size = int(bank.table.ints[row, SIZE])
    at = np.ix_(range(size), range(size))
    information = [[bank.each(int(f))[row, restart] for f in part] for part in L_ROWS]
    evidence = [bank.each(int(f))[row, restart] for f in E_ROWS[:size]]
    return np.array(information)[at] if size == 3 else np.array([[information[0][0]]]), np.array(
        evidence
    )


def test_odds_are_those_of_the_theory() -> None:
    """l / 2 - max(p log(N) / 2, log det(I + S L) / 2), or of a size that is known
    (e - L m)^T M (e - L m) / 2 - log det(I + S L) / 2 + e^T m - m^T L m / 2, and what is left of J
    against chi-square's."""
    _, bank = faulty()
    found, explains = bank.log_odds, bank.explains
    compared = 0
    for number in range(bank.table.groups):
        row, restart = divmod(number, RESTARTS)
        rows = bank.each(N_AT)[row, restart]
        if rows == 0.0:
            assert found[row, restart] == -math.inf
            continue
        size, numbers = int(bank.table.ints[row, SIZE]), bank.table.numbers[row]
        information, e = matrices(bank, number)
        s, mean = np.diag(numbers[PRIOR : PRIOR + size] ** 2), np.full(size, numbers[MEAN])
        m = np.linalg.inv(information + np.linalg.inv(s))
        left = e - information @ mean
        share = np.linalg.inv(information + 1e-9 * np.linalg.inv(s))
        unit = bool(bank.table.ints[row, CLASS] == 0)
        odds = numbers[LOG_RATE] + math.log(PERIODS_S[LEVEL_OF[restart]])
        odds += bank.each(COUNTS_BY)[row, restart]
        if numbers[BOUNDED]:
            odds += 0.5 * left @ m @ left + e @ mean - 0.5 * mean @ information @ mean
            odds -= 0.5 * np.linalg.slogdet(np.eye(size) + s @ information)[1]
        else:
            by_size = 0.5 * np.linalg.slogdet(np.eye(size) + s @ information)[1]
            by_rows, prior = 0.5 * size * math.log(rows), np.linalg.inv(s)
            gained = 0.5 * e @ share @ e - max(by_rows, by_size)
            most = size + 4.0 * math.sqrt(2.0 * (rows - size)) + rows - 2.0 * size
            fits = bank.each(J_AT)[row, restart] - e @ share @ e <= most
            if odds + gained > 0.0 and fits:
                share = np.linalg.inv(information + (1e-2 if unit else 1e-9) * prior)
                b = share @ e
                by_size += 0.5 * size * math.log(max(b @ prior @ b / size, 1.0))
                gained = 0.5 * e @ share @ e - max(by_rows, by_size)
            odds += gained
        assert found[row, restart] == pytest.approx(odds, abs=1e-6)
        degrees = max(rows - size, 1.0)
        most = degrees + 4.0 * math.sqrt(2.0 * degrees)
        unexplained = bank.each(J_AT)[row, restart] - e @ share @ e - most
        off = np.abs((share @ e if unit else m @ left) / numbers[PRIOR : PRIOR + size])
        other = bool(numbers[BOUNDED]) and (size == 1 and off[0] > 3.0)
        if numbers[BOUNDED] and size == 3 and odds > -40.0:
            other |= not LEAST_SQUARE <= off @ off <= MOST_SQUARE
        other |= unit and odds > 0.0 and off.max() > MOST_OF_UNIT
        assert explains[row, restart] == (unexplained <= 0.0 and not other)
        compared += 1
    assert compared > 100
    assert not explains.all()  # nor does the stepped velocity fit all that began before it


def test_what_is_published_is_wider_by_the_whole_mixture() -> None:
    made, bank = faulty()
    whole, wider = np.empty(9), np.empty(9)
    opened_variances(bank.opened(), made.step, whole)
    bank.widen(made.nav, made.step, -1, wider)
    assert whole.max() > 1e-4
    assert wider == pytest.approx(whole, rel=1e-12)


def test_what_is_published_by_the_receivers_clock_is_wider_by_what_a_fault_does_to_that() -> None:
    """p - v tau, v - a tau, phi + u tau, of a parameter that faults have moved."""
    made, bank = faulty()
    slot, motion, by = 13, np.empty(MOVING), np.zeros((9, MODEL.size))
    moving(made.nav, made.step, motion)
    by[:, :9] = np.eye(9)
    by[:, slot] = [*motion[6:9], *-motion[3:6], *-motion[:3]]
    whole, wider, plain = np.empty(9), np.empty(9), np.empty(9)
    opened_variances(by @ bank.opened_of_all() @ by.T, made.step, whole)
    bank.widen(made.nav, made.step, slot, wider)
    bank.widen(made.nav, made.step, -1, plain)
    assert wider == pytest.approx(whole, rel=1e-9)
    assert (wider / plain).max() > 1.01


def test_what_the_unit_has_been_found_to_have_turned_is_open() -> None:
    """All of it, and no more than chance of what the mounting has from the start; on a slope a turn
    about the vertical axis is one of roll, in a bank of pitch."""
    model = make_model("ins15", imu_noise(IMU), mounting_block(math.radians(5.0)))
    kinds = kinds_of(model, {"gnss": "gnss"}, slips=False)
    made = KalmanEstimator(model, IMU.gap_s, faults=table_of(kinds))
    tilted = quaternion_from_rpy(math.radians(10.0), math.radians(6.0), 0.3)
    nav = np.array([0.5, 2.0, 0.0, 20.0, 0.0, 0.0, *tilted])
    made.initialise(0, 0, nav, np.zeros(model.size), np.eye(model.size))
    yaw, turn = model.slots_of(MOUNTING)[1], math.radians(-10.0)
    mean = np.zeros(model.size)
    mean[yaw] = turn
    bank = made.hypotheses
    assert bank is not None
    made.xi[yaw] = turn
    bank.take(1, True, False, fused=False)
    assert made.wider.max() == 0.0  # two sigma of how it may sit
    made.xi[yaw] = 0.0
    made.adopt(mean, np.zeros((model.size, model.size)))
    bank.take(2, True, False, fused=False)
    roll, pitch = math.tan(math.radians(6.0)), math.sin(math.radians(10.0)) * math.cos(0.105)
    assert np.sqrt(made.wider[6:]) == pytest.approx([-turn * roll, -turn * pitch, -turn], rel=1e-2)
    made.initialise(3, 0, nav, np.zeros(model.size), np.eye(model.size))
    bank.take(3, True, False, fused=False)
    assert made.wider.max() == 0.0


def test_a_turn_is_what_is_decided_and_what_the_filter_finds_after_it() -> None:
    """A unit that turns by 10 deg, of which a decision finds 2, and that turns back later."""
    model = make_model("ins15", imu_noise(IMU), mounting_block(math.radians(5.0)))
    kinds = kinds_of(model, {"gnss": "gnss"}, slips=False)
    made = KalmanEstimator(model, IMU.gap_s, faults=table_of(kinds))
    nav, n = np.array([0.5, 2.0, 0.0, 20.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), model.size
    yaw, (tenth, two, six, eight, ten) = (
        model.slots_of(MOUNTING)[1],
        np.radians([0.1, 2.0, 6.0, 8.0, 10.0]).tolist(),
    )
    made.initialise(0, 0, nav, np.zeros(n), tenth**2 * np.eye(n))
    bank = made.hypotheses
    assert bank is not None
    assert turned_by(bank.bank, 1, eight) == 0.0  # as it may sit
    mean, spread = np.zeros(n), np.zeros((n, n))
    mean[yaw], spread[yaw, yaw] = two, six**2
    made.adopt(mean, spread)
    assert turned_by(bank.bank, 1, made.xi[yaw]) == pytest.approx(two)
    made.xi[yaw] += eight
    assert turned_by(bank.bank, 1, made.xi[yaw]) == pytest.approx(ten, rel=0.01)
    mean[yaw] = -ten
    made.adopt(mean, spread)
    assert turned_by(bank.bank, 1, made.xi[yaw]) == pytest.approx(0.0, abs=tenth)


def test_what_lies_between_two_measurements_is_multiplied_once() -> None:
    """V <- Phi V: rows that mix, that decay, and that stay."""
    _, bank = faulty()
    n, width = MODEL.size, MODEL.width
    rng = np.random.default_rng(3)
    phi = np.eye(width)
    phi[:9, :n] += rng.standard_normal((9, n)) * (rng.random((9, n)) < 0.5)
    phi[11, 11], phi[12, 13] = 0.9, 0.02
    at = int(bank.bank[PHI])
    bank.bank[at : at + width * width] = phi.ravel()
    bank.bank[WAITS] = 1.0
    expected = phi[:n, :n] @ bank.sensitivities
    settle(bank.bank, n)
    assert bank.sensitivities == pytest.approx(expected, rel=1e-5, abs=1e-6)  # single precision
    assert not bank.waits
    kept = bank.sensitivities.copy()
    settle(bank.bank, n)
    assert np.array_equal(kept, bank.sensitivities)


def test_what_turns_some_states_is_multiplied_by_those_alone() -> None:
    """V <- T V and P <- T P T^T, where T has rows and columns of some states alone, and of these
    not all are mixed."""
    made, bank = faulty()
    n, width = MODEL.size, MODEL.width
    rng = np.random.default_rng(5)
    slots = np.array([0, 1, 2, 14, 9, 11])
    t = np.eye(6) + rng.standard_normal((6, 6)) * (rng.random((6, 6)) < 0.5)
    t[2] = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    whole = np.eye(n)
    whole[np.ix_(slots, slots)] = t
    expected = whole @ bank.sensitivities
    cov = np.zeros((width, width))
    cov[:n, :n] = made.covariance
    mix(bank.bank, n, slots, t)
    turn_covariance(cov, slots, t)
    assert bank.sensitivities == pytest.approx(expected, rel=1e-5, abs=1e-6)  # single precision
    assert cov[:n, :n] == pytest.approx(whole @ made.covariance @ whole.T, rel=1e-9, abs=1e-12)
    assert np.array_equal(cov, cov.T)
    kept = bank.sensitivities.copy()
    mix(bank.bank, n, slots, np.eye(6))
    assert np.array_equal(kept, bank.sensitivities)


def test_the_path_is_known_for_six_seconds() -> None:
    """Linear between its points, from the first one that is kept; nothing before it."""
    bank, nav = np.zeros(HEAD + RING * POINT), np.zeros(10)
    rng = np.random.default_rng(4)
    times, places, place = [], [], 0.0
    now_s = 0.0
    for _ in range(900):
        step_s = float(rng.choice([0.005, 0.02, 0.07]))
        nav[3] = rng.normal()
        now_s += step_s
        walk_path(bank, nav, now_s, step_s)
        place += step_s * nav[3]
        if not times or now_s - times[-1] >= 0.1 - 1e-6:
            times.append(now_s)
            places.append(place)
    assert bank[PATH] == pytest.approx(place)
    kept_s, kept = np.array(times[-RING:]), np.array(places[-RING:])
    for t_s in rng.uniform(kept_s[0], kept_s[-1], 200).tolist():
        back = _past(bank, t_s)
        assert back > 0
        assert _at_past(bank, back, t_s, 0) == pytest.approx(np.interp(t_s, kept_s, kept))
    assert _past(bank, float(kept_s[0]) - 1e-3) == -1
    assert kept_s[-1] - kept_s[0] > 6.0


@pytest.mark.parametrize(
    ("sizes", "means"), [((1, 3), (0.0, 0.0)), ((2,), (0.0,)), ((3,), (1.0,)), ((4, 1), (0.0, 0.0))]
)
def test_a_table_that_the_kernels_cannot_read_is_refused(
    sizes: tuple[int, ...], means: tuple[float, ...]
) -> None:
    ints = np.zeros((len(sizes), KIND_INTS), dtype=np.int64)
    numbers = np.ones((len(sizes), KIND_NUMBERS))
    ints[:, SIZE], numbers[:, MEAN] = sizes, means
    with pytest.raises(ValueError, match="number"):
        fault_table(ints, numbers, ())
