"""Bad samples of the IMU cost a gap, not the truth; what costs too much ends the navigation."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.configuration.schema import Config
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from tests import runs
from tests.navigator.vehicle import CONFIG, RATE_HZ, drive, started, state_bytes

Array = NDArray[np.float64]
Alter = Callable[[NDArray[np.int64], Array], None]
TURN_S = 17.0  # amid the first bend


class _Told:
    """A navigator, fed to the end of the drive but for what `alter` does, and its events."""

    def __init__(
        self,
        alter: Alter | None = None,
        lost_s: tuple[float, float] = (0, 0),
        settings: dict[str, Any] = CONFIG,
    ) -> None:
        d = drive()
        self.events: list[str] = []
        self.modes: list[Mode] = []
        self.texts: list[str] = []
        navigator, row = started(settings, on_event=self._receive)
        self.navigator = navigator
        times, samples = d.times.copy(), d.samples.copy()
        if alter is not None:
            alter(times, samples)
        t_s = (d.times - d.times[0]) * 1e-9
        kept = (t_s < lost_s[0]) | (t_s >= lost_s[1])
        self.worst_sigmas = 0.0
        for first in range(row, len(times), 5):
            rows = np.arange(first, min(first + 5, len(times)))
            now = int(d.times[rows[-1]])
            navigator.add_imu(times[rows[kept[rows]]], samples[rows[kept[rows]]])
            for m in d.measurements:
                if d.times[first] - 20_000_000 < m.t_seen_ns <= now:
                    navigator.add(m, m.t_seen_ns, 0.0, m.t_seen_ns)
            navigator.advance()
            self.modes.append(navigator.mode(now)[0])
            self.texts.append(navigator.mode(now)[1])
            if self.modes[-1] is Mode.NAVIGATING:
                self.worst_sigmas = max(self.worst_sigmas, self._sigmas())

    def _receive(self, code: str, text: str) -> None:
        self.events.append(code)

    def _sigmas(self) -> float:
        """The largest error of position, velocity and attitude over its own sigma."""
        e = self.navigator.estimator
        t_s = (e.t_ns - int(drive().times[0])) * 1e-9 + 1.0 / RATE_HZ
        true = runs.true_nav(drive().truth, np.array([t_s]))[0]
        sd = np.sqrt(np.diag(e.covariance)[:9])
        return float((np.abs(runs.nav_error(e.nav, true)) / sd).max())


def _row(t_s: float) -> int:
    return round(t_s * RATE_HZ)


def test_one_sample_leaves_no_trace_but_its_own_absence() -> None:
    def spike(times: NDArray[np.int64], samples: Array) -> None:
        samples[_row(TURN_S), 2] = 99.0

    with_spike = _Told(spike)
    without = _Told(lost_s=(TURN_S, TURN_S + 1.0 / RATE_HZ))
    assert with_spike.events == ["aligned", "imu_spike", "imu_sound"]
    assert without.events == ["aligned"]
    assert with_spike.navigator.imu.counters == {"spike": 1}
    assert state_bytes(with_spike.navigator) == state_bytes(without.navigator)


def test_one_stamp_ahead_keeps_the_filter() -> None:
    def ahead(times: NDArray[np.int64], samples: Array) -> None:
        times[_row(TURN_S)] += 700_000_000

    told = _Told(ahead)
    without = _Told(lost_s=(TURN_S, TURN_S + 1.0 / RATE_HZ))
    assert told.events == ["aligned", "imu_stamp_ahead", "imu_sound"]
    assert told.navigator.imu.counters == {"stamp_ahead": 1}
    assert state_bytes(told.navigator) == state_bytes(without.navigator)


@pytest.mark.parametrize("value", [math.nan, 90.0])
def test_a_second_of_nonsense_in_a_bend(value: float) -> None:
    def nonsense(times: NDArray[np.int64], samples: Array) -> None:
        samples[_row(TURN_S) : _row(TURN_S + 1.0), :3] = value

    told = _Told(nonsense)
    name = "not_finite" if math.isnan(value) else "spike"
    assert told.events[:2] == ["aligned", f"imu_{name}"]
    assert told.events.count("imu_sound") == len(told.events) - 1 - told.events.count("imu_sound")
    assert told.navigator.started is not None
    assert Mode.INVALID in told.modes
    assert any("IMU silent for" in text and ": " in text for text in told.texts)
    assert told.worst_sigmas < 5.0


@pytest.mark.parametrize("lost_s", [0.1, 0.3, 0.45, 2.0])
def test_what_is_lost_widens_by_what_a_vehicle_may_do(lost_s: float) -> None:
    """Below `gap_s`, too: yaw by 0.1 rad/s, and no mode but `navigating` where it is short."""
    told = _Told(lost_s=(TURN_S, TURN_S + lost_s))
    assert told.events == ["aligned"]
    assert told.worst_sigmas < 5.0
    assert (Mode.INVALID in told.modes) == (lost_s > 0.5)


def test_a_short_loss_reaches_the_covariance() -> None:
    sigmas = []
    for lost in (0, 2, 15):
        navigator, row = started()
        d = drive()
        stop = row + 20
        navigator.add_imu(d.times[row:stop], d.samples[row:stop])
        then = slice(stop + lost, stop + lost + 2)
        navigator.add_imu(d.times[then], d.samples[then])
        navigator.advance()
        sigmas.append(float(navigator.estimator.sigmas()[8]))
    assert sigmas[1] == pytest.approx(sigmas[0], rel=1e-3)
    grown = math.sqrt(sigmas[2] ** 2 - sigmas[0] ** 2)
    assert grown == pytest.approx(0.1 * 16 / RATE_HZ, rel=0.05)


def test_a_gap_longer_than_the_motion_allows_aligns_anew_on_the_move() -> None:
    alignment = {**CONFIG["alignment"], "heading": ["config", "gnss_course"]}
    told = _Told(lost_s=(TURN_S, TURN_S + 5.0), settings={**CONFIG, "alignment": alignment})
    assert told.events == ["aligned", "imu_gap", "aligned"]
    assert Mode.INVALID in told.modes
    assert told.modes[-1] is Mode.NAVIGATING
    assert told.worst_sigmas < 5.0


def test_stamps_that_run_back_for_long_are_told_once() -> None:
    d = drive()
    events: list[str] = []
    navigator, row = started(on_event=lambda code, text: events.append(code))
    for first in range(row, row + 600, 10):
        rows = slice(first, first + 10)
        navigator.add_imu(2 * d.times[row] - d.times[rows], d.samples[rows])
        navigator.advance()
    assert events == ["aligned", "imu_time"]
    assert navigator.started is None


def test_a_dead_axis_ends_navigation_until_it_lives() -> None:
    def dead(times: NDArray[np.int64], samples: Array) -> None:
        samples[_row(12.0) : _row(20.0), 2] = 0.0

    told = _Told(dead)
    assert told.events[:3] == ["aligned", "imu_axis_dead", "imu_gap"]
    while_dead = told.modes[_row(14.5 - 8.0) // 5 : _row(19.5 - 8.0) // 5]
    assert set(while_dead) <= {Mode.ALIGNING, Mode.WAITING}
    assert any("one axis stands still" in text for text in told.texts)
    assert "imu_sound" in told.events


def test_before_the_start_any_gap_begins_anew() -> None:
    """What an alignment has collected before a gap does not tell where the vehicle is after it."""
    d = drive()
    config = Config.model_validate({**CONFIG, "alignment": {"heading": ["gnss_course"]}})
    events: list[str] = []
    navigator = Navigator(config, on_event=lambda code, text: events.append(code))
    navigator.add_imu(d.times[:100], d.samples[:100])
    navigator.advance()
    late = d.times[100:200] + runs.SECOND
    navigator.add_imu(late, d.samples[100:200])
    navigator.advance()
    assert events == ["imu_gap"]
    assert navigator.imu.oldest_ns == late[0]
    assert navigator.mode(int(late[-1]))[0] is Mode.ALIGNING


def _stamped(off_s: float) -> tuple[list[str], list[Mode]]:
    """Events and modes of a drive whose samples are stamped by so much too late, from a bend on for
    eight seconds."""

    def off(times: NDArray[np.int64], samples: Array) -> None:
        times[_row(TURN_S) : _row(TURN_S + 8.0)] += round(off_s * runs.SECOND)

    alignment = {**CONFIG["alignment"], "heading": ["config", "gnss_course"]}
    told = _Told(off, settings={**CONFIG, "alignment": alignment})
    return told.events, told.modes[_row(TURN_S + 2.5 - 8.0) // 5 : _row(TURN_S + 8.0 - 8.0) // 5]


def test_no_sample_is_of_an_instant_that_has_not_come() -> None:
    """Stamps ahead of what arrives with them: what is made of these is of no use until it ends."""
    events, modes = _stamped(0.5)
    assert events[:2] == ["aligned", "imu_time"]
    assert events.count("aligned") == 2
    assert not {Mode.NAVIGATING, Mode.COASTING} & {*modes}


def test_nothing_starts_by_samples_that_are_too_old_to_navigate_by() -> None:
    """Stamps that have gone back, while they are older than a silent unit's."""
    events, modes = _stamped(-0.9)
    assert events[:2] == ["aligned", "imu_time"]
    assert events.count("aligned") == 2
    assert set(modes) <= {Mode.WAITING, Mode.ALIGNING}


def test_a_daemon_of_one_tick_a_second_starts() -> None:
    """What has arrived since the last tick is younger than the samples of that tick."""
    d, told = drive(), list[str]()
    alignment = {**CONFIG["alignment"], "heading": ["gnss_course"]}
    config = Config.model_validate({**CONFIG, "alignment": alignment})
    navigator = Navigator(config, on_event=lambda code, _: told.append(code))
    second, behind = round(RATE_HZ), int(d.times[0])
    for first in range(second // 4, 40 * second, second):  # fixes come three quarters after a tick
        rows = slice(first, first + second)
        now = int(d.times[rows][-1])
        for m in d.measurements:
            if behind < m.t_seen_ns <= now:
                navigator.add(m, m.t_seen_ns, 0.0, m.t_seen_ns)
        navigator.add_imu(d.times[rows], d.samples[rows])
        navigator.advance()
        behind = now
    assert "aligned" in told
