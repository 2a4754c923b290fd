"""What the last two innovations of a velocity leave open before any mean of them does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.integrity.hedge import LATELY
from fusiond.integrity.lately import NOT_YET, SELDOM, Apart, Lately, Shown, goes_on, refused
from fusiond.integrity.means import LIKELY
from fusiond.navigation.error_model import DR, DV
from tests.integrity.series_bench import Bench, S

ONE, TWO = SELDOM**0.5, (0.5 * SELDOM) ** 0.5
SD = (0.05, 0.05, 0.08)


def after(lately: Lately, y: NDArray[np.float64]) -> Lately:
    return lately.and_then(tuple(y.tolist()), float(y @ y))


@pytest.mark.parametrize(
    ("before", "last", "seldom"),
    [
        (0.0, 0.99 * ONE, False),
        (0.0, 1.01 * ONE, True),
        (0.99 * TWO, 0.99 * TWO, False),
        (1.01 * TWO, 1.01 * TWO, True),
        (-1.2 * TWO, 1.2 * TWO, False),  # the two speak against each other
    ],
)
@pytest.mark.parametrize("axis", range(3))
def test_seldom_is_one_or_two_beyond_chance(
    before: float, last: float, seldom: bool, axis: int
) -> None:
    y = np.zeros((2, 3))
    y[:, axis] = before, last
    lately = after(NOT_YET, y[0])
    lately = after(lately, y[1])
    assert lately.seldom is seldom


def test_what_chance_does_once_in_a_thousand() -> None:
    """Of three components of the last and of the last two: six in a thousand at most."""
    lately, found = NOT_YET, 0
    drawn = np.random.default_rng(4).standard_normal((40_000, 3))
    for y in drawn:
        lately = after(lately, y)
        found += lately.seldom
    assert 4e-3 < found / len(drawn) < 6.5e-3


def test_both_horizontal_axes_are_open_by_the_larger_and_what_goes_with_them() -> None:
    p = np.diag([1e-6] * 3 + [0.03**2] * 3 + [0.2**2] * 3)
    p[DR, DV] = p[DV, DR] = 0.5 * 0.03 * 0.2
    lately = after(NOT_YET, np.array([4.0, 0.5, 0.2]))
    opened = lately.leaves_open(p, SD, 2.0)
    variance = 0.03**2 + (2.0 * 0.05) ** 2
    assert opened[3:5] == pytest.approx([(16.0 - LIKELY) * variance] * 2)
    assert opened[5] == 0.0
    regression = p[DR, DV] / p[DV, DV]
    assert opened[0] == pytest.approx(opened[3] * regression**2)
    y = np.array([3.0, 0.0, 0.0])
    # Of the mean of two, half the variance that chance gives it.
    of_two = after(after(NOT_YET, y), y).leaves_open(p, SD, 1.0)
    assert of_two[3] == pytest.approx((9.0 - 0.5 * LIKELY) * (0.03**2 + 0.05**2))


def test_a_velocity_leaves_it_open_until_the_next_that_fits() -> None:
    bench = Bench()
    bench.covariance = np.diag([1e-6] * 3 + [0.03**2] * 3 + [0.2**2] * 3)
    for t in range(30):
        bench.velocity(t)
    assert f"gnss_velocity{LATELY}" not in bench.isolation.hedge.wider
    kept = bench.isolation.snapshot()
    bench.velocity(30, 4.2)
    wider = bench.isolation.hedge.wider[f"gnss_velocity{LATELY}"]
    assert wider[3] == wider[4] > 0.1**2
    bench.isolation.restore(kept)
    assert f"gnss_velocity{LATELY}" not in bench.isolation.hedge.wider
    bench.velocity(30, 4.2)
    bench.velocity(31, -2.0)
    assert f"gnss_velocity{LATELY}" not in bench.isolation.hedge.wider


def test_one_that_is_refused_begins_anew() -> None:
    bench = Bench()
    bench.covariance = np.diag([1e-6] * 3 + [0.03**2] * 3 + [0.2**2] * 3)
    for t in range(30):
        bench.velocity(t)
    bench.velocity(30, 2.5)
    bench.velocity(31, 20.0)
    assert bench.isolation._records["gnss_velocity"].lately == NOT_YET


OPEN = np.full(9, 0.04)


def shown_each_second(count: int, y: float, mean: bool = False) -> Apart | None:
    """What so many innovations have left open, one a second from 1 s on."""
    apart = None
    for k in range(1, count + 1):
        apart = goes_on(apart, k * S, S, Shown(OPEN / k, (y, 0.0), mean))
    return apart


def test_what_some_in_a_row_have_shown_fades_as_long_as_it_lasted() -> None:
    apart = shown_each_second(3, 4.0)
    for after_s, share in ((0, 1.0), (2, 0.5), (6, 0.25), (37, 2.0 / 39.0)):
        apart = goes_on(apart, (3 + after_s) * S, S, None)
        assert apart is not None
        opened = apart.leaves_open((3 + after_s) * S)
        assert opened == pytest.approx(share * OPEN), after_s
    assert goes_on(apart, 42 * S, S, None) is None  # nineteen times two seconds


@pytest.mark.parametrize(("count", "y", "mean"), [(1, 9.0, False), (3, 3.1, False), (1, 0.0, True)])
def test_what_chance_does_and_a_single_one_are_over_with_the_next(
    count: int, y: float, mean: bool
) -> None:
    apart = shown_each_second(count, y, mean)
    assert apart is not None
    assert goes_on(apart, (count + 1) * S, S, None) is None


def test_a_mean_that_is_no_chance_fades_as_well() -> None:
    assert goes_on(shown_each_second(3, 0.0, mean=True), 4 * S, S, None) is not None


def test_what_comes_again_lasts_as_long_as_the_first() -> None:
    first = goes_on(shown_each_second(3, 4.0), 5 * S, S, None)
    apart = goes_on(first, 7 * S, S, Shown(OPEN, (3.5,)))
    assert apart is not None
    assert apart.leaves_open(9 * S) == pytest.approx(0.5 * OPEN)


def test_chance_once_in_twenty_keeps_nothing_open() -> None:
    apart = first = shown_each_second(3, 0.0, mean=True)
    for k in range(5, 25):
        apart = goes_on(apart, k * S, S, Shown(OPEN) if k % 2 else None)
    assert apart == first


def test_one_that_is_refused_is_the_first_of_those_that_follow() -> None:
    by = (0.3, -0.4)
    shown = refused(by, 25.0)
    assert shown.wider[3:5] == pytest.approx([0.25, 0.25])
    assert shown.whitened == pytest.approx((-3.0, 4.0))  # as innovations: computed minus measured
    apart = goes_on(goes_on(None, S, S, shown), 2 * S, S, Shown(OPEN, (-3.0, 2.0, 0.1)))
    assert apart is not None
    opened = apart.leaves_open(3 * S)
    assert opened is not None
    assert opened[3] == pytest.approx(0.5 * 0.25)


def test_a_velocity_that_the_filter_follows_stays_open() -> None:
    bench = Bench()
    bench.covariance = np.diag([1e-6] * 3 + [0.03**2] * 3 + [0.2**2] * 3)
    for t in range(30):
        bench.velocity(t)
    for t, bias in ((30, 3.8), (31, 4.2), (32, 2.6)):
        bench.velocity(t, bias)
    name = f"gnss_velocity{LATELY}"
    then = bench.isolation.hedge.wider[name][3]
    for t in range(33, 40):
        bench.velocity(t, -0.5)
    assert 0.2 * then < bench.isolation.hedge.wider[name][3] < 0.5 * then
    for t in range(40, 100):
        bench.velocity(t)
    assert bench.isolation.hedge.wider[name][3] < 0.1 * then


def test_a_position_that_the_filter_follows_stays_open() -> None:
    """A step that a filter takes for its own within some seconds: once in ten thousand is none."""
    opened = {}
    for step in (1.0, 3.0):
        bench = Bench(white=True)
        bench.covariance = np.diag([1e-6] * 3 + [0.03**2] * 3 + [0.2**2] * 3)
        for t in range(30):
            bench.both(range(t, t + 1))
        for t in range(30, 60):
            bench.fix(t, step * math.exp(-(t - 30) / 8.0))
            bench.velocity(t)
        assert not bench.isolation.excluded
        opened[step] = bench.isolation.hedge.wider.get(f"gnss{LATELY}", np.zeros(9))[0]
    assert opened[3.0] > 0.3
    assert opened[1.0] < 0.1 * opened[3.0]


def test_a_position_that_was_silent_is_judged_anew() -> None:
    bench = Bench()
    bench.covariance = np.diag([1e-6] * 3 + [0.03**2] * 3 + [0.2**2] * 3)
    for t in range(60):
        bench.fix(t, 5.0 * math.exp(-(t - 30) / 8.0) if t >= 30 else 0.0)
        bench.velocity(t)
    assert f"gnss{LATELY}" in bench.isolation.hedge.wider
    bench.fix(70)
    assert f"gnss{LATELY}" not in bench.isolation.hedge.wider
