"""Protection levels of the navigator: what nav says, and what an operator hears."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.measurements import Measurement, PositionFix
from fusiond.configuration.load import ConfigError
from fusiond.configuration.schema import Config
from fusiond.navigation.solution import BoundState
from fusiond.navigator.navigator import Navigator
from tests.navigator import vehicle

GNSS: dict[str, Any] = {"kind": "gnss", "bias_sd_m": 0.0}  # the fixes share no error
# The drive starts from a configured position: levels are wide until the receivers have spoken.
ALARMED_AT_FIRST = ["protection_level", "protection_restored"]


def settings(limit_m: float | None, **aiding: dict[str, Any]) -> dict[str, Any]:
    limits = {} if limit_m is None else {"horizontal_alert_limit_m": limit_m}
    return {**vehicle.CONFIG, "aiding": {"gnss": GNSS, **aiding}, "integrity": limits}


def driven(
    limit_m: float | None, two: bool = False, off_m: float = 0.0
) -> tuple[Navigator, list[str]]:
    """The drive of 44 s with one receiver or two alike; the first is off north by `off_m` from
    half way on. The navigator at the end, and its events about levels."""
    heard: list[str] = []

    def receive(code: str, text: str) -> None:
        if code.startswith("protection"):
            heard.append(code)

    d = vehicle.drive()
    extra = {"other": GNSS} if two else {}
    navigator = Navigator(Config.model_validate(settings(limit_m, **extra)), on_event=receive)
    waiting: list[Measurement] = list(d.measurements)
    for row in range(0, len(d.times), 10):
        navigator.add_imu(d.times[row : row + 10], d.samples[row : row + 10])
        now = int(d.times[min(row + 10, len(d.times)) - 1])
        while waiting and waiting[0].t_seen_ns <= now:
            m = waiting.pop(0)
            if isinstance(m, PositionFix):
                if two:
                    navigator.add(replace(m, source="other"), m.t_seen_ns)
                if m.t_seen_ns - vehicle.START_NS > 25e9:
                    m = replace(m, lat_rad=m.lat_rad + off_m / 6.37e6)
            navigator.add(m, m.t_seen_ns)
        navigator.advance()
    return navigator, heard


def test_without_an_alert_limit_there_are_no_levels() -> None:
    navigator, heard = driven(None)
    bound = navigator.solution(navigator.imu.latest_ns).bound
    assert bound.state is BoundState.OFF
    assert math.isnan(bound.hpl_m)
    assert math.isnan(bound.vpl_m)
    assert heard == []


def test_with_one_receiver_nobody_can_check_it() -> None:
    """The only other solution is the IMU with its wheels: the level grows as that drifts."""
    navigator, heard = driven(20.0)
    now = navigator.imu.latest_ns
    late = navigator.solution(now).bound
    assert late.state is BoundState.BEYOND
    assert late.hpl_m > 2.0 * 20.0
    assert heard == ["protection_level"]
    assert math.hypot(*navigator.solution(now).sd_ned_m[:2]) < 1.5


def test_with_two_receivers_the_level_stays() -> None:
    navigator, heard = driven(20.0, two=True)
    bound = navigator.solution(navigator.imu.latest_ns).bound
    sd = math.hypot(*navigator.solution(navigator.imu.latest_ns).sd_ned_m[:2])
    assert 5.0 * sd < bound.hpl_m < 15.0
    assert bound.state is BoundState.WITHIN
    assert heard in (
        [],
        ["protection_level", "protection_restored"],
    )  # alarmed before the second fix


def north_of(one: Navigator, other: Navigator) -> float:
    """How far (m) two solutions are from each other, north."""
    now = one.imu.latest_ns
    return abs(other.solution(now).lat_rad - one.solution(now).lat_rad) * 6.37e6


def test_the_level_is_beyond_the_error_of_a_receiver_that_is_off() -> None:
    """By less than a gate tells."""
    sound, _ = driven(20.0, two=True)
    wrong, heard = driven(20.0, two=True, off_m=2.5)
    assert not wrong.timeline.diagnosis.excluded
    assert north_of(sound, wrong) > 0.5
    assert wrong.solution(wrong.imu.latest_ns).bound.hpl_m > 3.0
    assert heard in ([], ALARMED_AT_FIRST)


def test_a_receiver_that_is_left_out_raises_the_level_beyond_its_error() -> None:
    """By more than a gate passes: it is left out, and what is left of it is less; but nobody checks
    the other then."""
    sound, _ = driven(20.0, two=True)
    wrong, heard = driven(20.0, two=True, off_m=8.0)
    assert wrong.timeline.diagnosis.excluded.keys() == {"gnss"}
    assert north_of(sound, wrong) < 0.5
    a, b = (n.solution(n.imu.latest_ns).bound.hpl_m for n in (sound, wrong))
    assert b >= a
    assert b > 3.0
    assert heard == ALARMED_AT_FIRST


def test_the_level_bounds_what_is_published_with_all_that_is_open() -> None:
    """What no test has told yet may be the IMU's fault, for which no mode of the level stands."""
    navigator, _ = driven(20.0, two=True)
    now, estimator = navigator.imu.latest_ns, navigator.estimator
    before = navigator.solution(now)
    estimator.wider[:3] = 4.0, 4.0, 9.0
    navigator._protection.report()
    after = navigator.solution(now)
    assert after.bound.hpl_m > before.bound.hpl_m + 3.0
    assert after.bound.vpl_m > before.bound.vpl_m + 3.0
    assert after.bound.hpl_m > 5.0 * max(after.sd_ned_m[:2])


def test_before_the_start_the_levels_are_unknown() -> None:
    navigator = Navigator(Config.model_validate(settings(20.0)))
    bound = navigator.solution(0).bound
    assert bound.state is BoundState.UNKNOWN
    assert math.isnan(bound.hpl_m)


def test_a_risk_below_that_of_two_faults_together_is_refused() -> None:
    asked = settings(20.0, rdss={"kind": "rdss"})
    asked["integrity"] = {**asked["integrity"], "integrity_risk_per_hour": 1e-7}
    with pytest.raises(ConfigError, match="two devices at fault"):
        Navigator(Config.model_validate(asked))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"estimator": {"filter": "unscented"}}, "needs estimator.filter 'kalman'"),
        ({"aiding": {"wheel": {"kind": "wheel"}}}, "gives positions"),
        (
            {"integrity": {"fault_probability_per_hour": {"wheel": 1e-3}}},
            r"no \[aiding.wheel\] with positions",
        ),
    ],
)
def test_what_cannot_be_is_refused_by_name(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        Config.model_validate({**settings(20.0), **change})
