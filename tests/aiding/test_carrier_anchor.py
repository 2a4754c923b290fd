"""Carriers from an anchor: the clone, rows against vectors in ECEF axes, and which serve."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding import carrier_anchor as an
from fusiond.aiding import carrier_anchor_noise as noise
from fusiond.aiding.base import Innovation, Renewal, State
from fusiond.aiding.pseudorange import PseudorangeMeasurement, epoch_values, nothing_left
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.models.blocks import (
    CARRIER_ANCHOR,
    CARRIER_CLOCK,
    ClockNoise,
    carrier_blocks,
    clock_blocks,
)
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.rotation import dcm_from_quaternion
from fusiond.navigation.strapdown import STEP_SIZE
from tests import runs
from tests.aiding.test_pseudorange import LEVER, RPY, VELOCITY, _ecef, _satellites

Array = NDArray[np.float64]

LATER_S, SIGMA_M = 4.0, 0.003
MOVED = np.array([3e-6, -2e-6, 4.0])
"""Latitude, longitude (rad), height (m) meanwhile."""


def model(name: str = "ins15") -> Model:
    clock = ClockNoise()
    blocks = *clock_blocks(("G",), clock), *carrier_blocks(clock)
    return make_model(name, imu_noise(Imu()), *blocks)


def antenna(nav: Array) -> Array:
    place, axes = _ecef(nav)
    found: Array = place + axes @ dcm_from_quaternion(nav[6:]) @ LEVER
    return found


def sights(nav: Array, satellites: Array) -> Array:
    """H (n, 4)."""
    away = satellites - antenna(nav)
    units = away / np.linalg.norm(away, axis=1)[:, None]
    return np.column_stack([-units, -np.ones(len(away))])


def places() -> tuple[Array, Array]:
    """Navigation states (10,) at the anchor and later."""
    first = runs.level_nav(RPY, VELOCITY)
    then = runs.level_nav((RPY[0] + 0.1, RPY[1], RPY[2] - 0.7), VELOCITY)
    then[:3] = first[:3] + MOVED
    return first, then


def carriers(nav: Array, satellites: Array, clock_m: float) -> Array:
    """As long as the way is, but for a constant each."""
    constants = 1e6 * np.arange(1.0, 1.0 + len(satellites))
    found: Array = np.linalg.norm(satellites - antenna(nav), axis=1) + clock_m + constants
    return found


def measurement(
    t_s: float, satellites: Array, length: Array, before: Array, span: float = 1.0
) -> PseudorangeMeasurement:
    n = len(satellites)
    nothing, one = np.full(n, np.nan), np.ones(n)
    values = epoch_values(satellites, np.zeros_like(satellites), nothing, 0.0 * one, one, one)
    values[an.SPAN], values[an.CARRIER], values[an.CARRIER_VARIANCE] = span, length, SIGMA_M**2
    values[an.WALK], values[an.SLOT] = 0.002, np.arange(1.0, n + 1.0)
    names = tuple(f"G{k + 1:02d}" for k in range(n))
    zeros = np.zeros(n, np.int64)
    return PseudorangeMeasurement(
        "raw", round(t_s * 1e9), 0.9999, names, values, zeros, LEVER, before=before
    )


def state(of: Model, nav: Array, xi: Array | None = None) -> State:
    return State(nav, np.zeros(of.size) if xi is None else xi, np.zeros(STEP_SIZE), of)


def begun(of: Model, nav: Array, satellites: Array, clock_m: float = 5.0) -> tuple[Array, Array]:
    """Parameters (n,) after an anchor epoch at 1 s, and what it leaves."""
    first = measurement(1.0, satellites, carriers(nav, satellites, clock_m), nothing_left())
    found = first.leaves(state(of, nav), ())
    assert found is not None
    assert found.estimate is not None
    xi = np.zeros(of.size)
    xi[of.slots_of_all(found.blocks)] = found.estimate
    return xi, first.left


def rows(of: Model, nav: Array, xi: Array, epoch: PseudorangeMeasurement) -> Innovation:
    found = epoch.innovation(state(of, nav, xi))
    assert isinstance(found, Innovation)
    return found


def test_a_clone_errs_as_the_antenna_s_place_does() -> None:
    of, (nav, _) = model(), places()
    satellites, _ = _satellites(nav)
    first = measurement(1.0, satellites, carriers(nav, satellites, 0.0), nothing_left())
    for k in range(9):
        size = 10.0 if k >= 6 else 1e-3
        error = np.zeros(9)
        error[k] = size
        off = runs.with_error(nav, error)
        found = first.leaves(state(of, off), ())
        assert found is not None
        assert found.estimate is not None
        assert found.of_navigation is not None
        assert found.estimate[:3] == pytest.approx(antenna(off), abs=1e-6)
        true_minus_estimated = antenna(nav) - antenna(off)
        expected = found.of_navigation[:3] @ error
        assert true_minus_estimated == pytest.approx(expected, abs=1e-4 if k >= 6 else 2e-6), k
        assert not found.of_navigation[3].any()  # its clock begins
        assert not found.kept.any()


def test_what_phases_add_is_what_least_squares_make_of_them() -> None:
    of, (nav, _) = model(), places()
    satellites, _ = _satellites(nav)
    first = measurement(1.0, satellites, carriers(nav, satellites, 0.0), nothing_left())
    found = first.leaves(state(of, nav), ())
    assert isinstance(found, Renewal)
    h = sights(nav, satellites)
    expected = SIGMA_M**2 * np.linalg.inv(h.T @ h) + noise.FLOOR_M**2 * np.eye(4)
    assert found.new == pytest.approx(expected, rel=1e-3)
    # of two satellites not more than the phases' own
    two = measurement(1.0, satellites[:2], carriers(nav, satellites, 0.0)[:2], nothing_left())
    few = two.leaves(state(of, nav), ())
    assert few is not None
    assert np.linalg.eigvalsh(few.new)[-1] < 2.0 * SIGMA_M**2 + noise.FLOOR_M**2


def test_a_clone_walks_by_what_satellites_drift() -> None:
    """As least squares by the phases' weights make a place of it: once a second, in between not."""
    of, (nav, _) = model(), places()
    satellites, _ = _satellites(nav)
    length = carriers(nav, satellites, 5.0)
    xi, before = begun(of, nav, satellites)
    weights, h = np.array([1.0, 0.5, 1.0, 2.0, 1.0]) / SIGMA_M**2, sights(nav, satellites)
    normal = h.T @ (weights[:, None] * h)
    gain = np.linalg.solve(normal + np.eye(4), h.T * weights)
    for t_s, walked_s in ((1.5, None), (2.0, 1.0), (2.5, None), (4.0, 2.0)):
        now = measurement(t_s, satellites, length, before)
        now.values[an.CARRIER_VARIANCE] = 1.0 / weights
        found = now.leaves(state(of, nav, xi), ())
        assert (found is None) == (walked_s is None), t_s
        if found is not None and walked_s is not None:
            walked = noise.DRIFT_M_SQRT_S**2 * walked_s * gain @ gain.T
            assert found.new == pytest.approx(noise.OF_ANCHOR * walked, rel=1e-6)
            assert found.with_navigation is not None
            of_place, shared = found.with_navigation
            place = (1.0 - noise.OF_ANCHOR) * walked[:3, :3]
            assert shared[:3, :3] == pytest.approx(place, rel=1e-6)
            assert (found.kept == np.eye(4)).all()
            # What the place walks by with the clone is no way since the anchor.
            h_now = rows(of, nav, xi, now).h
            seen = h_now[:, :9] @ of_place[:, :3] + h_now[:, of.slots_of(CARRIER_ANCHOR)]
            assert np.abs(h_now[:, 6:9]).max() > 0.5
            assert np.abs(seen).max() < 1e-4
            assert found.of_navigation is None
            assert found.estimate is None
        before = now.left


def test_carriers_are_the_way_since_the_anchor() -> None:
    """Of moved satellites and a clock that has gone by 7.5 m; a unit in the last place of 2.5e7 m
    is 4e-9."""
    of, (nav, then) = model(), places()
    satellites, _ = _satellites(nav)
    xi, left = begun(of, nav, satellites)
    now = satellites + np.array([3e3, -2e3, 1e3])
    xi[of.slots_of(CARRIER_CLOCK)] = 7.5
    later = measurement(1.0 + LATER_S, now, carriers(then, now, 12.5), left)
    z, _, r = rows(of, then, xi, later)
    assert z == pytest.approx(0.0, abs=5e-8)
    h = sights(nav, satellites)
    leverage = np.einsum("ij,jk,ik->i", h, np.linalg.inv(h.T @ h), h)
    assert r == pytest.approx(SIGMA_M**2 * (2.0 - leverage) + 0.002**2, rel=1e-3)
    assert [what for _, what in later.labels] == ["carrier"] * 5


@pytest.mark.parametrize("name", ["ins15", "ins23", "planar15"])
def test_jacobian(name: str) -> None:
    of, (nav, then) = model(name), places()
    if of.hold_height:
        nav[5] = then[5] = 0.0
    satellites, _ = _satellites(nav)
    xi, left = begun(of, nav, satellites)
    later = measurement(1.0 + LATER_S, satellites, carriers(then, satellites, 5.0), left)
    h = rows(of, then, xi, later).h
    for k in np.flatnonzero(of.active):
        size = 10.0 if 6 <= k < 9 or k in of.slots_of(CARRIER_ANCHOR) else 1e-3
        ends = []
        for sign in (1.0, -1.0):
            error = np.zeros(of.size)
            error[k] = sign * size
            off = runs.with_error(then, error[:9])
            ends.append(rows(of, off, xi - np.r_[np.zeros(9), error[9:]], later).z)
        numeric = (ends[0] - ends[1]) / (2.0 * size)
        assert numeric == pytest.approx(h[:, k], abs=1e-5), k
    assert not h[:, ~of.active].any()


def test_which_serve() -> None:
    """Followed at each epoch, with one ephemeris; others wait for the next anchor."""
    of, (nav, _) = model(), places()
    satellites, _ = _satellites(nav)
    length = carriers(nav, satellites, 5.0)
    xi, left = begun(of, nav, satellites)

    def then(t_s: float, before: Array) -> PseudorangeMeasurement:
        return measurement(t_s, satellites, length, before)

    slipped = then(1.5, left)
    slipped.values[an.SPAN, 0], slipped.values[an.ISSUE, 1] = 0.0, 3.0
    slipped.values[an.CARRIER, 2] = math.nan
    assert [what for _, what in slipped.labels] == ["rate"] * 3 + ["carrier"] * 2
    # two carriers are too few: a new anchor at once, with all that are there
    assert slipped.leaves(state(of, nav, xi), ()) is not None
    assert [what for _, what in then(1.75, slipped.left).labels].count("carrier") == 3

    refused = then(1.5, left)
    assert refused.leaves(state(of, nav, xi), (0, 2, 0, 0, 0)) is None
    waits = then(1.75, refused.left)
    assert [what for _, what in waits.labels] == ["carrier", "rate", *["carrier"] * 3]
    assert waits.leaves(state(of, nav, xi), ()) is None
    late = then(1.0 + an.WAITS_S, waits.left)
    assert late.leaves(state(of, nav, xi), ()) is not None
    assert [what for _, what in then(2.25, late.left).labels] == ["carrier"] * 5

    # of one that was gone for an epoch nobody knows what it did
    without = then(1.5, left).only([True, True, True, True, False])
    assert without.leaves(state(of, nav, xi), ()) is None
    assert [what for _, what in then(1.75, without.left).labels][4] == "rate"


def test_an_anchor_grows_old_and_belongs_to_a_start() -> None:
    of, (nav, _) = model(), places()
    satellites, _ = _satellites(nav)
    length = carriers(nav, satellites, 5.0)
    xi, left = begun(of, nav, satellites)
    old = measurement(1.0 + an.LONGEST_S, satellites, length, left)
    assert [what for _, what in old.labels] == ["carrier"] * 5  # it tells the whole way
    assert old.leaves(state(of, nav, xi), ()) is not None
    # of another start: without a clone the Dopplers serve, and there is a new anchor
    other = measurement(1.5, satellites, length, left)
    assert (rows(of, nav, np.zeros(of.size), other).r == 1.0).all()
    assert other.leaves(state(of, nav), ()) is not None


@pytest.mark.parametrize("sigma_m", [0.0015, 0.006])
def test_noise_and_constants_are_learned(sigma_m: float) -> None:
    """Of phases half and twice as noisy as the model has them, beside 12 satellites; and the rows
    of an epoch have the noise that they have."""
    of, (nav, _) = model(), places()
    rng = np.random.default_rng(5)
    away = rng.normal(size=(12, 3)) + 2.0 * antenna(nav) / np.linalg.norm(antenna(nav))
    satellites = antenna(nav) + 2.5e7 * away / np.linalg.norm(away, axis=1)[:, None]
    length = carriers(nav, satellites, 5.0)

    def noisy() -> Array:
        found: Array = length + rng.normal(0.0, sigma_m, 12)
        return found

    squares, xi, before = [], np.zeros(of.size), nothing_left()
    for epoch in range(400):
        now = measurement(0.1 * epoch, satellites, noisy(), before, 0.1)
        now.values[an.WALK] = 0.0
        if epoch % 40 > 1:
            z, _, r = rows(of, nav, xi, now)
            left_out = sights(nav, satellites)
            part = np.eye(12) - left_out @ np.linalg.pinv(left_out)
            squares.append(float((part @ z) ** 2 @ (1.0 / (r * np.diag(part)))) / 12.0)
        found = now.leaves(state(of, nav, np.zeros(of.size) if epoch % 40 == 0 else xi), ())
        anchor = found is not None and found.estimate is not None
        assert anchor == (epoch % 40 == 0)
        if found is not None and found.estimate is not None:
            xi = np.zeros(of.size)
            xi[of.slots_of_all(found.blocks)] = found.estimate
        before = now.left
    assert an.phase_scale(before) == pytest.approx((sigma_m / SIGMA_M) ** 2, rel=0.15)
    assert np.mean(squares[len(squares) // 2 :]) == pytest.approx(1.0, abs=0.15)
