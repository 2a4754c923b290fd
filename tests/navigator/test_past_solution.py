"""The solution at an instant before the newest sample: the filter's state at that very instant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fusiond.aiding.base import AidingMeasurement, NotApplicable, State
from fusiond.configuration.schema import Config
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.timeline import Entry
from tests.navigator.vehicle import CONFIG, STARTED_S, drive, feed, started, state_bytes

LAST = "~"
"""A source that comes after all others of its instant."""


class Look(AidingMeasurement):
    """Changes nothing; who hears of it sees the filter at its instant."""

    def innovation(self, state: State) -> NotApplicable:
        return NotApplicable("looked")


def driven(**callbacks: Any) -> Navigator:
    """A navigator at the end of the drive, where some measurements came 1.5 s late."""
    navigator, row = started(**callbacks)
    delays = [1.5 if i % 3 == 0 else 0.0 for i in range(len(drive().measurements))]
    feed(navigator, row, [7], delays)
    return navigator


def everything(navigator: Navigator) -> tuple[bytes, ...]:
    return *state_bytes(navigator), repr(navigator.timeline.counters).encode()


@pytest.mark.parametrize("back_ns", [3_000_000, 20_000_000, 777_777_777, 5_123_456_789])
def test_the_state_is_that_of_its_own_instant(back_ns: int) -> None:
    """Seen by a measurement that changes nothing and holds at that very instant; here with fixes
    and constraints between it and the newest sample, and between samples or at one."""
    seen: dict[str, Any] = {}

    def receive(entry: Entry) -> None:
        if entry.measurement.source == LAST:
            seen["nav"], seen["sd"] = navigator.estimator.nav.copy(), navigator.estimator.sigmas()

    navigator = driven(on_outcome=receive)
    t_ns = navigator.imu.latest_ns - back_ns
    solution = navigator.solution(t_ns)
    navigator.timeline.insert(Look(LAST, t_ns, 0.9999))
    navigator.advance()
    nav, sd = seen["nav"], seen["sd"]
    found = (solution.lat_rad, solution.lon_rad, solution.height_m, *solution.v_ned_m_s)
    sigmas = (*solution.sd_ned_m, *solution.sd_v_ned_m_s, *solution.sd_rpy_rad)
    assert solution.t_ns == t_ns
    assert np.array(found)[2:] == pytest.approx(nav[2:6], abs=1e-9)
    assert np.array(found)[:2] == pytest.approx(nav[:2], abs=1e-15)
    assert np.array(sigmas) == pytest.approx(sd, rel=1e-9)


def test_looking_back_leaves_no_trace() -> None:
    navigator = driven()
    before = everything(navigator)
    now = navigator.solution(navigator.imu.latest_ns)
    past = [navigator.solution(navigator.imu.latest_ns - k * 300_000_000) for k in range(1, 30)]
    assert everything(navigator) == before
    assert navigator.solution(navigator.imu.latest_ns) == now
    assert len({s.lat_rad for s in past}) == len(past), "each is of another instant"


def test_before_the_history_nothing_is_known() -> None:
    navigator = driven()
    for t_ns in (int(drive().times[round(STARTED_S)]), navigator.timeline.oldest_ns - 1):
        solution = navigator.solution(t_ns)
        assert solution.mode is Mode.INVALID
        assert np.isnan(solution.lat_rad)
        assert solution.reason == "Before the stored history"


def test_before_the_start_the_mode_says_what_is_missing() -> None:
    navigator = Navigator(Config.model_validate(CONFIG))
    navigator.add_imu(drive().times[:20], drive().samples[:20])
    navigator.advance()
    assert navigator.solution(int(drive().times[5])).mode is Mode.ALIGNING
