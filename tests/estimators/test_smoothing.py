"""The smoother: exact against another form of it, honest sigma, and a filter that is unchanged."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement, Linearised
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.base import Outcome
from fusiond.estimators.published_state import Published
from fusiond.estimators.smoothing.backward import Smoother
from fusiond.estimators.smoothing.node_recorder import NEVER, TapedKalman, nodes_of
from fusiond.estimators.tilt_frame_after_heading_update import TiltAxesFilter
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import ANTENNA_LEVER, antenna_lever_block
from fusiond.navigation.imu_buffer import ImuBuffer
from tests.estimators import smoothed_drive, town_drive
from tests.estimators.monte_carlo import interval
from tests.estimators.screened_ranges import ranges
from tests.estimators.smoothed_drive import OUTAGE_S

Array = NDArray[np.float64]

RUNS = 12
INSTANTS_S = (20.0, 45.0, 60.0, 80.0)  # two of them in the outage


@pytest.mark.parametrize("unknown", [False, True], ids=["ins21", "vehicle"])
def test_smoothed_sigma_is_honest(unknown: bool) -> None:
    """NEES over the runs is chi-square at each instant, and no sigma is above the filter's."""
    groups = {
        "attitude": slice(0, 3),
        "velocity": slice(3, 6),
        "position": slice(6, 9),
        "all": slice(0, 9),
    }
    nees = {name: np.zeros((RUNS, len(INSTANTS_S))) for name in groups}
    for k in range(RUNS):
        tape = smoothed_drive.run(300 + k, unknown)
        for at, t_s in enumerate(INSTANTS_S):
            error, p, filtered = tape.at(t_s)
            sd = np.sqrt(np.diag(filtered))
            less = (filtered - p) / np.outer(sd, sd)
            assert np.linalg.eigvalsh(less).min() > -1e-9
            for name, s in groups.items():
                nees[name][k, at] = error[s] @ np.linalg.solve(p[s, s], error[s])
    assert OUTAGE_S[0] < INSTANTS_S[1] < INSTANTS_S[2] < OUTAGE_S[1]
    probability = 1.0 - 0.01 / (len(groups) * len(INSTANTS_S))
    failures = []
    for name, s in groups.items():
        degrees = RUNS * (s.stop - s.start)
        low, high = interval(degrees, probability)
        for t_s, total in zip(INSTANTS_S, nees[name].sum(axis=0), strict=True):
            print(
                f"{name:9s} t={t_s:3.0f} s  NEES per degree {total / degrees:.3f} "
                f"[{low / degrees:.3f}, {high / degrees:.3f}]"
            )
            if not low <= total <= high:
                failures.append((name, t_s, total / degrees))
    assert not failures


class Logging(TapedKalman):
    """Keeps of each node, in full: P before and after its rows, and the transition to it."""

    def __init__(self, model: Model, gap_s: float) -> None:
        self.log: list[tuple[Array, Array, Array]] = []
        self.prior = np.zeros((model.size, model.size))
        super().__init__(model, gap_s)

    def _close(self) -> None:
        n = self.model.size
        after = self.covariance.copy()
        self.log.append((self.prior if self._ops else after, after, self._phi[:n, :n].copy()))
        super()._close()
        self.prior = self.covariance.copy()  # of what follows at the same instant

    def propagate(self, imu: ImuBuffer, target_ns: int, record: bool = False) -> None:
        super().propagate(imu, target_ns, record)
        self.prior = self.covariance.copy()

    def _carry_over(self, before: Array) -> None:
        super()._carry_over(before)
        self.prior = self.covariance.copy()

    def _fold_in(self, measurement: Linearised, noise: Array) -> Outcome:
        offsets = self.model.slots_of("clock_offset")
        outcome = super()._fold_in(measurement, noise)
        if offsets and self._phi[offsets[0]].any() == 0:  # the clock started anew
            self.prior = self._before[: self.model.size, : self.model.size].copy()
        return outcome


def _rauch_tung_striebel(
    log: list[tuple[Array, Array, Array]], kept: Array, fed_back: Array
) -> tuple[Array, Array]:
    """Smoothed errors (m, n) after the nodes and their covariances, with inverses of P; `kept` and
    `fed_back` (m, n)."""
    error, p = kept[-1].copy(), log[-1][1]
    errors, covariances = [error], [p]
    for j in range(len(log) - 2, -1, -1):
        prior, _, phi = log[j + 1]
        after = log[j][1]
        sd = np.sqrt(np.diag(prior))
        gain = np.linalg.solve(prior / np.outer(sd, sd), (phi @ after) / sd[:, None]).T / sd
        error = kept[j] + gain @ (error + fed_back[j + 1] - phi @ kept[j])
        p = after + gain @ (p - prior) @ gain.T
        errors.append(error)
        covariances.append(p)
    return np.array(errors[::-1]), np.array(covariances[::-1])


@pytest.mark.parametrize(
    "kind", ["fixes", "robust", "poor heading", "lever arm", "clock that jumps"]
)
def test_agrees_with_the_form_that_inverts_covariances(kind: str) -> None:
    """Bryson-Frazier against Rauch-Tung-Striebel, written with dense matrices."""
    jumps = kind == "clock that jumps"
    name = "ins23" if jumps else "ins21"
    _, buffer, measurements, start, _ = town_drive.drive()
    if jumps:
        measurements = ranges(measurements, jump_at=20)
    if kind == "robust":
        measurements = [
            [replace(cast("AidingMeasurement", measurement), robust=True) for measurement in epoch]
            for epoch in measurements
        ]
    unknown = []
    if kind == "lever arm":
        measurements = [
            [
                replace(cast("AidingMeasurement", measurement), rest=ANTENNA_LEVER)
                for measurement in epoch
            ]
            for epoch in measurements
        ]
        unknown = [antenna_lever_block(ANTENNA_LEVER, 1.0)]
    model = make_model(name, imu_noise(town_drive.IMU), *unknown)
    estimator = Logging(model, town_drive.IMU.gap_s)
    sd = model.initial.copy()
    yaw_deg = 4.0 if kind == "poor heading" else 2.0
    sd[:9] = np.r_[np.radians([0.3, 0.3, yaw_deg]), [0.2] * 3, [3.0] * 3]
    estimator.initialise(0, 0, start, np.zeros(model.size), np.diag(sd**2))
    town_drive.run(estimator, buffer, measurements)
    estimator.propagate(buffer, measurements[-1][0].t_ns + 100_000_000)
    assert estimator.newest is not None
    nodes, _ = nodes_of(estimator.newest, None, NEVER)
    estimator.end()
    smoothed = Smoother(model, Published(model.time_slot)).back(nodes)
    count = len(nodes.t_ns)
    n = model.size
    fed_back, row = np.zeros((count, n)), 0
    for j, rows in enumerate(nodes.counts):
        for op in nodes.ops[row : row + rows]:
            fed_back[j] += op[n : 2 * n] * op[-1]
        row += rows
    errors, covariances = _rauch_tung_striebel(
        estimator.log[:count], np.zeros((count, n)), fed_back
    )
    assert count > 100
    scale = np.sqrt(np.array([np.diag(p)[:9] for p in covariances]))
    assert np.abs((smoothed.error[:, :9] - errors[:, :9]) / scale).max() < 1e-4
    off = smoothed.covariance[:, :9, :9] - covariances[:, :9, :9]
    assert np.abs(off / (scale[:, :, None] * scale[:, None, :])).max() < 1e-4


def test_a_tape_changes_nothing() -> None:
    """The filter with a tape is the one without, to the bit, though it stops at more instants."""
    model, buffer, measurements, start, sd = town_drive.drive()
    plain = TiltAxesFilter(model, town_drive.IMU.gap_s)
    taped = TapedKalman(model, town_drive.IMU.gap_s)
    for estimator in (plain, taped):
        town_drive.begun(estimator, start, sd)
        town_drive.run(estimator, buffer, measurements)
    assert np.array_equal(plain.nav, taped.nav)
    assert np.array_equal(plain.xi, taped.xi)
    assert np.array_equal(plain.covariance, taped.covariance)


def test_what_came_late_leaves_the_same_tape() -> None:
    late = smoothed_drive.run(7, True)
    in_order = smoothed_drive.run(7, True, in_order=True)
    for a, b in zip(late.nodes, in_order.nodes, strict=True):
        assert np.array_equal(a, b)


def test_feedback_that_is_held_back_smooths_to_the_same() -> None:
    """Estimating along a trajectory that is not corrected differs by what is not linear."""
    held, at_once = smoothed_drive.run(8, True, holding=True), smoothed_drive.run(8, True)
    for t_s in INSTANTS_S:
        (error, p, _), (other, _, _) = held.at(t_s), at_once.at(t_s)
        assert np.abs((error - other) / np.sqrt(np.diag(p))).max() < 0.1
