"""SSR: frames by the standard's tables, pyrtcm's numbers, RTKLIB's decoder; what is refused."""

from __future__ import annotations

from collections import Counter
from datetime import date
from pathlib import Path
from typing import Any

import pyrtcm
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.raw.decoder import RawDecoder
from drivers.raw.driver import GnssDriver, GnssOptions
from drivers.raw.messages import Correction, RawEvent, System
from drivers.raw.ssr import GLONASS, INTERVALS_S, MESSAGES, OTHERS, SIGNALS, accuracy_m
from fusiond.recording.records import Record, input_of, input_record
from tests.drivers.raw.frames import measurement, put, rawx, rtcm

FIRST: dict[System, int] = {"G": 1057, "E": 1240, "C": 1258}
ISSUE_BITS: dict[System, tuple[int, ...]] = {"G": (8,), "E": (10,), "C": (10, 8)}
ORBIT = (-12_345, 2_001, -777, 15, -9, 4)
CLOCK = (54_321, -30, 7)
TOW_S = 345_600
"""Of BeiDou's messages in BDT."""


def packed(*fields: tuple[int, int]) -> bytes:
    """A frame of (value, bits), filled up with zeros to whole bytes."""
    value = length = 0
    for number, bits in fields:
        value = value << bits | number & (1 << bits) - 1
        length += bits
    size = -(-length // 8)
    return rtcm((value << (8 * size - length)).to_bytes(size, "big"))


def head(
    number: int, satellites: int, *, orbits: bool = False, tow_s: int = TOW_S, interval: int = 2
) -> list[tuple[int, int]]:
    datum = [(0, 1)] if orbits else []
    of = [(3, 4), (258, 16), (1, 4), (satellites, 6)]
    return [(number, 12), (tow_s, 20), (interval, 4), (0, 1), *datum, *of]


def orbit_fields(system: System, prn: int, issue: int) -> list[tuple[int, int]]:
    first, *rest = ISSUE_BITS[system]
    bits = (22, 20, 20, 21, 19, 19)
    numbers = list(zip(ORBIT, bits, strict=True))
    return [(prn, 6), (issue, first), *((99, b) for b in rest), *numbers]


def clock_fields(prn: int | None) -> list[tuple[int, int]]:
    numbers = list(zip(CLOCK, (22, 21, 27), strict=True))
    return numbers if prn is None else [(prn, 6), *numbers]


def heard(*frames: bytes, week: bool = True) -> tuple[list[RawEvent], Counter[str]]:
    decoder = RawDecoder("caster", earliest=date(2026, 1, 1))
    if week:
        decoder._weeks.note(2440, TOW_S + 50.0)
    found = [e for frame in frames for e in decoder.feed(frame, 7)]
    return found, decoder.counters


def corrections(*frames: bytes) -> list[Correction]:
    found, counters = heard(*frames)
    assert counters["rtcm_ssr"] == len(frames)
    assert all(isinstance(c, Correction) for c in found)
    return [c for c in found if isinstance(c, Correction)]


@pytest.mark.parametrize("system", ["G", "E", "C"])
def test_each_part_of_each_system(system: System) -> None:
    first = FIRST[system]
    orbit = packed(*head(first, 2, orbits=True), *orbit_fields(system, 5, 77),
                   *orbit_fields(system, 21, 200))  # fmt: skip
    clock = packed(*head(first + 1, 1), *clock_fields(5))
    bias = packed(*head(first + 2, 1), (5, 6), (2, 5), (0, 5), (-123, 14), (6, 5), (45, 14))
    both = packed(*head(first + 3, 1, orbits=True), *orbit_fields(system, 5, 77),
                  *clock_fields(None))  # fmt: skip
    accuracy = packed(*head(first + 4, 1), (5, 6), (0b010_011, 6))
    fast = packed(*head(first + 5, 1), (5, 6), (-250, 22))
    found = corrections(orbit, clock, bias, both, accuracy, fast)
    assert [c.part for c in found] == [
        *("orbit", "orbit", "clock", "bias", "orbit", "clock", "accuracy", "fast_clock")
    ]
    tow_s = TOW_S + (14 if system == "C" else 0) + 2.5
    for c in found:
        assert (c.system, c.week, c.tow_s, c.interval_s) == (system, 2440, tow_s, 5.0)
        assert (c.solution, c.source, c.t_seen_ns) == ((258, 1, 3), "caster", 7)
    assert [(c.satellite, c.issue) for c in found[:2]] == [
        (f"{system}05", 77),
        (f"{system}21", 200),
    ]
    metres = (-1.2345, 0.8004, -0.3108, 1.5e-5, -3.6e-5, 1.6e-5)
    assert found[0].values == pytest.approx(metres)
    assert found[4].values == pytest.approx(metres)
    assert found[2].values == found[5].values == pytest.approx((5.4321, -3e-5, 1.4e-7))
    names = SIGNALS[system]
    assert (found[3].signals, found[3].values) == (
        (names[0], names[6]),
        pytest.approx((-1.23, 0.45)),
    )
    assert found[6].values == pytest.approx((9.0 * 1.75e-3 - 1e-3,))
    assert found[7].values == pytest.approx((-0.025,))


@pytest.mark.parametrize("system", ["G", "E", "C"])
def test_numbers_are_those_of_pyrtcm(system: System) -> None:
    frame = packed(*head(FIRST[system] + 3, 1, orbits=True), *orbit_fields(system, 9, 31),
                   *clock_fields(None))  # fmt: skip
    theirs: Any = pyrtcm.RTCMReader.parse(frame)
    orbit, clock = corrections(frame)
    names = ("DF365", "DF366", "DF367", "DF368", "DF369", "DF370")
    assert orbit.values == pytest.approx([getattr(theirs, f"{n}_01") * 1e-3 for n in names])
    assert clock.values == pytest.approx(
        [getattr(theirs, f"{n}_01") * 1e-3 for n in ("DF376", "DF377", "DF378")]
    )
    assert (theirs.DF413, theirs.DF414, theirs.DF415) == (3, 258, 1)


def test_beidou_by_the_older_draft() -> None:
    """With 24 bits behind the issue in place of eight, as other programs write them."""
    old = [(f if k != 2 else (99, 24)) for k, f in enumerate(orbit_fields("C", 30, 512))]
    (c,) = corrections(packed(*head(1258, 1, orbits=True), *old))
    assert (c.issue, c.prn) == (512, 30)
    assert c.values[0] == pytest.approx(-1.2345)


def test_rtklib_decodes_the_same() -> None:
    rtk = pytest.importorskip("pyrtklib", reason="pyrtklib has wheels for x86-64 only")
    frame = packed(*head(1060, 1, orbits=True), *orbit_fields("G", 9, 31), *clock_fields(None))
    control = rtk.rtcm_t()
    assert rtk.init_rtcm(control) == 1
    control.time = rtk.gpst2time(2440, float(TOW_S))
    status = [rtk.input_rtcm3(control, byte) for byte in frame]
    assert 10 in status
    theirs = control.ssr[rtk.satno(rtk.SYS_GPS, 9) - 1]
    orbit, clock = corrections(frame)
    assert [theirs.deph[k] for k in range(3)] == pytest.approx(orbit.values[:3])
    assert [theirs.ddeph[k] for k in range(3)] == pytest.approx(orbit.values[3:])
    assert [theirs.dclk[k] for k in range(3)] == pytest.approx(clock.values)
    assert theirs.iode == orbit.issue
    rtk.free_rtcm(control)


def test_the_least_interval_holds_from_its_epoch() -> None:
    (c,) = corrections(packed(*head(1058, 1, interval=0), *clock_fields(5)))
    assert (c.tow_s, c.interval_s) == (TOW_S, INTERVALS_S[0])


def test_accuracy_by_its_table() -> None:
    assert accuracy_m(0) is None
    assert accuracy_m(1) == pytest.approx(0.25e-3)
    assert accuracy_m(62) == pytest.approx(5.4665)
    assert accuracy_m(63) == pytest.approx(5.4665)


def test_what_is_refused_is_named() -> None:
    unknown = [(-(1 << 21), 22) if k == 1 else f for k, f in enumerate(clock_fields(5))]
    far = [(1_500_000, 22) if k == 1 else f for k, f in enumerate(clock_fields(5))]
    whole = packed(*head(1057, 2, orbits=True), *orbit_fields("G", 5, 1))  # one of two
    frames = [
        packed(*head(1058, 1), *unknown),
        packed(*head(1058, 1), *far),
        packed(*head(1059, 1), (5, 6), (1, 5), (31, 5), (9, 14)),
        whole,
        packed(*head(1058, 3), *clock_fields(5)),
        packed(*head(1058, 1, tow_s=604_800), *clock_fields(5)),
        packed((1058, 12), (0, 20)),
        packed((1064, 12), (5, 17), (0, 40)),
        packed((1246, 12), (5, 20), (0, 40)),
    ]
    found, counters = heard(*frames)
    assert found == []
    assert {k: n for k, n in counters.items() if n and not k.startswith("rtcm_frames")} == {
        "rtcm_ssr": 3,
        "ssr_not_known": 1,
        "ssr_implausible": 1,
        "signal_unknown": 1,
        "ssr_unreadable": 4,
        "ssr_glonass_not_used": 1,
        "ssr_not_used": 1,
    }
    _, counters = heard(packed(*head(1058, 1), *clock_fields(5)), week=False)
    assert counters["week_unknown"] == 1
    assert not counters["rtcm_ssr"]


def test_a_casters_corrections_go_to_the_receiver_and_to_fusiond(tmp_path: Path) -> None:
    """What came by NTRIP is an input like any other: recorded, it comes again."""
    emitted: list[Any] = []
    frame = packed(*head(1058, 1), *clock_fields(5))
    station = rtcm(bytes.fromhex("3ed00003"))  # 1005, for the receiver alone
    options = GnssOptions(port=str(tmp_path / "absent"), earliest_date=date(2026, 1, 1))
    driver = GnssDriver("gnss", options, emitted.append, lambda: 5)
    heard: list[Record] = []

    def keep(kind: str, t_ns: int, payload: Any) -> None:
        heard.append(input_record(0, kind, t_ns, payload))

    driver.inputs.on_input = keep
    driver.inputs.take("read", rawx(measurement(), week=2440, tow_s=TOW_S + 3.0))
    for each in (frame, station):
        assert driver._pass_on(each) is False  # the line is not open
    found = [e for e in emitted if isinstance(e, Correction)]
    assert [(c.satellite, c.part, c.source) for c in found] == [("G05", "clock", "gnss")]
    assert [r.kind.name for r in heard] == ["READ", "CORRECTION"]
    emitted.clear()
    again = GnssDriver("gnss", options, emitted.append, lambda: 5)
    for record in heard:
        again.inputs.take(*input_of(record), record.t_ns)
    assert [e for e in emitted if isinstance(e, Correction)] == found
    emitted.clear()
    deaf = GnssDriver("gnss", options.model_copy(update={"use_raw": False}), emitted.append)
    assert deaf._pass_on(frame) is False
    assert emitted == []


@given(st.sampled_from([*MESSAGES, *GLONASS, *OTHERS]), st.binary(max_size=120), st.integers(0, 63))
@settings(max_examples=400, deadline=None)
def test_any_bytes_are_read_or_named(number: int, rest: bytes, satellites: int) -> None:
    """Each frame ends in one counter, and what comes of it can be."""
    body = int.from_bytes(rest, "big")
    bits = 8 * len(rest)
    for at in (61, 62):  # the number of satellites, without and with a datum
        if bits > at + 6 - 12:
            body = put(body, bits, at - 12, 6, satellites % 4)
    found, counters = heard(packed((number, 12), (body, bits)))
    names = ("rtcm_ssr", "ssr_unreadable", "ssr_not_used", "ssr_glonass_not_used")
    assert sum(counters[name] for name in names) == 1
    for each in found:
        assert isinstance(each, Correction)
        assert all(abs(value) <= 164.0 for value in each.values)
        assert 0.0 <= each.tow_s < 604_800.0 + 7200.0
