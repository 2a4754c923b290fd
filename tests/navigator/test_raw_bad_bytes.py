"""What a receiver may say that is not so, through its bytes: named, counted, never fused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    Ephemeris,
    RawEvent,
    RawGnssEpoch,
    RawSignal,
)
from fusiond.configuration.aiding import RawAiding
from fusiond.gnss.orbit import WEEK_S
from fusiond.navigator.raw_gnss import RawGnss
from fusiond.simulation.gnss import rtcm3_encode, ubx_encode
from fusiond.simulation.gnss.raw import GnssRaw
from tests.navigator.test_raw_bad_input import MS_M, Change, at_rest, served
from tests.navigator.test_raw_gnss import informed, off, place, receiver, started

GPS_POSIX_S, LEAP_S, DAY_S = 315_964_800, 18, 86_400.0
ENCODE: dict[str, Callable[..., bytes]] = {"ubx": ubx_encode.rawx, "rtcm": rtcm3_encode.msm7}


class Wire:
    """A receiver's bytes, decoded as the driver does."""

    def __init__(self, sim: GnssRaw, kind: str) -> None:
        self.kind, self.decoder = kind, RawDecoder("raw")
        week, tow_s = sim.gps_time(0.0)
        self.decoder.note_utc(round((GPS_POSIX_S + week * WEEK_S + tow_s - LEAP_S) * 1e9))

    def heard(self, data: bytes) -> list[RawEvent]:
        return self.decoder.feed(data, 0) + self.decoder.flush_epoch()

    def epoch(self, epoch: RawGnssEpoch, change: Change = lambda s: s) -> RawGnssEpoch:
        said = replace(epoch, signals=tuple(map(change, epoch.signals)))
        (found,) = self.heard(ENCODE[self.kind](said, [60_000] * len(said.signals)))
        assert isinstance(found, RawGnssEpoch)
        return found


class Wired:
    """Epochs of a simulated receiver, as they come out of its bytes; `change` acts on the last."""

    def __init__(self, sim: GnssRaw, kind: str, change: Change, last: int) -> None:
        self.sim, self.wire, self.change, self.last = sim, Wire(sim, kind), change, last

    def epoch(self, k: int) -> RawGnssEpoch:
        epoch = self.sim.epoch(k)
        return self.wire.epoch(epoch, self.change) if k == self.last else self.wire.epoch(epoch)


def same(s: RawSignal) -> RawSignal:
    return s


@pytest.mark.parametrize("kind", ["ubx", "rtcm"])
def test_a_clock_jumps_by_a_millisecond(kind: str) -> None:
    sim = receiver()

    def jump(s: RawSignal) -> RawSignal:
        assert s.carrier_cycles is not None
        cycles = MS_M * CARRIER_HZ[s.system, s.signal[0]] / SPEED_OF_LIGHT_M_S
        return replace(
            s, pseudorange_m=s.pseudorange_m + MS_M, carrier_cycles=s.carrier_cycles + cycles
        )

    raw = informed(sim=sim)
    estimator = at_rest(raw, Wired(sim, kind, jump, 2), 3, same)  # type: ignore[arg-type]
    assert raw.refused["clock_jump"] == 1
    assert len(raw.sky().used) > 10
    assert off(estimator) < 3.0
    assert np.hypot(*estimator.nav[3:5]) < 0.3


@pytest.mark.parametrize("kind", ["ubx", "rtcm"])
def test_half_a_cycle_slips(kind: str) -> None:
    sim = receiver(signals=(("C", "2I"), ("C", "6I")), cno_sd_db=0.0)
    name = served(sim, "C")

    def slip(s: RawSignal) -> RawSignal:
        assert s.carrier_cycles is not None
        slipped = s.satellite == name and s.signal == "2I"
        return replace(s, carrier_cycles=s.carrier_cycles + 0.5 * slipped)

    raw = informed(sim=sim)
    at_rest(raw, Wired(sim, kind, slip, 1), 2, same)  # type: ignore[arg-type]
    assert raw.refused["C_cycle_slip"] == 1


@pytest.mark.parametrize("kind", ["ubx", "rtcm"])
def test_a_range_is_off_by_300_m(kind: str) -> None:
    sim = receiver()
    name = served(sim, "G")

    def longer(s: RawSignal) -> RawSignal:
        return replace(s, pseudorange_m=s.pseudorange_m + 300.0 * (s.satellite == name))

    raw = informed(sim=sim)
    estimator = at_rest(raw, Wired(sim, kind, longer, 0), 1, same)  # type: ignore[arg-type]
    # The clock is unknown at first, so the range fails beside the others, not before them.
    assert raw.refused["G_range_residual"] == 1
    assert raw.sky().refused[name] == "residual"
    assert off(estimator) < 5.0


@pytest.mark.parametrize("kind", ["ubx", "rtcm"])
def test_an_epoch_with_an_error_in_its_bytes(kind: str) -> None:
    sim = receiver()
    wire, epoch = Wire(sim, kind), sim.epoch(0)
    data = ENCODE[kind](epoch, [60_000] * len(epoch.signals))
    for at in (40, len(data) // 2):
        assert (
            wire.heard(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]) == [] or kind == "rtcm"
        )
    damaged = wire.decoder.counters["ubx_damaged"] + wire.decoder.counters["rtcm_damaged"]
    assert damaged == 2
    assert len(wire.epoch(epoch).signals) == len(epoch.signals)


def test_ephemerides_of_yesterday() -> None:
    """By RTCM 1019 and 1042."""
    sim = receiver()
    epoch, wire, raw = sim.epoch(0), Wire(sim, "rtcm"), RawGnss("raw", RawAiding())
    for e in sim.broadcast(0.0, {(s.system, s.prn) for s in epoch.signals}):
        week, toe_s = e.week, e.toe_s - DAY_S
        if toe_s < 0.0:
            week, toe_s = week - 1, toe_s + WEEK_S
        old = replace(e, week=week, toe_s=toe_s, toc_s=toe_s)
        (found,) = wire.heard(rtcm3_encode.ephemeris_frame(old))
        assert isinstance(found, Ephemeris)
        raw.learn(found)
    measurement = raw.measurement(wire.epoch(epoch), 0)
    outcome = started(RawAiding()).update(measurement.at(place(0)))
    measurement.judged(outcome.rows, outcome.whitened)
    assert outcome.name == "no_satellites"
    assert set(raw.refused) == {"G_stale_ephemeris", "C_stale_ephemeris"}
