"""Navigation messages, UBX and RTCM 3 of the simulation, read by RTKLIB and by our decoder."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import fields, replace
from typing import Any, get_args

import numpy as np
import pytest

from drivers.measurements import ArrivalStamp
from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    Ephemeris,
    Klobuchar,
    RawGnssEpoch,
    RawSignal,
)
from fusiond.gnss.ecef import ned_axes, to_ecef
from fusiond.gnss.orbit import gps_time, is_beidou_geo
from fusiond.simulation.gnss import rtcm3_encode, ubx_encode
from fusiond.simulation.gnss.nav_fields import FIELDS, Bits, quantised, wire
from fusiond.simulation.gnss.nav_subframes import bch, d1, d2, hamming, lnav, lnav_words
from fusiond.simulation.gnss.raw import GnssRaw, GnssRawOptions
from fusiond.simulation.gnss.raw_stream import GnssRawStream, RawFormat
from fusiond.simulation.scenarios import SCENARIOS
from tests.gnss.examples import LETTER, examples, oracle_time, rtk

WEEK, TOE = 2381, 388800.0
MODEL = Klobuchar(
    "made", 0, "C", (1.1176e-8, 2.2352e-8, -5.9605e-8, -1.1921e-7), (9.0112e4, 0.0, -1.9661e5, 6e4)
)
MADE = [quantised(e) for e in examples(WEEK, TOE)[:-2] if e.system != "E"]
NAMES = {
    "eccentricity": "e", "inclination": "i0", "ascending_node": "OMG0", "perigee": "omg",
    "mean_anomaly": "M0", "mean_motion_correction": "deln", "inclination_rate": "idot",
    "ascending_node_rate": "OMGd", "clock_bias_s": "f0", "clock_drift": "f1",
    "clock_drift_rate": "f2", "toe_s": "toes",
    **{name: name for name in ("cuc", "cus", "crc", "crs", "cic", "cis")},
}  # fmt: skip
"""Fields of `Ephemeris` and of RTKLIB's `eph_t`."""


def as_sent(e: Ephemeris, raw_format: RawFormat) -> bytes:
    """A whole message of one satellite, sent from half a minute before its toe."""
    if raw_format == "rtcm3":
        return rtcm3_encode.ephemeris_frame(e)
    begin = int(e.toe_s) // 30 * 30 - 30
    make = {"lnav": lnav, "d1": d1, "d2": d2}[e.message]
    blocks = make(e, e.week, begin) if make is lnav else make(e, MODEL, e.week, begin)
    return b"".join(ubx_encode.sfrbx(e.system, e.prn, block) for block in blocks)


def told(e: Ephemeris, found: Any) -> None:
    """RTKLIB holds the very same numbers."""
    assert found.sat == rtk.satno(LETTER[e.system], e.prn)
    assert pytest.approx(e.sqrt_a**2, rel=1e-14) == found.A
    for ours, theirs in NAMES.items():
        expected = getattr(e, ours)
        assert getattr(found, theirs) == pytest.approx(expected, rel=1e-12, abs=1e-25), ours
    toc = oracle_time(*gps_time(e.system, e.week, e.toc_s))
    assert found.toc.time + found.toc.sec == toc.time + toc.sec
    for k, delay in enumerate(e.group_delay_s):
        assert found.tgd[k] == pytest.approx(delay, rel=1e-12)
    assert found.svh == (0 if e.healthy else 63 if e.system == "G" else 1)


@pytest.mark.parametrize("e", MADE, ids=lambda e: e.satellite)
def test_rtklib_reads_the_subframes(e: Ephemeris) -> None:
    raw = rtk.raw_t()
    assert rtk.init_raw(raw, rtk.STRFMT_UBX)
    raw.time = oracle_time(WEEK, TOE)
    kinds = [rtk.input_ubx(raw, byte) for byte in as_sent(e, "ubx")]
    assert kinds.count(2) == 1  # one ephemeris came out
    assert -1 not in kinds
    told(e, raw.nav.eph[rtk.satno(LETTER[e.system], e.prn) - 1])


@pytest.mark.parametrize("e", MADE, ids=lambda e: e.satellite)
def test_rtklib_reads_1019_and_1042(e: Ephemeris) -> None:
    rtcm = rtk.rtcm_t()
    assert rtk.init_rtcm(rtcm)
    rtcm.time = oracle_time(WEEK, TOE)
    assert [k for k in (rtk.input_rtcm3(rtcm, b) for b in as_sent(e, "rtcm3")) if k] == [2]
    told(e, rtcm.nav.eph[rtk.satno(LETTER[e.system], e.prn) - 1])


@pytest.mark.parametrize("raw_format", get_args(RawFormat))
@pytest.mark.parametrize("healthy", [True, False])
def test_our_decoder_reads_them(raw_format: RawFormat, healthy: bool) -> None:
    decoder = RawDecoder("made")
    for e in (replace(e, healthy=healthy) for e in MADE):
        decoder.note_utc(1_725_000_000_000_000_000)
        found = [x for x in decoder.feed(as_sent(e, raw_format), 0) if isinstance(x, Ephemeris)]
        assert len(found) == 1
        for field in fields(Ephemeris):
            expected = getattr(e, field.name)
            if field.name in {"source", "t_seen_ns"}:
                continue
            if isinstance(expected, float | tuple):
                expected = pytest.approx(expected, rel=1e-12, abs=1e-25)
            assert getattr(found[0], field.name) == expected, (e.satellite, field.name)


def test_ionosphere_arrives() -> None:
    e = next(e for e in MADE if e.message == "d1")
    found = [x for x in RawDecoder("x").feed(as_sent(e, "ubx"), 0) if isinstance(x, Klobuchar)]
    (model,) = found
    np.testing.assert_allclose(model.alpha, MODEL.alpha, atol=2.0**-25)
    np.testing.assert_allclose(model.beta, MODEL.beta, atol=2.0**15)


def test_a_flipped_bit_is_refused() -> None:
    e = MADE[0]
    words = [list(block) for block in lnav(e, e.week, 388_770)]
    words[1][4] ^= 1 << 20
    counters: Counter[str] = Counter()
    data = b"".join(ubx_encode.sfrbx("G", e.prn, block) for block in words)
    assert not RawDecoder("x", counters).feed(data, 0)
    assert counters["parity_bad"] == 1


def test_quantised_is_within_half_a_step_and_stays() -> None:
    for e in examples(WEEK, TOE):
        if e.system == "E":
            continue
        rounded = quantised(e)
        assert quantised(rounded) == rounded
        for name, field in FIELDS[e.system].items():
            off = abs(getattr(rounded, name) - getattr(e, name))
            assert off <= 0.5 * field.scale * (1 + 1e-9), name


def test_what_no_message_can_carry() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        wire(replace(MADE[0], clock_bias_s=2e-3))
    with pytest.raises(ValueError, match="no message"):
        wire(replace(MADE[0], system="E"))
    with pytest.raises(ValueError, match="bits"):
        Bits().put(4, 2)


def test_parities_are_those_of_the_standards() -> None:
    # Each code is linear, so its distance is the lightest word's weight: BCH corrects one bit (3),
    # the extended Hamming code of LNAV finds three (4).
    weight = min((x << 4 | bch(x)).bit_count() for x in range(1, 1 << 11))
    assert weight == 3
    pairs = [1 << i | 1 << j for i in range(24) for j in range(i + 1)]
    assert min(x.bit_count() + hamming(x, 0, 0).bit_count() for x in pairs) >= 4
    # Words 2 and 10 end in 00 on the air; the next word then needs no D29*.
    words = lnav_words([0x8B0000, 0x123450, *(0xABCDE0 + k for k in range(7)), 0x400])
    assert words[2] >> 30 == 0
    assert len(words) == 10


def test_crc_of_a_known_frame() -> None:
    # RTCM 10403.3, section 4.2: the example message 1005.
    known = bytes.fromhex("d300133ed7d30202980edeef34b4bd62ac0941986f33360b98")
    assert rtcm3_encode.crc24q(known[:-3]).to_bytes(3, "big") == known[-3:]


def signals() -> tuple[RawSignal, ...]:
    rng = np.random.default_rng(3)
    out = []
    for system, prn, signal in (
        ("G", 3, "1C"), ("G", 32, "1C"), ("C", 21, "2I"), ("C", 21, "6I"), ("C", 30, "7I"),
        ("C", 59, "2I"), ("C", 61, "6I"),
    ):  # fmt: skip
        hz = CARRIER_HZ[system, signal[0]]
        shared = 2.2e7 + 1e6 * (prn % 17)
        out.append(
            RawSignal(
                system,
                prn,
                signal,
                shared + float(rng.uniform(-30.0, 30.0)),
                100.0 * (prn % 15) - 700.0 + float(rng.uniform(-0.2, 0.2)),
                (shared + float(rng.uniform(-30.0, 30.0))) * hz / SPEED_OF_LIGHT_M_S,
                40.5,
                0.64,
                0.01,
            )
        )
    return tuple(out)


EPOCH = RawGnssEpoch("made", 0, ArrivalStamp(), WEEK, 7.2, signals())


def test_rtklib_reads_observations() -> None:
    raw, rtcm = rtk.raw_t(), rtk.rtcm_t()
    assert rtk.init_raw(raw, rtk.STRFMT_UBX)
    assert rtk.init_rtcm(rtcm)
    rtcm.time = oracle_time(WEEK, 0.0)
    locks = [5000] * len(EPOCH.signals)
    kinds = [rtk.input_ubx(raw, b) for b in ubx_encode.rawx(EPOCH, locks)]
    assert kinds[-1] == 1
    kinds = [rtk.input_rtcm3(rtcm, b) for b in rtcm3_encode.msm7(EPOCH, locks)]
    assert [k for k in kinds if k] == [1]
    ubx = raw.obs
    for obs, code_m, rate_m_s in ((ubx, 1e-6, 1e-4), (rtcm.obs, 3e-4, 1e-4)):
        rows = {obs.data[i].sat: obs.data[i] for i in range(obs.n)}
        for s in EPOCH.signals:
            if s.signal == "6I":  # RTKLIB is built for three bands; B3I is its fourth
                continue
            row = rows[rtk.satno(LETTER[s.system], s.prn)]
            assert rtk.time2gpst(row.time, rtk.Arr1Dint(1)) == pytest.approx(EPOCH.tow_s, abs=1e-9)
            hz = CARRIER_HZ[s.system, s.signal[0]]
            at = 1 if s.signal == "7I" else 0
            assert row.P[at] == pytest.approx(s.pseudorange_m, abs=code_m)
            assert s.carrier_cycles is not None
            assert s.range_rate_m_s is not None
            # RTKLIB takes out a half cycle that u-blox has on the GEO.
            half = 0.5 * (obs is ubx and is_beidou_geo(s.system, s.prn))
            assert row.L[at] == pytest.approx(s.carrier_cycles + half, abs=1e-3)
            assert -row.D[at] * SPEED_OF_LIGHT_M_S / hz == pytest.approx(
                s.range_rate_m_s, abs=rate_m_s
            )


@pytest.mark.parametrize("raw_format", get_args(RawFormat))
def test_our_decoder_reads_observations(raw_format: RawFormat) -> None:
    locks = [5000] * len(EPOCH.signals)
    encode = ubx_encode.rawx if raw_format == "ubx" else rtcm3_encode.msm7
    decoder = RawDecoder("x")
    decoder.note_utc(1_725_000_000_000_000_000)
    (epoch,) = decoder.feed(encode(EPOCH, locks), 0) + decoder.flush()
    assert isinstance(epoch, RawGnssEpoch)
    got = {(s.satellite, s.signal): s for s in epoch.signals}
    assert got.keys() == {(s.satellite, s.signal) for s in EPOCH.signals}
    for s in EPOCH.signals:
        one = got[s.satellite, s.signal]
        assert one.pseudorange_m == pytest.approx(s.pseudorange_m, abs=3e-4)
        assert one.carrier_cycles == pytest.approx(s.carrier_cycles, abs=1e-3)
        assert one.range_rate_m_s == pytest.approx(s.range_rate_m_s, abs=1e-4)
        assert one.cno_db_hz == pytest.approx(s.cno_db_hz, abs=0.5)
        if raw_format == "ubx":
            assert one.sd_pseudorange_m == 0.64
            assert one.sd_range_rate_m_s is not None
            assert 0.01 <= one.sd_range_rate_m_s < 0.02


@pytest.mark.parametrize("raw_format", get_args(RawFormat))
@pytest.mark.parametrize("start", [(2400, 0.0), (2400, 604_790.0)])
def test_a_stream_comes_back(raw_format: RawFormat, start: tuple[int, float]) -> None:
    """From the start of a week, where BeiDou's is still the one before, and over its end."""
    truth = SCENARIOS["drive"].truth(40.0)
    receiver = GnssRaw(truth, GnssRawOptions(rate_hz=1.0), np.random.default_rng(1), start)
    stream = GnssRawStream(receiver, raw_format)
    decoder = RawDecoder("x")
    utc_ns = (315_964_800 + 604_800 * start[0] + int(start[1]) - 18) * 1_000_000_000
    decoder.note_utc(utc_ns)
    data = [stream.bytes_of(k) for k in range(len(receiver))]
    events = [event for part in data for event in decoder.feed(part, 0)] + decoder.flush()
    epochs = [x for x in events if isinstance(x, RawGnssEpoch)]
    again = GnssRaw(truth, GnssRawOptions(rate_hz=1.0), np.random.default_rng(1), start)
    assert len(epochs) == len(again)
    for k, epoch in enumerate(epochs):
        sent = again.epoch(k)
        assert (epoch.week, epoch.tow_s, epoch.stamp) == (sent.week, sent.tow_s, sent.stamp)
        got = {s.satellite: s for s in epoch.signals}
        assert got.keys() == {s.satellite for s in sent.signals}
        for s in sent.signals:
            one = got[s.satellite]
            assert one.pseudorange_m == pytest.approx(s.pseudorange_m, abs=3e-4)
            assert one.range_rate_m_s == pytest.approx(s.range_rate_m_s, abs=1e-4)
            assert one.carrier_cycles == pytest.approx(s.carrier_cycles, abs=1e-3)
    seen = {(s.system, s.prn) for s in again.epoch(0).signals}
    broadcast = {e.satellite: e for e in again.broadcast(1.0, seen)}
    got_first: dict[str, Ephemeris] = {}
    for e in events:
        if isinstance(e, Ephemeris):
            got_first.setdefault(e.satellite, e)
    assert broadcast.keys() <= got_first.keys()
    for name, e in broadcast.items():
        for field in ("week", "toe_s", "issue", "message", "healthy", "accuracy_m"):
            assert getattr(got_first[name], field) == getattr(e, field), (name, field)
        assert math.isclose(got_first[name].mean_anomaly, e.mean_anomaly, rel_tol=1e-12)
    bad = {"parity_bad", "ephemeris_mixed", "ephemeris_implausible", "rtcm_unreadable"}
    assert not bad & {name for name, n in decoder.counters.items() if n}


def test_rtklib_finds_the_true_position_in_our_stream() -> None:
    """Simulator, messages and observations at once, with nothing of ours on the other side."""
    truth = SCENARIOS["drive"].truth(60.0)
    receiver = GnssRaw(
        truth, GnssRawOptions(rate_hz=1.0), np.random.default_rng(1), (2400, 40000.0)
    )
    stream = GnssRawStream(receiver, "ubx")
    data = b"".join(stream.bytes_of(k) for k in range(len(receiver)))
    raw = rtk.raw_t()
    assert rtk.init_raw(raw, rtk.STRFMT_UBX)
    options = rtk.prcopt_default
    options.mode, options.navsys = rtk.PMODE_SINGLE, rtk.SYS_GPS | rtk.SYS_CMP
    options.ionoopt, options.tropopt = rtk.IONOOPT_BRDC, rtk.TROPOPT_SAAS
    k, errors, drifts = -1, [], []
    for byte in data:
        if rtk.input_ubx(raw, byte) != 1:
            continue
        k += 1
        solution, angles = rtk.sol_t(), rtk.Arr1Ddouble(2 * rtk.MAXOBS)
        status = rtk.Arr1Dssat_t(rtk.MAXSAT).ptr
        found = rtk.pntpos(
            raw.obs.data.ptr, raw.obs.n, raw.nav, options, solution, angles, status,
            rtk.Arr1Dchar(128),
        )  # fmt: skip
        if not found:  # the first epoch: its ephemerides come after it
            assert k == 0
            continue
        lat, lon, height = (float(x) for x in truth.at(receiver.t_s[k : k + 1]).position[0])
        off = np.array([solution.rr[i] for i in range(3)]) - np.array(to_ecef(lat, lon, height))
        errors.append(ned_axes(lat, lon).T @ off)
        drifts.append([solution.rr[i] for i in range(3, 6)])
    assert k == len(receiver) - 1
    # Evening: the broadcast models leave a metre or two, mostly in height.
    mean = np.abs(np.mean(errors, axis=0))
    assert mean[:2].max() < 1.0
    assert mean[2] < 4.0
    assert np.std(errors, axis=0).max() < 1.0
    assert np.abs(np.mean(drifts, axis=0)).max() < 0.03
