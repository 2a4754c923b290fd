"""What a receiver may say that is not so: named, counted, never fused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.raw.messages import CARRIER_HZ, SPEED_OF_LIGHT_M_S, Ephemeris, RawGnssEpoch, RawSignal
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.schema import Imu
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.gnss.nominal_constellation import ephemeris, gps_slots
from fusiond.gnss.orbit import WEEK_S
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity
from fusiond.navigator.raw_gnss import RawGnss
from fusiond.simulation.gnss.raw import GnssRaw
from tests.navigator.test_raw_gnss import informed, off, place, receiver, started
from tests.runs import filled_buffer

MS_M = SPEED_OF_LIGHT_M_S * 1e-3
Change = Callable[[RawSignal], RawSignal]


def changed(epoch: RawGnssEpoch, change: Change, only: str = "") -> RawGnssEpoch:
    signals = [change(s) if only in ("", s.satellite) else s for s in epoch.signals]
    return replace(epoch, signals=tuple(signals))


def at_rest(
    raw: RawGnss,
    sim: GnssRaw,
    epochs: int,
    change: Change,
    only: str = "",
    since: int | None = None,
) -> KalmanEstimator:
    """A filter of a vehicle at rest that takes `epochs`, of which those from `since` on, the last
    one if it is not given, are `changed`."""
    estimator = started(RawAiding())
    lat, _, height = estimator.nav[:3].tolist()
    turn = EARTH_RATE_RAD_S * np.array([np.cos(lat), 0.0, -np.sin(lat)])
    times = np.arange(1, epochs * 100, dtype=np.int64) * 10_000_000
    rest = np.tile(np.r_[turn, 0.0, 0.0, -gravity(lat, height)], (len(times), 1))
    imu = filled_buffer(Imu(), times, rest)
    for k in range(epochs):
        epoch = sim.epoch(k)
        if k >= (epochs - 1 if since is None else since):
            epoch = changed(epoch, change, only)
        estimator.propagate(imu, k * 1_000_000_000)
        measurement = raw.measurement(epoch, k * 1_000_000_000)
        outcome = estimator.update(measurement.at(estimator.nav))
        measurement.judged(outcome.rows, outcome.whitened)
        assert outcome.name == "fused"
    return estimator


def same(s: RawSignal) -> RawSignal:
    return s


def served(sim: GnssRaw, system: str) -> str:
    """A satellite that serves, high up."""
    epoch = sim.epoch(0)
    mine = [s for s in epoch.signals if s.system == system]
    return max(mine, key=lambda s: s.cno_db_hz or 0.0).satellite


def test_ephemerides_of_yesterday_are_stale() -> None:
    sim = receiver()
    epoch = sim.epoch(0)
    raw = RawGnss("raw", RawAiding())
    for message in sim.broadcast(0.0, {(s.system, s.prn) for s in epoch.signals}):
        days = 86_400.0
        week, toe_s = message.week, message.toe_s - days
        if toe_s < 0.0:
            week, toe_s = week - 1, toe_s + WEEK_S
        raw.learn(replace(message, week=week, toe_s=toe_s, toc_s=toe_s))
    measurement = raw.measurement(epoch, 0)
    outcome = started(RawAiding()).update(measurement.at(place(0)))
    measurement.judged(outcome.rows, outcome.whitened)
    assert outcome.name == "no_satellites"
    assert set(raw.refused) == {"G_stale_ephemeris", "C_stale_ephemeris"}
    assert set(raw.sky().refused.values()) == {"stale_ephemeris"}


def another(sim: GnssRaw, prn: int, later_s: float = 0.0) -> Ephemeris:
    """What another satellite that is up sends under that number."""
    up = {s.prn for s in sim.epoch(0).signals if s.system == "G"} - {prn}
    slot = next(s for s in gps_slots() if s.prn in up)
    week, tow_s = sim.gps_time(0.0)
    return replace(ephemeris(slot, week, tow_s + later_s), prn=prn)


def test_a_number_that_has_become_another_satellites() -> None:
    """Thousands of kilometres off until what it sends has come, and then forgotten at once."""
    sim = receiver()
    name = served(sim, "G")
    wrong = informed(sim=sim)
    wrong.learn(another(sim, int(name[1:])))  # of the same toe: it takes the place
    assert wrong.refused["G_number_of_another"] == 0
    estimator = at_rest(wrong, sim, 1, same)
    assert wrong.sky().refused[name] == "gated"
    assert wrong.refused["G_range_gated"] == 1
    clean = started(RawAiding())
    raw = informed(sim=sim)
    epoch = sim.epoch(0)
    others = tuple(s for s in epoch.signals if s.satellite != name)
    measurement = raw.measurement(replace(epoch, signals=others), 0)
    clean.update(measurement.at(clean.nav))
    assert off(estimator) == pytest.approx(off(clean), abs=1e-3)
    # The other way round: the old one's of the next two hours, and then the new one's.
    mended = RawGnss("raw", RawAiding())
    mended.learn(another(sim, int(name[1:]), 7200.0))
    for message in sim.broadcast(0.0, {(s.system, s.prn) for s in sim.epoch(0).signals}):
        mended.learn(message)
    assert mended.refused["G_number_of_another"] == 1
    at_rest(mended, sim, 1, same)
    assert name in mended.sky().used


@pytest.mark.parametrize("cycles", [0.5, -0.5])
def test_half_a_cycle_that_slipped_shows_in_two_carriers(cycles: float) -> None:
    sim = receiver(signals=(("G", "1C"), ("G", "2L")), cno_sd_db=0.0)
    name = served(sim, "G")

    def slip(s: RawSignal) -> RawSignal:
        assert s.carrier_cycles is not None
        return replace(s, carrier_cycles=s.carrier_cycles + (cycles if s.signal == "1C" else 0.0))

    raw = informed(sim=sim)
    at_rest(raw, sim, 2, slip, name)
    assert raw.refused["G_cycle_slip"] == 1
    plain = informed(sim=sim)
    at_rest(plain, sim, 2, same)
    assert plain.refused["G_cycle_slip"] == 0


def test_half_a_cycle_of_one_carrier_fails_its_row() -> None:
    """9.5 cm beside millimetres of eight others, once: then it waits for the next anchor."""
    sim = receiver(signals=(("G", "1C"), ("C", "2I")), carrier_sd_m=0.001)
    name = served(sim, "C")

    def slip(s: RawSignal) -> RawSignal:
        assert s.carrier_cycles is not None
        return replace(s, carrier_cycles=s.carrier_cycles + 0.5)

    def place_after(change: Change) -> tuple[int, Any]:
        raw = informed(sim=sim)
        found = at_rest(raw, sim, 12, change, name, 4)
        return raw.refused["C_carrier_gated"] + raw.refused["C_carrier_residual"], found.nav

    refused, nav = place_after(slip)
    assert refused == 1
    refused, unslipped = place_after(same)
    assert refused == 0
    # never fused: half a cycle would move the place by centimetres
    assert (nav - unslipped)[:2] * 6.37e6 == pytest.approx(0.0, abs=0.004)
    assert (nav - unslipped)[2:6] == pytest.approx(0.0, abs=0.004)


@pytest.mark.parametrize("carriers", [True, False], ids=["carriers too", "ranges alone"])
def test_a_clock_that_jumps_by_a_millisecond(carriers: bool) -> None:
    """Whether the receiver says so or not: the clock is another, the place is not."""
    sim = receiver()

    def jump(s: RawSignal) -> RawSignal:
        cycles = s.carrier_cycles
        assert cycles is not None
        if carriers:
            cycles += MS_M * CARRIER_HZ[s.system, s.signal[0]] / SPEED_OF_LIGHT_M_S
        return replace(s, pseudorange_m=s.pseudorange_m + MS_M, carrier_cycles=cycles)

    raw = informed(sim=sim)
    estimator = at_rest(raw, sim, 3, jump)
    assert raw.refused["clock_jump"] == int(carriers)
    assert len(raw.sky().used) > 10
    assert off(estimator) < 3.0
    assert np.hypot(*estimator.nav[3:5]) < 0.3


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"pseudorange_m": 2.2e7 + 300.0}, "gated"),
        ({"cno_db_hz": 12.0}, "weak_signal"),
    ],
)
def test_a_satellite_that_is_off_goes_alone(values: dict[str, Any], name: str) -> None:
    sim = receiver()
    satellite = served(sim, "G")
    raw = informed(sim=sim)
    estimator = at_rest(raw, sim, 1, lambda s: replace(s, **values), satellite)
    assert raw.sky().refused[satellite] == name
    assert satellite not in raw.sky().used
    assert off(estimator) < 5.0
