"""The fault bank: its sensitivities are those of the filter, and a rewind keeps its bits."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.aiding.body_velocity import NonHolonomicConstraint
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.fault_bank import J_AT, N_AT, ONSET, RESTARTS
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.integrity.catalogue import Kind, kinds_of, table_of
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle_parameter_blocks import FIX_TIME, VELOCITY_TIME, time_offset_block
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
    error_of,
    measurements,
    row_of,
    run,
)


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
    assert len({(k.name, k.device, k.lag_s, k.sd) for k in kinds}) == len(kinds)
    for kind in kinds:
        assert kind.text
        assert kind.unit
        assert 0 < kind.size <= 3
        assert min(kind.sd) > 0.0
        assert kind.per_hour > 0.0
    table = table_of(kinds)
    assert table.groups == RESTARTS * len(kinds)
    assert table.threes == RESTARTS * sum(kind.size == 3 for kind in kinds)


def test_what_all_receivers_do_is_none_of_another_device() -> None:
    """RDSS has a line of its own: its fixes go on when those of all receivers are left out."""
    devices = {"gnss": "gnss", "second": "gnss", "rdss": "rdss"}
    together = [k for k in kinds_of(MODEL, devices, slips=False) if k.devices]
    assert {k.name for k in together} == {"carried_off", "delay"}
    for kind in together:
        spoiled = [device for device in devices if kind.spoils(device, locates=True, moves=True)]
        assert spoiled == ["gnss", "second"]


def test_a_solution_that_lags_with_its_fixes_is_off_by_v_tau() -> None:
    """Fixes that are stamped too late from the start on, against ones that are not."""
    tau_s = 0.02
    blocks = (time_offset_block(FIX_TIME, 0.1), time_offset_block(VELOCITY_TIME, 0.1))
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
