"""GPS CNAV message 30: delays by the figure of IS-GPS-200, by frames and by RINEX 4."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from drivers.nmea.incremental_checksum import crc24q
from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import Ephemeris, RawEvent, SignalDelays
from drivers.raw.rinex_nav import navigation
from fusiond.gnss.group_delay import group_delay
from fusiond.gnss.ranges import RangeModel, RangeOptions
from fusiond.gnss.store import EphemerisStore
from fusiond.simulation.gnss.raw import GnssRaw, GnssRawOptions
from fusiond.simulation.scenarios import SCENARIOS
from tests.drivers.raw.frames import put, sfrbx

RAW = (-321, 45, -67, 4000, -4096)
"""T_GD, ISC of L1 C/A, L2C, L5 I5; that of L5 Q5 is not known."""


def message(kind: int = 30, prn: int = 5, alert: int = 0) -> list[int]:
    """Ten words; what message 30 has besides is ones."""
    bits = (1 << 276) - 1
    fields = [(0, 8, 0x8B), (8, 6, prn), (14, 6, kind), (20, 17, 57_600), (37, 1, alert)]
    for at, length, value in fields:
        bits = put(bits, 276, at, length, value)
    for k, value in enumerate(RAW):
        bits = put(bits, 276, 127 + 13 * k, 13, value)
    whole = (bits << 24 | crc24q(bits.to_bytes(35, "big"))) << 20
    return [whole >> (288 - 32 * k) & 0xFFFFFFFF for k in range(10)]


def heard(words: list[int], prn: int = 5, signal: int = 4) -> tuple[list[RawEvent], Counter[str]]:
    decoder = RawDecoder("gnss")
    return decoder.feed(sfrbx(0, prn, signal, words), 3), decoder.counters


@pytest.mark.parametrize("signal", [3, 4, 6, 7], ids=["L2 CL", "L2 CM", "L5 I", "L5 Q"])
def test_message_30(signal: int) -> None:
    found, counters = heard(message(), signal=signal)
    weight = 2.0**-35
    corrections = [("1C", 45), ("2S", -67), ("2L", -67), ("2X", -67), ("5I", 4000)]
    assert found == [
        SignalDelays(
            "gnss", 3, "G", 5, -321 * weight, tuple((n, v * weight) for n, v in corrections)
        )
    ]
    assert counters["subframes_cnav"] == counters["signal_delays"] == 1


def test_what_is_no_message_30_is_named() -> None:
    assert heard(message(kind=10))[0] == []
    assert heard(message(alert=1))[0] == []
    damaged = message()
    damaged[4] ^= 1 << 9
    for words, prn, name in (
        (damaged, 5, "crc_bad"),
        (message(), 6, "satellite_mismatch"),
        (message()[:9], 5, "subframe_short"),
    ):
        found, counters = heard(words, prn)
        assert found == []
        assert counters[name] == 1


def ephemeris() -> Ephemeris:
    made = GnssRaw(SCENARIOS["drive"].truth(20.0), GnssRawOptions(), np.random.default_rng(1))
    (found,) = made.broadcast(1.0, {("G", 5)})
    return found


def test_delays_of_signals_with_and_without() -> None:
    e = replace(ephemeris(), group_delay_s=(-9e-9,))
    told = SignalDelays("gnss", 0, "G", 5, -9.2e-9, (("1C", 1e-9), ("5Q", -4e-9)))
    assert group_delay(e, "1C", told) == pytest.approx((-10.2e-9, 0.1))
    assert group_delay(e, "5Q", told) == pytest.approx((-5.2e-9, 0.3))
    assert group_delay(e, "2L", told) == group_delay(e, "2L")
    assert group_delay(e, "1W", told) == group_delay(e, "1W")
    without = group_delay(e, "5Q")
    assert without is not None
    assert without.sigma_m == 3.0


def test_l5_makes_a_pair_once_its_correction_is_known() -> None:
    made = GnssRaw(
        SCENARIOS["drive"].truth(20.0),
        GnssRawOptions(signals=(("G", "1C"),)),
        np.random.default_rng(1),
    )
    epoch = made.epoch(5)
    both = tuple(
        s if k == 0 else replace(s, signal="5Q", pseudorange_m=s.pseudorange_m + 4.0)
        for s in epoch.signals
        for k in range(2)
    )
    epoch = replace(epoch, signals=both)
    store = EphemerisStore()
    numbers = {(s.system, s.prn) for s in both}
    for e in made.broadcast(1.2, numbers):
        store.add(e)
    model = RangeModel(store, RangeOptions(systems=("G",)))
    before = model.pick(epoch).plan
    for _, prn in numbers:
        told = SignalDelays("gnss", 0, "G", prn, 0.0, (("1C", 0.0), ("5Q", 2e-9)))
        store.add(told)
        store.add(replace(told, t_seen_ns=9))  # the same again: nothing to plan anew
    version = store.version
    after = model.pick(epoch).plan
    assert version == before.version + len(numbers)
    # Variance of the delay that group delays leave: 3 m of L5, and 0.1 and 0.3 m.
    assert before.followed[:, 5].min() > 3.0
    assert after.followed[:, 5].max() < 0.2


RINEX = """\
     4.01           NAVIGATION DATA     M                   RINEX VERSION / TYPE
                                                            END OF HEADER
> EPH G05 CNAV
G05 2024 03 01 02 00 00-1.000000000000e-04 1.000000000000e-12 0.000000000000e+00
     0.000000000000e+00 1.000000000000e+00 4.000000000000e-09 1.000000000000e+00
     1.000000000000e-06 5.000000000000e-03 2.000000000000e-06 5.153700000000e+03
     4.320000000000e+05 1.000000000000e-08 1.500000000000e+00 2.000000000000e-08
     9.600000000000e-01 2.000000000000e+02 1.000000000000e+00-8.000000000000e-09
     1.000000000000e-10 0.000000000000e+00 0.000000000000e+00 0.000000000000e+00
     0.000000000000e+00 0.000000000000e+00-9.313225746155e-09 0.000000000000e+00
     8.731149137020e-11 2.619344741106e-10                   -3.783497959375e-09
     4.320300000000e+05 2.303000000000e+03
"""


def test_rinex_4() -> None:
    counters = Counter[str]()
    (found,) = navigation("station", RINEX, counters)
    assert isinstance(found.message, SignalDelays)
    assert found.message.group_delay_s == -9.313225746155e-09
    assert dict(found.message.correction_s) == {
        "1C": 8.731149137020e-11,
        **dict.fromkeys(("2S", "2L", "2X"), 2.619344741106e-10),
        "5Q": -3.783497959375e-09,
    }
    assert +counters == {"signal_delays": 1}
