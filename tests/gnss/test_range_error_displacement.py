"""Displacement by a sky's geometry, and levels of satellites: against their equations in numpy."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from fusiond.gnss import range_kernel as rk
from fusiond.gnss.range_bias_filter import FORGOTTEN_S, RangeBiases, subtract_biases
from fusiond.gnss.range_error_displacement import (
    CLOCK_M,
    FLOOR_M,
    FREE_M,
    INCONSISTENT_M,
    PLACE_M,
    SHARED,
    Displacement,
    plausible,
    roots,
)
from fusiond.gnss.ranges import RangeModel, RangeOptions, Rows
from tests.gnss.test_corrections import sky, solved, store_of

T_S = 1.4e9


@lru_cache(maxsize=1)
def _whole() -> Rows:
    epoch, broadcast = sky()
    store = store_of(*broadcast)
    model = RangeModel(store, RangeOptions(systems=("G", "C")))
    return model.rows(epoch, solved(store, epoch).position)


def rows(keep: int | None = None) -> Rows:
    """Of the simulated sky, GPS and BeiDou, to be changed; of its first `keep` satellites."""
    n = len(_whole().satellites)
    return _whole().only(np.arange(n) < (n if keep is None else keep))


def gain(r: Rows, noise: Any, clock_m: float) -> Any:
    """G (3, n) by its equation."""
    n, v = len(noise), r.values
    a = np.zeros((n, 8))
    a[:, :3] = -np.column_stack([v[rk.NORTH], v[rk.EAST], -np.sin(v[rk.ELEVATION])])
    a[np.arange(n), 3 + r.clock] = 1.0
    a[:, 5:] = v[list(SHARED)].T
    prior = np.diag([1.0 / PLACE_M**2] * 3 + [1.0 / clock_m**2] * 2 + [1.0] * 3)
    return (np.linalg.inv(a.T @ (a / noise[:, None]) + prior) @ a.T / noise)[:3]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_roots_of_a_matrix(seed: int) -> None:
    a = np.random.default_rng(seed).normal(size=(3, 3)) * [[5.0], [1.0], [0.3]]
    out = np.empty((6, 3))
    roots(a @ a.T, out)
    assert out[:3] @ out[:3] == pytest.approx(a @ a.T, abs=1e-9)
    assert out[:3] == pytest.approx(out[:3].T, abs=1e-12)
    assert out[:3] @ out[3:] == pytest.approx(np.eye(3), abs=1e-6)


@pytest.mark.parametrize("keep", [None, 12, 3])
def test_root_is_that_of_the_errors_effect(keep: int | None) -> None:
    r = rows(keep)
    d = Displacement.of(r, T_S, r.lasting)
    g = gain(r, r.variance, FREE_M if keep != 3 else CLOCK_M)
    shared = g @ r.values[[rk.COMMON, rk.TROPOSPHERE_SIGMA]].T
    expected = (g * r.lasting) @ g.T + shared @ shared.T
    assert d.root @ d.root == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert d.effect[:, : len(r.satellites)] == pytest.approx(
        gain(r, r.lasting + FLOOR_M**2, CLOCK_M)
    )


def test_least_squares_with_a_clock_that_nothing_tells_err_by_it() -> None:
    """Drawn errors that last, solved of by the weights of an epoch: their scatter is K K^T."""
    r, rng = rows(12), np.random.default_rng(3)
    n, v = 12, r.values
    h = np.zeros((n, 5))
    h[:, :3] = -np.column_stack([v[rk.NORTH], v[rk.EAST], -np.sin(v[rk.ELEVATION])])
    h[np.arange(n), 3 + r.clock] = 1.0
    s = v[list(SHARED)].T
    w = np.linalg.inv(np.diag(r.variance) + s @ s.T)
    solve = np.linalg.inv(h.T @ w @ h) @ h.T @ w
    e = rng.normal(size=(20_000, n)) * np.sqrt(r.lasting)
    e += rng.normal(size=(20_000, 3)) * [1.0, 1.0, 0.0] @ s.T
    found = np.cov((e @ solve.T)[:, :3].T)
    d = Displacement.of(r, T_S, r.lasting)
    assert d.root @ d.root == pytest.approx(found, abs=0.07 * found.max())
    assert np.sqrt(np.diag(d.root @ d.root)) == pytest.approx(np.sqrt(np.diag(found)), rel=0.05)


def test_three_satellites_may_be_off_by_all_of_their_errors() -> None:
    """No redundancy: what u K t says of the ranges is as large as their own errors."""
    r = rows(3)
    u = -np.column_stack([r.values[rk.NORTH], r.values[rk.EAST], -np.sin(r.values[rk.ELEVATION])])
    d = Displacement.of(r, T_S, r.lasting)
    told = np.diag(u @ d.root @ d.root @ u.T)
    own = r.lasting + (r.values[[rk.COMMON, rk.TROPOSPHERE_SIGMA]] ** 2).sum(axis=0)
    assert (told > 0.5 * r.lasting).all()
    assert (told < 1.1 * own).all()
    many = Displacement.of(rows(), T_S, rows().lasting)
    assert np.linalg.det(many.root) < 0.5 * np.linalg.det(d.root)


def test_what_is_carried_from_sky_to_sky() -> None:
    r = rows()
    known = np.full(len(r.satellites), 0.01)
    before = Displacement.of(r, T_S, known)
    kept, new = Displacement.of(r, T_S + 60.0, known).carried(before)
    assert kept == pytest.approx(np.eye(3), abs=1e-9)
    assert new == pytest.approx(np.zeros((3, 3)), abs=1e-12)
    few = rows(3)
    now = Displacement.of(few, T_S + 60.0, known[:3], before)
    kept, new = now.carried(before)
    # The displacement itself is what it was, and more comes by what is not known of each range.
    assert now.root @ kept == pytest.approx(before.root, abs=1e-6)
    more = np.sqrt(np.diag(now.root @ new @ now.root))
    first = Displacement.of(r, T_S, r.lasting)
    fresh = Displacement.of(few, T_S + 60.0, few.lasting, first)
    _, unknown = fresh.carried(first)
    assert (more < 0.2 * np.sqrt(np.diag(fresh.root @ unknown @ fresh.root))).all()


def test_satellites_that_come_tell_anew() -> None:
    """Of levels that know nothing: what a sky is off by, and those before it and after, have the
    covariances of gains on errors that are each satellite's own and shared."""
    few, whole = rows(6), rows()
    before = Displacement.of(few, T_S, few.lasting)
    now = Displacement.of(whole, T_S + 60.0, whole.lasting, before)
    assert now.fresh == whole.satellites[6:]
    kept, new = now.carried(before)
    g, h = gain(few, few.variance, FREE_M), gain(whole, whole.variance, FREE_M)
    shared = [q.values[[rk.COMMON, rk.TROPOSPHERE_SIGMA]].T for q in (few, whole)]
    both = (h[:, :6] * few.lasting) @ g.T + (h @ shared[1]) @ (g @ shared[0]).T
    assert now.root @ kept @ before.root == pytest.approx(both, abs=1e-6)
    assert kept @ kept.T + new == pytest.approx(np.eye(3), abs=1e-6)
    # The same sky once more tells nothing more, nor one of which levels know all.
    again = Displacement.of(whole, T_S + 120.0, whole.lasting, now)
    assert again.fresh == ()
    assert again.carried(now)[0] == pytest.approx(np.eye(3), abs=1e-9)


def test_a_range_that_fits_no_other_displaces_nothing() -> None:
    r = rows()
    fits = np.empty(len(r.satellites), bool)
    assert plausible(r.values, r.clock, fits) == 0
    r.values[rk.CORRECTED, 2] += 2.0 * INCONSISTENT_M
    assert plausible(r.values, r.clock, fits) == 1
    assert np.flatnonzero(~fits).tolist() == [2]
    alone = rows(2)
    alone.values[rk.CORRECTED, 1] += 2.0 * INCONSISTENT_M
    assert plausible(alone.values, alone.clock, fits[:2]) == 0


def test_how_long_a_displacement_holds() -> None:
    r, few = rows(), rows(5)
    d = Displacement.of(r, T_S, r.lasting)
    assert d.holds(r, T_S + 29.0)
    assert not d.holds(r, T_S + 31.0)
    assert d.holds(few, T_S + 2.0)
    assert not d.holds(few, T_S + 4.0)
    assert not d.holds(r, T_S - 1.0)


# --------------------------------------------------------------------------- levels


def taught(levels: RangeBiases, z: Any, place: float = 1e-4) -> None:
    assert levels.seen == []
    levels.seen.append((z, np.full(len(z), place)))


def after(errors: Any, seconds: int, noise_m: float = 0.0) -> RangeBiases:
    """Levels of ranges that are off by `errors` (n,), a second apart; as of a filter that knows
    its place, and takes off what they say."""
    rng, last = np.random.default_rng(5), None
    for t in range(seconds):
        last = subtract_biases(last, rows(), T_S + t)
        left = errors - last.offset + noise_m * rng.standard_normal(len(errors))
        taught(last, -left)
    assert last is not None
    return last


def test_levels_are_what_satellites_are_off_by_beside_the_others() -> None:
    r = rows()
    errors = np.random.default_rng(1).normal(0.0, 1.0, len(r.satellites))
    found = after(errors, 600, 0.3)
    sd = np.sqrt(found.variance)
    assert (found.variance < 0.5 * r.lasting).all()
    apart = found.offset - errors
    for system in (0, 1):
        mine = r.clock == system
        assert np.abs(apart[mine] - apart[mine].mean()).max() < 3.0 * sd[mine].max()
    # It is off the ranges, and so is what was known of it of their variance.
    assert found.rows.pseudorange_m == pytest.approx(r.pseudorange_m - found.offset)
    assert found.rows.variance == pytest.approx(r.variance - r.lasting + found.variance)


def test_what_all_have_in_common_teaches_nothing() -> None:
    """It is the clock's."""
    found = after(np.full(len(rows().satellites), 2.0), 30)
    assert np.abs(found.offset).max() < 1e-9


def test_a_satellite_that_is_alone_or_far_off_teaches_nothing() -> None:
    r = rows()
    errors = np.zeros(len(r.satellites))
    errors[2] = 40.0
    found = after(errors, 30)
    assert found.offset[2] == 0.0
    last = subtract_biases(None, rows(1), T_S)
    taught(last, np.array([1.5]))
    then = subtract_biases(last, rows(1), T_S + 1.0)
    assert then.offset[0] == 0.0
    assert then.variance[0] == pytest.approx(r.lasting[0])


def test_one_far_off_keeps_no_other_from_being_told() -> None:
    """The mean that levels are beside is without it."""
    errors = np.random.default_rng(1).normal(0.0, 0.5, len(rows().satellites))
    with_it = errors.copy()
    with_it[2] = 40.0
    apart = np.delete(after(with_it, 60).offset - after(errors, 60).offset, 2)
    assert np.abs(apart).max() < 0.1
    assert np.abs(after(with_it, 60).offset).max() > 0.1


def test_levels_come_by_the_second_and_are_forgotten() -> None:
    found = after(np.linspace(-1.0, 1.0, len(rows().satellites)), 60)
    soon = subtract_biases(found, rows(), T_S + 59.2)
    assert soon.seen is None
    later = subtract_biases(found, rows(), T_S + 59.0 + FORGOTTEN_S - 1.0)
    assert later.offset == pytest.approx(soon.offset)
    assert (later.variance > soon.variance).all()
    gone = subtract_biases(found, rows(), T_S + 60.0 + FORGOTTEN_S)
    assert (gone.offset == 0.0).all()
    assert gone.variance == pytest.approx(rows().lasting)
    assert math.isclose(found.t_s, T_S + 59.0)
