"""Protection levels from raw epochs: one receiver alone, its satellites sound or at fault."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from drivers.raw.messages import RawGnssEpoch
from fusiond.configuration.schema import Config
from fusiond.navigation.solution import BoundState, Solution
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.gnss.raw import GnssRaw, GnssRawOptions
from tests.navigator.vehicle import CONFIG, START_NS, STARTED_S, drive
from tests.runs import metres_per_unit

CHUNK = 10
# Above the levels of the sound receiver by a little.
LIMIT_M = 37.0
FAULT_S = 20.0


@lru_cache(maxsize=1)
def receiver() -> GnssRaw:
    return GnssRaw(drive().truth, GnssRawOptions(rate_hz=1.0), np.random.default_rng(5))


def longer(epoch: RawGnssEpoch, metres_more: float, satellites: tuple[str, ...]) -> RawGnssEpoch:
    signals = tuple(
        replace(s, pseudorange_m=s.pseudorange_m + metres_more) if s.satellite in satellites else s
        for s in epoch.signals
    )
    return replace(epoch, signals=signals)


def without_carriers(epoch: RawGnssEpoch) -> RawGnssEpoch:
    return replace(epoch, signals=tuple(replace(s, carrier_cycles=None) for s in epoch.signals))


def driven(
    fault_m: float = 0.0,
    rate_m_s: float = 0.0,
    satellites: tuple[str, ...] = (),
    from_s: float = FAULT_S,
    carriers: bool = False,
) -> tuple[list[tuple[Solution, float]], list[str]]:
    """Solution and horizontal error (m) at each second from 15 s on, and what was said of levels.
    From `from_s` on the ranges of `satellites` are longer by `fault_m`, and by more each second.
    Without `carriers` nothing shows that before the ranges are held against each other.
    """
    sim, d = receiver(), drive()
    heard: list[str] = []

    def receive(code: str, text: str) -> None:
        if code == "protection_level":
            heard.append(text)

    settings = {
        **CONFIG,
        "aiding": {"raw": {"kind": "raw"}},
        "integrity": {"horizontal_alert_limit_m": LIMIT_M},
    }
    navigator = Navigator(Config.model_validate(settings), on_event=receive)
    epochs = [(float(sim.t_s[k]), sim.epoch(k)) for k in range(len(sim))]
    if not carriers:
        epochs = [(t, without_carriers(epoch)) for t, epoch in epochs]
    known = {(s.system, s.prn) for _, e in epochs for s in e.signals}
    for message in (*sim.broadcast(0.0, known), *sim.ionosphere):
        navigator.raw["raw"].learn(replace(message, source="raw"))
    waiting = [(t, e) for t, e in epochs if t > STARTED_S]
    found = []
    for row in range(0, len(d.times), CHUNK):
        navigator.add_imu(d.times[row : row + CHUNK], d.samples[row : row + CHUNK])
        now_ns = int(d.times[min(row + CHUNK, len(d.times)) - 1])
        now_s = (now_ns - START_NS) * 1e-9
        while waiting and waiting[0][0] <= now_s:
            t_s, epoch = waiting.pop(0)
            if t_s >= from_s:
                epoch = longer(epoch, fault_m + rate_m_s * (t_s - from_s), satellites)
            navigator.add(replace(epoch, source="raw"), START_NS + round(t_s * 1e9))
        navigator.advance()
        if now_s > 15.0 and round(now_s * 50.0) % 50 == 0:
            solution = navigator.solution(now_ns)
            true = drive().truth.at(np.array([now_s])).position[0]
            apart = np.array([solution.lat_rad, solution.lon_rad, solution.height_m]) - true
            north, east = (apart * metres_per_unit(true[0], true[2]))[:2]
            found.append((solution, math.hypot(north, east)))
    return found, heard


@lru_cache(maxsize=1)
def sound() -> tuple[list[tuple[Solution, float]], list[str]]:
    return driven()


def strongest(system: str) -> str:
    """The satellite of a system that stands highest."""
    signals = [s for s in receiver().epoch(30).signals if s.system == system]
    return max(signals, key=lambda s: s.cno_db_hz or 0.0).satellite


def test_one_receiver_is_checked_by_its_own_satellites() -> None:
    """Without their redundancy the level of a single receiver has no end (docs/integrity.md)."""
    found, heard = sound()
    assert len(found) >= 25
    for solution, error_m in found:
        assert solution.bound.state is BoundState.WITHIN
        assert error_m < 2.0
        assert 5.0 * math.hypot(*solution.sd_ned_m[:2]) < solution.bound.hpl_m < LIMIT_M
        assert math.isfinite(solution.bound.vpl_m)
    assert len(heard) <= 1  # before the first epoch


def test_a_satellite_at_fault_is_left_out_of_the_level_and_named() -> None:
    """Fewer satellites bound less; the solution is not moved, as the filter screens its range."""
    faulty = strongest("G")
    found, heard = driven(60.0, satellites=(faulty,))
    at_fault = [(s, e) for s, e in found if s.t_ns - START_NS > (FAULT_S + 1.0) * 1e9]
    for (solution, error_m), (before, _) in zip(
        at_fault, sound()[0][-len(at_fault) :], strict=True
    ):
        assert error_m < 2.0
        assert error_m < before.bound.hpl_m < solution.bound.hpl_m < 2.0 * before.bound.hpl_m
    assert heard[-1].startswith("horizontal")
    assert heard[-1].endswith(f"raw fits without {faulty}")


@pytest.mark.parametrize("rate_m_s", [0.7, 3.0])
def test_the_level_holds_while_a_range_runs_away(rate_m_s: float) -> None:
    """Each second, whether the fault is small enough to be believed or has been noticed."""
    found, _ = driven(rate_m_s=rate_m_s, satellites=(strongest("G"),), carriers=rate_m_s > 1.0)
    assert all(error_m < solution.bound.hpl_m for solution, error_m in found)


def test_two_satellites_of_two_systems_at_fault_together_are_not_bounded() -> None:
    """Nobody monitors that: nothing explains the ranges, and the receiver's level is no more."""
    found, heard = driven(60.0, satellites=(strongest("G"), strongest("C")), from_s=41.0)
    last, error_m = found[-1]
    assert last.bound.state is BoundState.BEYOND
    assert error_m < last.bound.hpl_m
    assert heard
