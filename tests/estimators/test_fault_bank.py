"""The bank: its sensitivities are those of the filter, its evidence is chi-square, a rewind keeps
its bits."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.body_velocity import NonHolonomicConstraint
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.settings import imu_noise
from fusiond.estimators.fault_bank import (
    E_AT,
    E_ROWS,
    J_AT,
    L_AT,
    L_ROWS,
    LEVEL_OF,
    N_AT,
    ONSET,
    RESTARTS,
    group_at,
)
from fusiond.estimators.fault_odds import APART, solve
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.integrity.catalogue import Kind, kinds_of, table_of
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle import FIX_TIME, VELOCITY_TIME, time_offset
from fusiond.navigation.imu_buffer import ImuBuffer
from tests import runs

Array = NDArray[np.float64]

IMU = Imu(rate_hz=50.0)
MODEL = make_model("ins15", imu_noise(IMU))
KINDS = kinds_of(MODEL, {"gnss": "gnss"}, slips=False)
FIRST_NS, LAST_NS = 16 * runs.SECOND, 19 * runs.SECOND
"""An onset at which the second level begins anew, and an instant before it does again."""
RESTART = LEVEL_OF.index(1)
SD_M, SD_M_S = 1.5, 0.1
INITIAL = runs.initial_sd(MODEL, np.radians([0.5, 0.5, 2.0]), 0.3, 2.0)


def row_of(name: str) -> int:
    return next(row for row, kind in enumerate(KINDS) if kind.name == name)


@lru_cache(maxsize=1)
def drive() -> tuple[Array, Array, Array]:
    """Instants, samples without errors of the unit, and the true start."""
    truth = runs.town_truth(30.0, IMU.rate_hz)
    samples = np.hstack([truth.gyro, truth.accel])
    return runs.sample_times(truth), samples, runs.true_nav(truth, np.zeros(1))[0]


def buffer_of(samples: Array) -> ImuBuffer:
    return runs.filled_buffer(IMU, drive()[0], samples)


def measurements(
    t_ns: int, rng: np.random.Generator, fault: str, b: Array
) -> list[PositionMeasurement | VelocityMeasurement]:
    """A fix and its velocity, with a fault of that size from `FIRST_NS` on."""
    truth = runs.town_truth(30.0, IMU.rate_hz)
    states = truth.at(np.array([t_ns * 1e-9]))
    since_s = (t_ns - FIRST_NS) * 1e-9 if t_ns >= FIRST_NS else -1.0
    place, speed = rng.standard_normal(3) * SD_M, rng.standard_normal(3) * SD_M_S
    if since_s >= 0.0:
        place += b * {"position": 1.0, "position_drift": since_s}.get(fault, 0.0)
        speed += b * {"velocity": 1.0, "velocity_drift": since_s}.get(fault, 0.0)
    lat, lon, up = states.position[0] + np.array([1.0, 1.0, -1.0]) * place * np.abs(
        1.0 / runs.metres(states.position[0, 0], states.position[0, 2])
    )
    v = tuple((states.v_ned[0] + speed).tolist())
    lever, gate = (0.0, 0.0, 0.0), 1.0 - 1e-12
    return [
        PositionMeasurement("gnss", t_ns, gate, lat, lon, up, (SD_M,) * 3, lever),
        VelocityMeasurement("gnss_velocity", t_ns, gate, v, (SD_M_S,) * 3, lever),
    ]


def run(
    fault: str = "", b: Array | None = None, seed: int = 1, until_ns: int = LAST_NS
) -> KalmanEstimator:
    """The filter, with its bank, after that."""
    times, samples, start = drive()
    size = np.zeros(3) if b is None else b
    samples = samples.copy()
    columns = {"gyro": slice(0, 3), "accelerometer": slice(3, 6)}.get(fault)
    if columns is not None:
        samples[times > FIRST_NS, columns] += size
    rng = np.random.default_rng(seed)
    noise = imu_noise(IMU)
    densities = (noise.rate_noise, noise.force_noise)
    for half, density in enumerate(densities):
        spread = density * math.sqrt(IMU.rate_hz)
        samples[:, 3 * half : 3 * half + 3] += spread * rng.standard_normal((len(samples), 3))
    buffer = buffer_of(samples)
    made = KalmanEstimator(MODEL, IMU.gap_s, faults=table_of(KINDS))
    draw = INITIAL[:9] * rng.standard_normal(9)
    p = np.diag(INITIAL**2)
    p[9:, 9:] = 1e-16 * np.eye(MODEL.size - 9)  # biases are known
    made.initialise(0, 0, runs.with_error(start, draw), np.zeros(MODEL.size), p)
    for second in range(1, until_ns // runs.SECOND + 1):
        t_ns = second * runs.SECOND
        made.propagate(buffer, t_ns)
        for measurement in measurements(t_ns, rng, fault, size):
            assert made.update(measurement).name in ("fused", "gated")
    return made


def error_of(one: KalmanEstimator, other: KalmanEstimator) -> Array:
    """Of the first against the second, in the error state's navigation slots."""
    return runs.nav_error(one.nav, other.nav)


@pytest.mark.parametrize(
    ("fault", "size"),
    [
        ("gyro", (1e-4, -2e-4, 3e-4)),
        ("accelerometer", (2e-3, 1e-3, -3e-3)),
        ("position", (0.03, -0.02, 0.04)),
        ("position_drift", (0.01, 0.02, -0.01)),
        ("velocity", (0.002, -0.003, 0.001)),
        ("velocity_drift", (0.001, 0.002, -0.001)),
    ],
)
def test_the_filter_is_off_by_v_b(fault: str, size: tuple[float, ...]) -> None:
    """Against the same run without the fault."""
    b = np.array(size)
    faulty, sound = run(fault, b), run()
    bank = sound.hypotheses
    assert bank is not None
    row = row_of(fault)
    expected = (bank.effect(RESTARTS * row + RESTART) @ b)[:9]
    found = error_of(faulty, sound)
    assert np.abs(expected).max() > 1e-6
    for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
        scale = max(np.abs(expected[part]).max(), 1e-9)
        assert np.abs(found[part] - expected[part]).max() < 0.02 * scale + 1e-9, part


def test_what_is_carried_off_runs_away_at_the_velocity_that_it_adds() -> None:
    """V of a device that is carried off is the sum of those of its position's drift and its
    velocity's offset, of one onset."""
    bank = run().hypotheses
    assert bank is not None
    rows = [row_of(name) for name in ("carried_off", "position_drift", "velocity")]
    for restart in range(RESTARTS):
        onsets = {float(bank.each(ONSET)[row, restart]) for row in rows}
        assert len(onsets) == 1
        both, drift, offset = (bank.effect(RESTARTS * row + restart) for row in rows)
        scale = np.abs(drift) + np.abs(offset)
        assert np.abs(both - drift - offset).max() < 1e-5 * scale.max()


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


def test_the_quiet_of_a_constraint_hides_no_misfit() -> None:
    """A hypothesis is judged by what is left of the rows that come; rows that always show less than
    their sigma allows, as those of a vehicle that does not slip, show what they do."""
    made = run()
    bank = made.hypotheses
    assert bank is not None
    left = []
    for second in range(20, 60):
        row = NonHolonomicConstraint(
            "non_holonomic", made.t_ns, 1.0 - 1e-12, 50.0, 50.0, 0.0, (0.0, 0.0, 0.0)
        )
        for _ in range(50):
            made.update(row)
        bank.judge(second * runs.SECOND)
        left.append(float((bank.each(J_AT) - bank.each(N_AT)).min()))
    # Of 4,000 rows it would be so much; the first thousand teach what they show.
    assert left[-1] > -1500.0
    assert left[-1] - left[-10] > -60.0


def test_a_constraint_is_a_witness_where_it_is_alone() -> None:
    """Not beside a receiver of one fix a second; a gyro that steps as all aids go was believed
    until they came back."""
    made = run()
    bank, rng = made.hypotheses, np.random.default_rng(1)
    assert bank is not None
    fix = measurements(LAST_NS, rng, "", np.zeros(3))[0]

    def no_slip(after_s: float, used: bool = True) -> bool:
        t_ns = LAST_NS + round(after_s * runs.SECOND)
        row = NonHolonomicConstraint("non_holonomic", t_ns, 0.9999, 0.1, 0.1, 0.0, (0.0, 0.0, 0.0))
        return bank.is_evidence(row, used)

    assert bank.is_evidence(fix, used=True)
    assert not bank.is_evidence(fix, used=False)
    assert not no_slip(1.2)
    assert no_slip(2.5)
    assert not no_slip(2.5, used=False)
    bank.is_evidence(fix, used=False)
    assert no_slip(2.5)


def test_what_returns_to_service_begins_anew() -> None:
    """Its own hypotheses, not those of the inertial unit."""
    made = run("position", np.array([20.0, 0.0, 0.0]))
    bank, t_ns = made.hypotheses, LAST_NS
    assert bank is not None
    bank.judge(t_ns)
    unit = bank.log_odds[row_of("gyro")].copy()
    position = measurements(t_ns, np.random.default_rng(1), "", np.zeros(3))[0]
    bank.begin_again(position, made.nav, made.step)
    bank.judge(t_ns)
    assert np.array_equal(bank.log_odds[row_of("gyro")], unit)
    for name in ("position", "position_drift", "delay", "carried_off"):
        assert (bank.log_odds[row_of(name)] == -np.inf).all()
    assert (bank.log_odds[row_of("velocity")] > -np.inf).any()


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


def test_a_snapshot_keeps_the_bank_to_the_bit() -> None:
    """Going on from a snapshot is going on."""
    _, samples, start = drive()
    buffer = buffer_of(samples)
    rng = np.random.default_rng(7)
    made = KalmanEstimator(MODEL, IMU.gap_s, faults=table_of(KINDS))
    made.initialise(0, 0, start.copy(), np.zeros(MODEL.size), np.diag(INITIAL**2))
    given = {
        second: measurements(second * runs.SECOND, rng, "", np.zeros(3)) for second in range(1, 21)
    }

    def go(first: int, last: int) -> Array:
        for second in range(first, last + 1):
            made.propagate(buffer, second * runs.SECOND)
            for measurement in given[second]:
                made.update(measurement)
        bank = made.hypotheses
        assert bank is not None
        bank.judge(made.t_ns)
        return bank.bank.copy()

    go(1, 12)
    kept = made.snapshot()
    once = go(13, 20)
    made.restore(kept)
    assert np.array_equal(go(13, 20), once, equal_nan=True)


def test_a_look_in_passing_leaves_the_bank_as_it_is() -> None:
    """What is asked between two measurements changes nothing of what comes later."""
    _, samples, start = drive()
    buffer = buffer_of(samples)
    found = []
    for asked in (False, True):
        rng = np.random.default_rng(8)
        made = KalmanEstimator(MODEL, IMU.gap_s, faults=table_of(KINDS))
        made.initialise(0, 0, start.copy(), np.zeros(MODEL.size), np.diag(INITIAL**2))
        for second in range(1, 13):
            t_ns = second * runs.SECOND
            if asked:
                made.propagate(buffer, t_ns - 340_000_000, passing=True)
                made.sigmas()
            made.propagate(buffer, t_ns)
            for measurement in measurements(t_ns, rng, "", np.zeros(3)):
                made.update(measurement)
        assert made.hypotheses is not None
        found.append(made.hypotheses.bank.copy())
    assert np.array_equal(*found, equal_nan=True)


def test_each_kind_says_what_it_is() -> None:
    """Names, units and priors of the whole catalogue."""
    everything = {
        "a": "gnss",
        "b": "rdss",
        "c": "wheel",
        "d": "compass",
        "e": "height",
    }
    kinds: list[Kind] = kinds_of(MODEL, everything, slips=True)
    assert len({(k.name, k.device, k.lag_s) for k in kinds}) == len(kinds)
    for kind in kinds:
        assert kind.text
        assert kind.unit
        assert 0 < kind.size <= 3
        assert min(kind.sd) > 0.0
        assert kind.per_hour > 0.0
    table = table_of(kinds)
    assert table.groups == RESTARTS * len(kinds)
    assert table.threes == RESTARTS * sum(kind.size == 3 for kind in kinds)


def test_a_solution_that_lags_with_its_fixes_is_off_by_v_tau() -> None:
    """Fixes that are stamped too late from the start on, against ones that are not."""
    tau_s = 0.02
    blocks = (time_offset(FIX_TIME, 0.1), time_offset(VELOCITY_TIME, 0.1))
    model = make_model("ins15", imu_noise(IMU), *blocks)
    kinds = kinds_of(model, {"gnss": "gnss"}, slips=False)
    truth = runs.town_truth(30.0, IMU.rate_hz)
    _, samples, start = drive()
    found = []
    for late_s in (0.0, tau_s):
        made = KalmanEstimator(model, IMU.gap_s, faults=table_of(kinds))
        sd = runs.initial_sd(model, np.radians([0.5, 0.5, 2.0]), 0.3, 2.0)
        p = np.diag(sd**2)
        p[9:, 9:] = 1e-16 * np.eye(model.size - 9)
        made.initialise(0, 0, start.copy(), np.zeros(model.size), p)
        buffer = buffer_of(samples)
        for second in range(1, LAST_NS // runs.SECOND + 1):
            t_ns = second * runs.SECOND
            made.propagate(buffer, t_ns)
            states = truth.at(np.array([second - late_s]))
            lat, lon, up = (float(x) for x in states.position[0])
            v = tuple(states.v_ned[0].tolist())
            lever, gate = (0.0, 0.0, 0.0), 1.0 - 1e-12
            made.update(
                PositionMeasurement(
                    *("gnss", t_ns, gate, lat, lon, up, (0.1,) * 3, lever), time=FIX_TIME
                )
            )
            made.update(
                VelocityMeasurement(
                    "gnss_velocity", t_ns, gate, v, (0.01,) * 3, lever, VELOCITY_TIME
                )
            )
        found.append(made)
    sound, late = found
    bank = sound.hypotheses
    assert bank is not None
    row = next(k for k, kind in enumerate(kinds) if kind.name == "late")
    expected = bank.effect(RESTARTS * row + RESTART)[:9, 0] * tau_s
    apart = error_of(late, sound)
    for part in (slice(3, 6), slice(6, 9)):
        scale = np.abs(expected[part]).max()
        assert scale > 1e-3
        # The velocity's own lag is a hundredth of the noise that it is told with.
        least = 0.002 if part.start == 3 else 0.0
        assert np.abs(apart[part] - expected[part]).max() < 0.15 * scale + least, part
