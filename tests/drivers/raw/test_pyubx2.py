"""Observations and subframe words of a real stream against pyubx2's reading of the same frames.

pyubx2 takes 6 ms for an epoch of 22 measurements, too long for 68 at 10 Hz, and parses a whole
stream; so the daemon has its own frames and `struct`, and pyubx2 is the oracle.
"""

from __future__ import annotations

from typing import Any

import pytest
from pyubx2 import UBXReader

from drivers.nmea.mixed_framing import Frame, StreamSplitter
from drivers.raw import ubx
from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import SPEED_OF_LIGHT_M_S, RawGnssEpoch, RawSignal
from tests.places import DATA

WALK = DATA / "walk_0827" / "gnss.ubx"
L1, L2, L5, E6, B3 = 1575.42e6, 1227.6e6, 1176.45e6, 1278.75e6, 1268.52e6
HZ = {(0, 0): L1, (0, 3): L2, (0, 7): L5, (2, 0): L1, (2, 4): L5, (2, 8): E6}
HZ |= {(3, 4): B3, (3, 5): L1, (3, 7): L5}
"""The walk's signals by gnssId and sigId."""
SYSTEM = {0: "G", 2: "E", 3: "C"}
EVERY = 40

pytestmark = pytest.mark.skipif(
    not WALK.is_file(), reason=f"real recording is absent: {WALK} (set FUSIOND_DATA)"
)


def _frames(kind: bytes) -> list[bytes]:
    items = StreamSplitter().feed(WALK.read_bytes())
    return [i.raw for i in items if isinstance(i, Frame) and i.raw[2:4] == kind]


def _close(ours: float | None, theirs: float) -> bool:
    return ours == pytest.approx(theirs, rel=1e-12)


def _same(signal: RawSignal, theirs: dict[str, Any], k: str) -> bool:
    gnss = theirs[f"gnssId_{k}"]
    wave = SPEED_OF_LIGHT_M_S / HZ[gnss, theirs[f"sigId_{k}"]]
    return (
        (signal.system, signal.prn) == (SYSTEM[gnss], theirs[f"svId_{k}"])
        and signal.pseudorange_m == theirs[f"prMes_{k}"]
        and _close(signal.range_rate_m_s, -theirs[f"doMes_{k}"] * wave)
        and signal.cno_db_hz == theirs[f"cno_{k}"]
        and _close(signal.sd_pseudorange_m, 0.01 * 2 ** theirs[f"prStd_{k}"])
        and _close(signal.sd_range_rate_m_s, 0.002 * 2 ** theirs[f"doStd_{k}"] * wave)
    )


def test_every_measurement_of_an_epoch() -> None:
    compared = 0
    for frame in _frames(ubx.RAWX)[::EVERY]:
        (epoch,) = RawDecoder("walk").feed(frame, 0)
        assert isinstance(epoch, RawGnssEpoch)
        theirs = vars(UBXReader.parse(frame))
        assert (epoch.week, epoch.tow_s) == (theirs["week"], theirs["rcvTow"])
        numbers = [f"{k:02d}" for k in range(1, theirs["numMeas"] + 1)]
        valid = [k for k in numbers if theirs[f"gnssId_{k}"] in SYSTEM and theirs[f"prValid_{k}"]]
        assert len(epoch.signals) == len(valid)
        assert all(_same(s, theirs, k) for s, k in zip(epoch.signals, valid, strict=True))
        compared += len(valid)
    assert compared > 500


def test_every_word_of_a_subframe() -> None:
    frames = _frames(ubx.SFRBX)[::EVERY]
    assert len(frames) > 50
    for frame in frames:
        theirs = vars(UBXReader.parse(frame))
        words = [theirs[f"dwrd_{k:02d}"] for k in range(1, theirs["numWords"] + 1)]
        ours = ubx.parse_sfrbx(frame[6:-2])
        assert ours is not None
        assert ours.words == tuple(words)
