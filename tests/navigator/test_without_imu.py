"""Navigation without an inertial unit: by fixes and a constant velocity, until the unit comes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.measurements import DelayedFix, MonotonicStamp, PositionFix
from fusiond.configuration.schema import Config
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.imu_screening import BEARABLE_GAP_S
from fusiond.navigator.navigator import Navigator
from tests import runs
from tests.navigator.vehicle import CONFIG, START_NS, drive

Array = NDArray[np.float64]

TICK_NS = 100_000_000
FIXES: dict[str, Any] = {"kind": "gnss", "bias_sd_m": 0.0, "time_offset_sd_s": 0.0}
ALONE: dict[str, Any] = {"aiding": {"gnss": {**FIXES, "lever_arm_sd_m": 0.0}}}


class Drive:
    """The drive of the other tests, ticked ten times a second; `imu_s`: when the unit sends."""

    def __init__(
        self, settings: dict[str, Any], *imu_s: tuple[float, float], lever: float = 0.0
    ) -> None:
        self.events: list[str] = []
        self.navigator = Navigator(
            Config.model_validate(settings), on_event=lambda code, text: self.events.append(code)
        )
        self.said: list[Solution] = []
        d = drive()
        t_s = (d.times - START_NS) * 1e-9
        sent = np.zeros(len(t_s), dtype=bool)
        for begin, end in imu_s:
            sent |= (t_s >= begin) & (t_s < end)
        row = following = 0
        fixes = [m for m in d.measurements if isinstance(m, PositionFix)]
        for now in range(START_NS + TICK_NS, int(d.times[-1]) + 1, TICK_NS):
            until = int(np.searchsorted(d.times, now, side="right"))
            rows = np.arange(row, until)[sent[row:until]]
            row = until
            if len(rows):
                self.navigator.add_imu(d.times[rows], d.samples[rows])
            while following < len(fixes) and fixes[following].t_seen_ns <= now:
                m = fixes[following]
                self.navigator.add(m, m.t_seen_ns, 0.0, m.t_seen_ns)
                following += 1
            self.navigator.tick(now)
            self.said.append(self.navigator.solution(now))

    def at(self, t_s: float) -> Solution:
        """What was said at `t_s` of the drive."""
        return self.said[round(t_s * 10) - 1]

    def errors(self, first_s: float, end_s: float) -> Array:
        """Position and velocity errors, horizontal, over their sigmas (m, 4)."""
        rows = []
        for s in self.said[round(first_s * 10) : round(end_s * 10)]:
            t = (s.t_ns - START_NS) * 1e-9
            # Samples of that drive end where their stamp says, a period after the truth's.
            true = drive().truth.at(np.array([t]))
            metres = runs.metres_per_unit(true.position[0, 0], true.position[0, 2])
            way = (np.array([s.lat_rad, s.lon_rad]) - true.position[0, :2]) * metres[:2]
            v = np.array(s.v_ned_m_s[:2]) - true.v_ned[0, :2]
            sd = np.array([*s.sd_ned_m[:2], *s.sd_v_ned_m_s[:2]])
            rows.append(np.concatenate([way, v]) / sd)
        return np.array(rows)


def test_it_navigates_by_fixes_and_says_that_nothing_tells_the_attitude() -> None:
    d = Drive(ALONE)
    before = d.at(9.0 + BEARABLE_GAP_S - 0.2)  # the first fix came at 9 s
    assert before.mode is Mode.WAITING
    assert math.isnan(before.lat_rad)
    assert d.events == ["without_imu"]
    for t_s in (15.0, 30.0, 40.0):
        s = d.at(t_s)
        assert s.mode is Mode.NAVIGATING
        assert s.reason == (
            "Waiting for IMU data; no inertial unit: constant velocity, no attitude"
        )
        assert all(math.isnan(x) for x in (*s.rpy_rad, *s.sd_rpy_rad, *s.gyro_bias_rad_s))
        assert 0.1 < s.sd_ned_m[0] < 3.0
        assert 0.1 < s.sd_v_ned_m_s[0] < 3.0
        assert s.height_m == pytest.approx(40.0, abs=10.0)
    errors = d.errors(13.0, 43.0)
    assert np.abs(errors).max() < 4.5
    assert 0.3 < np.mean(errors**2) < 1.4
    counts = d.navigator.outcomes()
    assert counts["gnss"]["fused"] > 25
    assert counts["gnss_velocity"]["fused"] > 25
    assert counts["gnss"]["no_alignment"] + counts["gnss"]["no_imu"] == 0
    assert d.navigator.outcome_watch.fused_ns["gnss"] > START_NS + 40 * runs.SECOND


def test_the_unit_is_taken_in_when_it_comes() -> None:
    d = Drive({**CONFIG, **ALONE, "alignment": {"heading": ["gnss_course"]}}, (20.0, 44.0))
    assert d.at(19.0).mode is Mode.NAVIGATING
    assert math.isnan(d.at(19.0).rpy_rad[2])
    assert d.events[0] == "without_imu"
    assert d.events.index("with_imu") > d.events.index("aligned")
    took = next(i for i, s in enumerate(d.said) if not math.isnan(s.rpy_rad[2]))
    # No hole in service from the first fix to the last.
    assert all(s.mode is Mode.NAVIGATING for s in d.said[130:took])
    assert d.said[took].reason == "Heading from GNSS course, on the move"
    assert not d.navigator.without_imu.active
    assert d.navigator.active_filter is d.navigator.estimator


def test_it_takes_over_from_a_unit_that_has_fallen_silent_for_too_long() -> None:
    d = Drive({**CONFIG, **ALONE}, (0.0, 20.0), (30.0, 44.0))
    assert not math.isnan(d.at(19.0).rpy_rad[2])
    # What navigation can bridge is bridged; then a fix is a start.
    assert d.at(21.5).mode is Mode.INVALID
    assert d.at(21.5).reason.startswith("IMU silent for")
    s = d.at(25.0)
    assert s.mode is Mode.NAVIGATING
    assert s.reason.startswith("IMU silent for 5.0 s; no inertial unit")
    assert math.isnan(s.rpy_rad[2])
    assert np.abs(d.errors(24.0, 30.0)).max() < 4.5
    assert d.events.count("without_imu") == 1
    ends = [s for s in d.said[300:] if s.mode is not Mode.NAVIGATING]
    assert not ends, ends[:1]


def test_an_inertial_unit_that_is_there_leaves_nothing_to_do() -> None:
    d = Drive({**CONFIG, **ALONE}, (0.0, 44.0))
    assert "without_imu" not in d.events
    assert d.navigator.without_imu.counted() == {}


def test_it_coasts_and_becomes_invalid_as_others_do() -> None:
    d = Drive({**ALONE, "estimator": {"coast_after_s": 3.0, "invalid_sd_m": 500.0}})
    navigator, now = d.navigator, d.said[-1].t_ns
    modes = []
    for _ in range(1200):
        now += TICK_NS
        navigator.tick(now)
        modes.append(navigator.solution(now).mode)
    assert list(dict.fromkeys(modes)) == [Mode.NAVIGATING, Mode.COASTING, Mode.INVALID]
    last = navigator.solution(now)
    assert last.sd_ned_m[0] > 300.0
    # It is not dead: the next fix is taken.
    fix = next(m for m in reversed(drive().measurements) if isinstance(m, PositionFix))
    later = replace(fix, t_seen_ns=now, stamp=MonotonicStamp(now))
    assert navigator.add(later, now, 0.0, now) == "accepted"
    navigator.tick(now + TICK_NS)
    assert navigator.solution(now + TICK_NS).mode is Mode.NAVIGATING


def _late_fixes(strategy: str, kind: str) -> tuple[Array, Array]:
    """Horizontal errors and their sigmas (m,) by an RDSS terminal alone, its fixes 1.5 s late."""
    aiding = {"kind": "rdss", "strategy": strategy, "fix_height_sd_m": 10.0, "bias_sd_m": 0}
    aiding |= {"noise": "class"}
    settings = {"estimator": {"filter": kind}, "aiding": {"rdss": aiding}}
    navigator = Navigator(Config.model_validate(settings))
    d, rng = drive(), np.random.default_rng(3)
    times = np.arange(1.0, 40.0, 1.5)
    waiting = [
        (t, p + rng.standard_normal(3) * 5.0 / runs.metres_per_unit(p[0], p[2]))
        for t, p in zip(times, d.truth.at(times).position, strict=True)
    ]
    errors, sigmas = [], []
    for now in range(START_NS, int(d.times[-1]) + 1, TICK_NS):
        while waiting and START_NS + round((waiting[0][0] + 1.5) * 1e9) <= now:
            t, p = waiting.pop(0)
            at = START_NS + round(t * 1e9)
            seen = at + 1_500_000_000
            fix = DelayedFix("rdss", seen, MonotonicStamp(at), *(float(x) for x in p), 5)
            navigator.add(fix, at, 0.0, seen)
        navigator.tick(now)
        s = navigator.solution(now)
        if s.mode is Mode.NAVIGATING and now > START_NS + 12 * runs.SECOND:
            true = d.truth.at(np.array([(now - START_NS) * 1e-9])).position[0]
            way = np.array([s.lat_rad, s.lon_rad]) - true[:2]
            errors.append(np.hypot(*way * runs.metres_per_unit(true[0], true[2])[:2]))
            sigmas.append(math.hypot(*s.sd_ned_m[:2]))
    assert navigator.outcomes()["rdss"]["fused"] > 20
    assert navigator.active_filter.isolates == (kind == "federated")
    return np.array(errors), np.array(sigmas)


@pytest.mark.parametrize("kind", ["kalman", "federated"])
def test_late_fixes_are_fused_at_their_instants(kind: str) -> None:
    """Rewound to, or predicted from, as paper 000 does; taken for new ones they lag by 1.5 s."""
    rewound, sigma = _late_fixes("rewind", kind)
    predicted, _ = _late_fixes("optimal_prediction", kind)
    as_new, _ = _late_fixes("none", kind)
    assert 0.2 < np.mean((rewound / sigma) ** 2) < 1.3
    assert np.sqrt(np.mean(predicted**2)) == pytest.approx(np.sqrt(np.mean(rewound**2)), rel=0.02)
    assert np.sqrt(np.mean(as_new**2)) > 1.05 * np.sqrt(np.mean(rewound**2))


def test_a_lever_arm_counts_by_its_upward_part_and_widens_sigma() -> None:
    near = Drive(ALONE)
    wide = Drive({"aiding": {"gnss": {**ALONE["aiding"]["gnss"], "lever_arm_m": [4.0, 3.0, -1.5]}}})
    a, b = near.at(30.0), wide.at(30.0)
    assert b.height_m - a.height_m == pytest.approx(-1.5, abs=0.2)
    assert b.sd_ned_m[0] > math.hypot(a.sd_ned_m[0], 5.0 / math.sqrt(2.0)) * 0.99
