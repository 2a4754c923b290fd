"""Where a receiver's positions leap against its own velocities."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.aiding.initialisation_candidates import PositionCandidate, VelocityCandidate
from fusiond.navigator.alignment.position_jumps import (
    LOOKED_NS,
    Epoch,
    since_leap,
    unchanged,
    velocities_alone,
)

SD, NO_LEVER = (1.0, 1.0, 2.0), (0.0, 0.0, 0.0)
RADIUS_M = 6_371_000.0
SPEED_M_S, TURN_RAD_S = 14.0, 0.1


def epochs(
    late_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    noise_m: float = 0.3,
    rate_hz: float = 2.0,
    lon_rad: float = 1.9,
    speed_m_s: float = SPEED_M_S,
) -> list[Epoch]:
    """Thirty seconds round a bend; how late the fixes are from 0, 10 and 20 s on."""
    rng = np.random.default_rng(3)
    found = []
    for k in range(round(30.0 * rate_hz)):
        t_s = k / rate_hz
        true_s = t_s - late_s[int(t_s // 10.0)]
        course = TURN_RAD_S * true_s
        north = speed_m_s / TURN_RAD_S * math.sin(course) + noise_m * rng.standard_normal()
        east = -speed_m_s / TURN_RAD_S * math.cos(course) + noise_m * rng.standard_normal()
        v = speed_m_s * math.cos(course), speed_m_s * math.sin(course), 0.0
        lon = math.remainder(lon_rad + east / (RADIUS_M * math.cos(0.5)), 2.0 * math.pi)
        place = 0.5 + north / RADIUS_M, lon, 40.0
        t_ns = round(t_s * 1e9)
        velocity = VelocityCandidate(t_ns, v, (0.05, 0.05, 0.1), NO_LEVER)
        found.append(Epoch(velocity, PositionCandidate(t_ns, *place, SD, NO_LEVER)))
    return found


@pytest.mark.parametrize("rate_hz", [1.0, 2.0, 10.0])
@pytest.mark.parametrize("noise_m", [0.0, 0.05, 1.0])
def test_a_receiver_that_is_as_late_all_the_time_leaps_nowhere(
    rate_hz: float, noise_m: float
) -> None:
    for late_s in (0.0, 0.8):
        all_of_them = epochs((late_s,) * 3, noise_m=noise_m, rate_hz=rate_hz)
        assert len(since_leap(all_of_them)) == len(all_of_them)


@pytest.mark.parametrize(
    ("late_s", "since_s"),
    [((0.0, 0.8, 0.8), 10.0), ((0.0, 0.8, 0.0), 20.0), ((0.8, 0.0, 0.0), 10.0)],
)
@pytest.mark.parametrize("lon_rad", [1.9, math.pi])
def test_only_what_came_after_the_last_change_of_lateness_is_left(
    late_s: tuple[float, float, float], since_s: float, lon_rad: float
) -> None:
    left = since_leap(epochs(late_s, lon_rad=lon_rad))
    assert left[0].velocity.t_ns == round(since_s * 1e9)


@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
@pytest.mark.parametrize("late_s", [0.4, 1.0])
def test_velocities_that_are_late_alone_have_positions_that_go_before(
    late_s: float, rate_hz: float
) -> None:
    """A bend of 86 deg in 15 s; or all of it late, of which positions know nothing."""
    places = epochs(noise_m=1.0, rate_hz=rate_hz)[: round(15.0 * rate_hz)]
    said = epochs((late_s,) * 3, noise_m=1.0, rate_hz=rate_hz)[: len(places)]
    alone = [e._replace(position=on_time.position) for e, on_time in zip(said, places, strict=True)]
    assert velocities_alone(alone, late_s)
    assert not velocities_alone(said, late_s)
    # What was late and is on time again, all of it or its velocities alone.
    assert not velocities_alone(places, -late_s)
    back = [e._replace(position=late.position) for e, late in zip(places, said, strict=True)]
    assert velocities_alone(back, -late_s)
    assert not velocities_alone([e._replace(position=None) for e in alone], late_s)
    # Where nothing changes a velocity, nothing says which of them is late.
    straight = [e._replace(velocity=e.velocity._replace(v_ned=(9.0, 0.0, 0.0))) for e in alone]
    assert not velocities_alone(straight, late_s)


def test_a_change_that_is_within_what_is_told_of_a_lateness_is_none() -> None:
    slightly = epochs((0.0, 0.04, 0.04), noise_m=0.01, rate_hz=10.0)
    assert len(since_leap(slightly)) == len(slightly)


def test_a_vehicle_that_stands_leaps_nowhere() -> None:
    standstill = epochs((0.0, 0.8, 0.0), speed_m_s=0.0)
    assert len(since_leap(standstill)) == len(standstill)


def test_an_interval_that_is_too_long_to_tell_and_velocities_alone_are_left_whole() -> None:
    gap = [e for e in epochs((0.0, 0.8, 0.8)) if not 7.0 <= e.velocity.t_ns * 1e-9 < 12.0]
    assert len(since_leap(gap)) == len(gap)
    alone = [e._replace(position=None) for e in epochs((0.0, 0.8, 0.0))]
    assert len(since_leap(alone)) == len(alone)
    assert len(since_leap(alone[:1])) == 1
    assert since_leap([]) == []


# --------------------------------------------------------------------------- nothing has changed


def road(
    *,
    seconds: int = 90,
    late_s: float = 0.0,
    since_s: float = 60.0,
    accelerates: bool = True,
    changes_s: float = 45.0,
    slow_from_s: float = math.inf,
    rate_hz: float = 2.0,
) -> list[Epoch]:
    """A road straight to the north; the fixes are late from `since_s` on."""
    rng = np.random.default_rng(4)
    found, north, before_s = [], 0.0, 0.0
    for k in range(round(seconds * rate_hz)):
        t_s = k / rate_hz
        speed = 20.0 + (8.0 if accelerates and t_s > changes_s else 0.0)
        speed = 1.0 if t_s > slow_from_s else speed
        north += speed * (t_s - before_s)
        before_s = t_s
        seen = north - speed * (late_s if t_s >= since_s else 0.0) + 0.5 * rng.standard_normal()
        t_ns = round(t_s * 1e9)
        place = 0.5 + seen / RADIUS_M, 1.9, 40.0
        velocity = VelocityCandidate(t_ns, (speed, 0.0, 0.0), (0.05, 0.05, 0.1), NO_LEVER)
        found.append(Epoch(velocity, PositionCandidate(t_ns, *place, SD, NO_LEVER)))
    return found


def test_positions_that_have_followed_the_velocities_since_it_was_shown_are_as_late_as_then() -> (
    None
):
    assert unchanged(road(), 0.8)
    assert unchanged(road(rate_hz=5.0), 0.8)
    assert not unchanged(road(), 0.1)


def test_while_something_did_not_fit_a_lateness_may_have_been_there() -> None:
    """The velocity changes at 70 s; what came within half a minute of a doubt proves nothing."""
    seen = road(seconds=120, changes_s=70.0)
    assert unchanged(seen, 0.8, round(30e9))
    assert not unchanged(seen, 0.8, round(50e9))


@pytest.mark.parametrize(
    "seen",
    [
        road(late_s=0.8),
        road(late_s=-0.8),
        road(late_s=0.8, since_s=10.0),
        road(accelerates=False),
        road(slow_from_s=70.0),
        [e for e in road() if not 62e9 <= e.velocity.t_ns < 68e9],
        [e for e in road() if e.velocity.t_ns > 90e9 - LOOKED_NS],
        [e._replace(position=None) for e in road()],
        [],
    ],
    ids=["late", "early", "long ago", "steady", "slow", "gap", "short", "no positions", "none"],
)
def test_what_cannot_be_seen_may_have_changed(seen: list[Epoch]) -> None:
    assert not unchanged(seen, 0.8)
