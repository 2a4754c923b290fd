"""Why a receiver's bytes give no fix: the right cause, and what to switch on."""

from __future__ import annotations

from collections.abc import Callable
from datetime import date
from functools import reduce
from operator import xor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.nmea.decoder import NmeaDecoder
from drivers.nmea.reasons import MANY, MOST_NAMES, implausible_date
from drivers.nmea.unsupported_protocols import protocol_sentence
from tests.drivers.nmea.sentences import (
    GGA,
    GGA_NO_FIX,
    GGA_SW,
    GSA,
    GSA_2D,
    RMC,
    VTG,
    ZDA,
    changed,
    decode,
    decoder,
    made,
    wire,
)

UBX = b"\xb5\x62\x05\x01\x02\x00\x06\x01\x0f\x38"
"""ACK-ACK of CFG-MSG."""
RTCM = b"\xd3\x00\x02\x3e\xd0\x9b\xdc\x0b"


def fed(data: bytes) -> NmeaDecoder:
    one = decoder()
    one.feed(data, 1)
    one.flush()
    return one


def minutes(sentence: str, count: int) -> list[str]:
    return [changed(sentence, "0214", f"02{14 + i}") for i in range(count)]


def two_dimensional(minute: int) -> list[str]:
    return [changed(changed(GGA, ",18,", ",03,"), "0214", f"02{minute}"), GSA_2D]


# ------------------------------------------------------------------ nothing verifies


def test_sentences_without_checksums_are_not_another_baud_rate() -> None:
    bare = "".join(s.partition("*")[0] + "\r\n" for s in (GGA, ZDA, VTG)).encode()
    assert "without a checksum" in fed(bare).cause
    assert "without a checksum" in fed(bare.replace(b"\r", b"*\r")).cause
    # One that lost its own says nothing yet.
    assert fed(bare[: bare.index(b"\r\n") + 2]).cause == ""


def test_other_frames_on_the_wire_are_named() -> None:
    cause = fed(UBX * 3).cause
    assert cause.startswith("UBX frames arrive, but no NMEA: switch on NMEA output on this port")
    assert 'driver = "ubx"' in cause
    assert fed(bytes(range(128, 192)) * 20).cause == ""


def sirf(payload: bytes) -> bytes:
    total = (sum(payload) & 0x7FFF).to_bytes(2, "big")
    return b"\xa0\xa2" + len(payload).to_bytes(2, "big") + payload + total + b"\xb0\xb3"


def skytraq(payload: bytes) -> bytes:
    check = bytes([reduce(xor, payload, 0)])
    return b"\xa0\xa1" + len(payload).to_bytes(2, "big") + payload + check + b"\r\n"


def allystar(payload: bytes) -> bytes:
    body = b"\x06\x01" + len(payload).to_bytes(2, "little") + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return b"\xf1\xd9" + body + bytes((a, b))


def sbf(payload: bytes) -> bytes:
    size = 8 + len(payload) + -len(payload) % 4
    return b"$@\x12\x34\xa7\x0f" + size.to_bytes(2, "little") + payload.ljust(size - 8, b"\x00")


def novatel(payload: bytes) -> bytes:
    head = b"\xaa\x44\x12\x1c" + bytes(4) + len(payload).to_bytes(2, "little") + bytes(18)
    return head + payload + b"\x01\x02\x03\x04"


def unicore(payload: bytes) -> bytes:
    head = b"\xaa\x44\xb5\x00\x11\x00" + len(payload).to_bytes(2, "little") + bytes(16)
    return head + payload + b"\x01\x02\x03\x04"


def casic(payload: bytes) -> bytes:
    return b"\xba\xce" + len(payload).to_bytes(2, "little") + b"\x01\x03" + payload + bytes(4)


def mtk(payload: bytes) -> bytes:
    return (
        b"\x04\x24" + (len(payload) + 9).to_bytes(2, "little") + b"\x00\x00" + payload + b"\x07\r\n"
    )


def zodiac(payload: bytes) -> bytes:
    words = [0x81FF, 1000, len(payload) // 2, 0]
    head = b"".join(w.to_bytes(2, "little") for w in (*words, -sum(words) & 0xFFFF))
    return head + payload + b"\x00\x00"


def oncore(payload: bytes) -> bytes:
    body = b"Ha" + payload
    return b"@@" + body + bytes([reduce(xor, body, 0)]) + b"\r\n"


def navcom(payload: bytes) -> bytes:
    body = b"\xb1" + (len(payload) + 4).to_bytes(2, "little") + payload
    return b"\x02\x99\x66" + body + bytes([reduce(xor, body, 0)]) + b"\x03"


def italk(payload: bytes) -> bytes:
    return b"<!#\x7f\x03\x00" + bytes([len(payload) // 2]) + payload + b"\x12\x34>"


def geostar(payload: bytes) -> bytes:
    return b"PSGG\x20\x00" + (len(payload) // 4).to_bytes(2, "little") + payload + bytes(4)


def superstar(payload: bytes) -> bytes:
    body = b"\x01\x71\x8e" + bytes([len(payload)]) + payload
    return body + (sum(body) & 0xFFFF).to_bytes(2, "little")


def greis(payload: bytes) -> bytes:
    return b"~~005" + payload[:5] + b"\nPV%03X" % len(payload) + payload


def rtcm_2(payload: bytes) -> bytes:
    return bytes(0x40 | byte & 0x3F for byte in payload)


def tsip(payload: bytes) -> bytes:
    return b"\x10\x8f" + payload.replace(b"\x10", b"\x10\x10") + b"\x10\x03"


def novatel_text(payload: bytes) -> bytes:
    return (
        b"#BESTPOSA,COM1,0,83.5,FINESTEERING,2171,123456.000,02000000,cdba,32768;SOL_COMPUTED,"
        b"SINGLE,51.1,-114.0,1064.9*0a1b2c3d\r\n"
    )


def novatel_short(payload: bytes) -> bytes:
    return b"%INSPVASA,2171,123456.000;2171,123456.000,51.1,-114.0,1064.9,0.1,0.2*0a1b2c3d\r\n"


def gpsd(payload: bytes) -> bytes:
    return b'{"class":"TPV","device":"/dev/ttyS0","mode":3}\r\n'


def stripped(payload: bytes) -> bytes:
    return GGA[1:].encode() + b"\r\n"


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (sbf, "SBF"),
        (novatel, "NovAtel or Unicore"),
        (unicore, "NovAtel or Unicore"),
        (novatel_text, "text logs of NovAtel"),
        (novatel_short, "short headers"),
        (sirf, "SiRF"),
        (skytraq, "SkyTraq"),
        (allystar, "Allystar"),
        (casic, "CASIC"),
        (mtk, "MTK"),
        (zodiac, "Zodiac"),
        (oncore, "OnCore"),
        (navcom, "NavCom"),
        (italk, "iTalk"),
        (geostar, "GeoStar"),
        (superstar, "SuperStar"),
        (greis, "GREIS"),
        (rtcm_2, "RTCM 2"),
        (tsip, "TSIP"),
        (gpsd, "gpsd's JSON"),
        (stripped, "without its $"),
    ],
)
def test_a_protocol_that_is_not_read_is_named(make: Callable[[bytes], bytes], name: str) -> None:
    payload = bytes([0x41, 0, 0xC3, 7, 0x55, 0x81, 0x2C, 0x3F] * 3)
    stream = make(payload) * 6
    assert name in protocol_sentence(stream)
    cause = fed(b"\x00\x7f" + stream).cause
    assert name in cause
    assert ": " in cause, "what would do"
    one = decoder()
    for i in range(len(stream)):
        one.feed(stream[i : i + 1], i)
    assert one.cause == fed(stream).cause


def test_what_looks_like_sentences_in_a_binary_protocol_is_not_the_cause() -> None:
    """gpsd's logs bu303-climbing (SiRF), greis-reset and trimble-res720-dr."""
    bad = b"$GPGGA,1*00\r\n$GPGGA,1\r\n"
    for make in (sirf, greis, tsip):
        assert "protocol" in fed(make(bad) * 2 + bad + make(bad) * 4).cause


def test_a_text_now_and_then_beside_ubx_is_not_what_to_switch_on() -> None:
    """gpsd's log ublox-neo-m8l: TXT of the start, and UBX."""
    assert 'driver = "ubx"' in fed(made("GNTXT,01,01,02,PF=3FF").encode() + b"\r\n" + UBX * 3).cause


@given(st.binary(max_size=4000))
def test_noise_is_no_protocol_and_costs_little(data: bytes) -> None:
    assert isinstance(protocol_sentence(data), str)
    assert isinstance(fed(data).cause, str)


@pytest.mark.parametrize(
    "sync",
    [
        b"~~005",
        b"<!",
        b"PSGG",
        b"\x02\x99\x66",
        b"\x01\x02\xfd",
        b"\xa0\xa2",
        b"\xf1\xd9",
        b"\xaa\x44\x12",
        b"$@",
        b"#AAAA,",
        b"@@AA",
    ],
)
def test_a_stream_of_beginnings_is_none(sync: bytes) -> None:
    assert protocol_sentence((sync + b"\x0f\xff\x0f") * 400) == ""


# ------------------------------------------------------------------ sentences, and no fix


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ([changed(GGA, "GN", "LC"), changed(RMC, "GN", "LC")], "talker LC (Loran-C)"),
        ([made("ECGLL,3958.1,N,11619.5,E,021429,A")], "talker EC (a chart display)"),
        ([changed(RMC, "GN", "XY")], "talker XY arrive"),
        ([made("GPTXT,01,01,02,u-blox"), made("GPGSV,1,1,00")], "(TXT, GSV), but none that counts"),
        ([made("GPGSV,1,1,00")], "switch on GGA and RMC"),
        ([made("HEHDT,30.0,T"), made("HEROT,0.1,A")], "compass arrive (HDT), and no position: a s"),
        ([made("APXDR,A,3.8,D,ROLL"), made("APHDM,218.6,M")], 'driver = "compass" reads them'),
        ([made("PUBX,00,021429.00,3958.1,N,11619.5,E,45.3,G3,2.1,2.0")], "($PUBX,00: u-blox)"),
        (
            [made("PTNL,GGK,021429.00,061925,3958.1,N,11619.5,E,3,12,1,EHT45,M")],
            "($PTNL,GGK: Trimble)",
        ),
        ([made("PSTI,030,021429.0,A,3958.1,N,11619.5,E,45.3")], "($PSTI,030: SkyTraq)"),
        ([made("PQTMPVT,1,31075000,20250619,021429.000,,3")], "($PQTMPVT: Quectel)"),
        ([made("PSSN,HRP,021429.00,190625,184.1,1.2,0.3")], "($PSSN,HRP: Septentrio)"),
        ([made("PMTK001,314,3")], "($PMTK001,314: MediaTek)"),
        ([made("KSXT,20250619021429.00,116.3,39.9,45.3,350.0")], "($KSXT: Unicore"),
        ([made("GNHPD,2319,353687.0,350.0,0.1,0.2")], "($GNHPD: ComNav"),
        ([made("PASHR,021429.00,350.0,T,0.1,0.2"), VTG], "which are not read: switch on GGA, RMC"),
        ([VTG, GSA, ZDA], "(VTG, GSA, ZDA), but none has a position: switch on GGA"),
        ([GGA_NO_FIX], "the receiver has no fix"),
        ([changed(RMC, "GN", "PQ")], "positions of talker PQ arrive"),
        ([made("GPRMC,,A,3958.1,N,11619.5,E,5.2,87.5,190625,,,A")] * 3, "without a time of day"),
        ([made("gngga,021429,3958.1,N,11619.5,E,1,07,1.0,9.0,M,9.0,M,,")] * MANY, "small letters"),
        ([changed(GGA, "N,116", "X,116")] * 4, "fields that cannot be true"),
        ([VTG, *["$GPGGA,1,2"] * MANY], "without a checksum"),
    ],
)
def test_why_there_is_no_fix(said: list[str], words: str) -> None:
    assert words in fed(wire(*said, *said)).cause


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"!AIVDM,1,1,,A,13HOI:0P0000VOHLCnHQKwvL05Ip,0*23\r\n" * 4, "AIS (!AIVDM) arrives"),
        (b"\x10\x02\x93\x13" + bytes(range(48, 68)) + b"\x77\x10\x03", "NMEA 2000 by an Actisense"),
        (b"login: \r\nLinux pi 6.1.0 aarch64\r\nlogin: \r\n", "such as 'Linux pi 6.1.0 aarch64'"),
        (b"\r\n+CGPSINFO: 4712.3,N,00812.3,E\r\n\r\nOK\r\n", "'+CGPSINFO: 4712.3,N"),
        (b"".join(UBX[:-1] + bytes([k]) for k in range(9)), "9 UBX frames arrive with wrong check"),
    ],
)
def test_what_is_on_the_port_instead_is_named(data: bytes, words: str) -> None:
    assert words in fed(data * 3 if b"UBX" not in words.encode() else data).cause


def test_a_date_that_is_none_is_told() -> None:
    said = [changed(each, "190625", "320126") for each in minutes(RMC, 3)]
    assert "'320126'" in fed(wire(GGA, *said)).cautions["bad_date"]


def test_a_parity_bit_is_no_wrong_baud_rate() -> None:
    """Seven data bits and even parity, read as eight bits."""
    stream = bytes(b | (b.bit_count() & 1) << 7 for b in wire(GGA, RMC, VTG))
    assert fed(stream).cause.startswith("NMEA with a parity bit arrives")


def test_a_sentence_that_stands_in_for_one_with_a_bad_field_says_so() -> None:
    said = [s for m in minutes(RMC, 6) for s in (changed(GGA, ",4,", ",-1,"), m)]
    told = fed(wire(*said)).cautions["rmc_alone"]
    assert "(other sentences have fields that cannot be true)" in told


def test_names_of_nonsense_are_bounded() -> None:
    one = fed(wire(*(made(f"GP{a}{b}X,1") for a in "ABCDEFGH" for b in "ABCDEFGH")))
    assert len(one.received.unused) == MOST_NAMES
    assert len(one.cause) < 200


# ------------------------------------------------------------------ fixes, but poorer ones


def test_an_implausible_date_is_told_with_what_was_done() -> None:
    rolled = [changed(changed(RMC, "190625", "030501"), "0214", f"02{m}") for m in (14, 15)]
    found, one = decode(GGA, rolled[0])
    assert one.cautions == {
        "implausible_date": "the receiver's date is 2001-05-03, before 2025-01-01: its dates are "
        "not used, its times of day are"
    }
    assert len(found) == 1, "the fix is used, and tells no UTC"


def test_the_rollover_of_the_gps_week_is_told() -> None:
    text = implausible_date(date(2007, 8, 11), date(2026, 11, 20))
    assert text.endswith("; if 2027-03-27 is right, 1024 weeks later, its GPS week has rolled over")
    assert "rolled" not in implausible_date(date(1980, 1, 6), date(2026, 11, 20))
    assert "too far ahead" in implausible_date(date(2150, 1, 6), date(2026, 11, 20))


@pytest.mark.parametrize(
    ("said", "caution"),
    [
        ([GGA_SW, changed(GGA_SW, "021429", "021430")], "height_above_sea"),
        (minutes(RMC, 3), "rmc_alone"),
        (minutes(made("GPGLL,3958.1,N,11619.5,E,021429,A"), 3), "gll_alone"),
        ([changed(GGA, "GN", "II"), changed(RMC, "GN", "II")], "integrated"),
        ([changed(GGA, "45.300", ""), RMC], "height_missing"),
        ([s for m in range(14, 26) for s in two_dimensional(m)], "height_not_measured"),
        ([s for m in range(14, 20) for s in two_dimensional(m)], None),
        ([GGA, changed(RMC, ",A,", ",Z,")], "unknown_status"),
        ([GGA, RMC, *["$GPVTG,1,2"] * MANY], "checksum_missing"),
        ([GGA, RMC, made("HEHDT,30.0,T")], "compass_left_out"),
        ([GGA, RMC, made("HCHDG,30.0,,,2.0,E")], "compass_left_out"),
        ([GGA, RMC, made("PSSN,HRP,021429.00,190625,184.1,1.2,0.3")], "attitude_left_out"),
        ([GGA, RMC, made("PTNL,AVR,021429.00,+149.4,Yaw,+0.1,Tilt")], "attitude_left_out"),
        ([GGA, RMC], None),
    ],
)
def test_what_makes_fixes_poorer_is_told(said: list[str], caution: str | None) -> None:
    one = fed(wire(*said))
    assert one.counters["fixes"] >= 1
    assert list(one.cautions) == ([] if caution is None else [caution])
    assert all(len(text) < 220 for text in one.cautions.values())
