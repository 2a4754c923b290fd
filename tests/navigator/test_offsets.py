"""An offset in time that has changed draws the filter along: its own estimates say so, those of one
that is only learned of do not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.models.model import Model
from fusiond.models.vehicle import TIME_WALK_S_SQRT_S, VELOCITY_TIME, time_offset
from fusiond.navigation.strapdown import VN
from fusiond.navigator.alignment.offsets import LOOK_NS, OffsetWatch

Array = NDArray[np.float64]
PRIOR_S, NOISE_S, LATE_S = 0.1, 0.5, 0.8
MODEL = Model("watched", (time_offset(VELOCITY_TIME, PRIOR_S),))
MOVING, STANDING = np.zeros(10), np.zeros(10)
MOVING[VN] = 10.0


class Filtered:
    """The estimate of an offset that walks as a clock does, one measurement a second."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self.true_s = float(self._rng.normal(0.0, PRIOR_S))
        self.x, self.p = 0.0, PRIOR_S**2

    def second(self) -> tuple[Array, Array]:
        """Parameters (n,) and P (n, n) a second later."""
        self.true_s += float(self._rng.normal(0.0, TIME_WALK_S_SQRT_S))
        self.p += TIME_WALK_S_SQRT_S**2
        gain = self.p / (self.p + NOISE_S**2)
        self.x += gain * (self.true_s + float(self._rng.normal(0.0, NOISE_S)) - self.x)
        self.p *= 1.0 - gain
        return np.full(MODEL.size, self.x), np.eye(MODEL.size) * self.p


def told_at(watch: OffsetWatch, late_s: float, seed: int, seconds: int) -> tuple[int, int]:
    """The second at which fixes that are later from second 100 on are suspected, and that at which
    it is no chance any more; `seconds` where they are not."""
    filtered = Filtered(seed)
    suspected = seconds
    for k in range(seconds):
        if k == 100:
            filtered.true_s -= late_s
        watch.look((k + 1) * LOOK_NS, MOVING, *filtered.second())
        if watch.suspects:
            suspected = min(k, suspected)
        if watch.changed:
            return suspected, k
    return suspected, seconds


def test_what_is_learned_of_a_constant_is_no_change() -> None:
    for seed in range(40):
        assert told_at(OffsetWatch(MODEL), 0.0, seed, 600) == (600, 600)


def test_fixes_that_become_late_are_suspected_and_told() -> None:
    told = [told_at(OffsetWatch(MODEL), LATE_S, seed, 300) for seed in range(40)]
    assert all(100 <= suspected <= changed < 300 for suspected, changed in told)
    # 0.8 s are beyond 4.9 sigma of a mean of ten of these and of what was known before.
    assert np.median([changed for _, changed in told]) <= 125


def test_an_offset_of_many_small_steps_is_none() -> None:
    """Innovations that are not quite white move an estimate by many sigmas of little."""
    watch = OffsetWatch(MODEL)
    for k in range(200):
        p = 0.01**2 / (1.0 + 1e-3 * k)
        x = 2e-5 * k  # twenty sigmas of what is learned in all
        watch.look((k + 1) * LOOK_NS, MOVING, np.full(MODEL.size, x), np.eye(MODEL.size) * p)
    assert not watch.suspects
    assert watch.changed is None


def test_what_is_learned_anew_after_a_doubt_is_no_change() -> None:
    """P was opened and is what it was: where the estimate goes is for what it has learned since."""
    p, opened = 0.03**2, 0.03**2 + PRIOR_S**2
    for late_s, told in ((0.04, False), (LATE_S, True)):
        watch, one = OffsetWatch(MODEL), np.eye(MODEL.size)
        for k in range(30):
            watch.look((k + 1) * LOOK_NS, MOVING, np.zeros(MODEL.size), one * p)
        watch.look(31 * LOOK_NS, MOVING, np.zeros(MODEL.size), one * opened)
        watch.look(32 * LOOK_NS, MOVING, np.full(MODEL.size, -late_s), one * 0.999 * p)
        assert (watch.changed is not None) == told


@pytest.mark.parametrize("late_s", [0.0, LATE_S])
def test_a_start_after_a_failure_is_not_vouched_for_before_it_excludes_late_fixes(
    late_s: float,
) -> None:
    vouched = []
    for seed in range(20):
        watch, filtered = OffsetWatch(MODEL), Filtered(seed)
        filtered.true_s -= late_s
        watch.look(LOOK_NS, STANDING, *filtered.second(), failed=True)
        assert not watch.suspects  # what does not move is where its late fixes say
        for k in range(1, 120):
            watch.look((k + 1) * LOOK_NS, MOVING, *filtered.second(), failed=True)
            if not watch.suspects:
                vouched.append(k)
                break
    if late_s:
        assert not vouched
    else:
        assert len(vouched) == 20
        assert 5 <= np.median(vouched) <= 60


def test_a_filter_without_offsets_is_left_alone() -> None:
    model = Model("without", ())
    watch = OffsetWatch(model)
    watch.look(LOOK_NS, MOVING, np.zeros(model.size), np.eye(model.size), failed=True)
    assert not watch.suspects
