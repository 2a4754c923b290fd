"""RDSS codecs against every worked and every real frame of the sheet, and damaged ones."""

from __future__ import annotations

import pynmeagps
import pytest

from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.messages import (
    FORBIDDEN,
    EncodeError,
    Feedback,
    Fix,
    Message,
    Outcome,
    StopRequest,
    TextRequest,
    Unknown,
)
from tests.drivers.rdss.frames import (
    BINARY,
    FRAMES,
    MODULES,
    READ,
    TEXT,
    WRITTEN,
    U,
    binary_fix,
    line,
    same,
)


@pytest.mark.parametrize(("family", "raw", "message"), READ)
def test_worked_frame_decodes_whole_and_split_at_every_byte(
    family: str, raw: bytes, message: Message
) -> None:
    for cut in range(len(raw)):
        decoder = MODULES[family].Decoder()
        got = decoder.feed(raw[:cut]) + decoder.feed(raw[cut:])
        assert len(got) == 1
        assert same(got[0], message)
        assert decoder.counters["garbage_bytes"] == 0
    decoder = MODULES[family].Decoder()
    got = [m for byte in raw for m in decoder.feed(bytes((byte,)))]
    assert len(got) == 1
    assert same(got[0], message)


@pytest.mark.parametrize(("family", "raw", "message"), WRITTEN)
def test_worked_frame_encodes(family: str, raw: bytes, message: Message) -> None:
    if isinstance(message, Fix):  # approx() is for comparing, not for encoding
        message = MODULES[family].Decoder().feed(raw)[0]
    assert MODULES[family].encode(message) == raw


@pytest.mark.parametrize("raw", FRAMES["2.1"])
def test_framing_agrees_with_pynmeagps(raw: bytes) -> None:
    body = raw.strip()[1:-3].decode("latin-1")
    assert pynmeagps.calc_checksum(body) == raw.strip()[-2:].decode()
    assert f"{text_2_1.checksum(body.encode('latin-1')):02X}" == pynmeagps.calc_checksum(body)


@pytest.mark.parametrize("family", MODULES)
@pytest.mark.parametrize("garbage", [b"", b"\x00$$\xff", b"$GARB", b"abc\r\n$", b"$DWXX\x00\xff"])
def test_glued_amid_garbage_all_frames_are_found(family: str, garbage: bytes) -> None:
    decoder = MODULES[family].Decoder()
    stream = b"".join(raw + garbage for raw in FRAMES[family]) + FRAMES[family][0]
    got = []
    for i in range(0, len(stream), 7):
        got += decoder.feed(stream[i : i + 7])
    assert len(got) == len(FRAMES[family]) + 1


def test_dollar_inside_a_binary_payload() -> None:
    inner = bytes.fromhex(BINARY[0][0])
    text = TextRequest(36, b"$" + inner + b"$$DWXX", "code", 0x042424)
    raw = binary_4_0.encode(text)
    assert raw.count(b"$") >= 6
    for cut in range(len(raw)):
        decoder = binary_4_0.Decoder()
        assert decoder.feed(raw[:cut]) + decoder.feed(raw[cut:]) == [text]


def test_dollar_inside_a_chinese_text() -> None:
    body = b"CCTXA,0242407,1,0,\xc4\xe3$5"
    raw = b"$%b*%02X\r\n" % (body, text_2_1.checksum(body))
    assert text_2_1.Decoder().feed(raw) == [TextRequest(242407, b"\xc4\xe3$5", "chinese")]


@pytest.mark.parametrize(
    ("family", "raw", "counter"),
    [
        ("4.0", bytes.fromhex(BINARY[1][0])[:-1] + b"\x00", "bad_checksum"),
        ("4.0", b"$DWXX\x00\x20" + bytes(40), "bad_length"),
        ("4.0", b"$DWXX\x10\x1f" + bytes(40), "bad_length"),
        ("4.0", b"$dwxx\x00\x1f" + bytes(40), "bad_name"),
        ("4.0", line(TEXT[0][0]), "other_family"),
        ("4.0", binary_4_0.frame("SJXX", 0, bytes((7, 234, 2, 30, 1, 1, 1))), "bad_field"),
        ("4.0", binary_4_0.frame("ABXX", 5, b"\x01\x02"), "unknown"),
        ("2.1", line("$BDICI,0242286,00242286,0000011,6,60,3,N,0*39"), "bad_checksum"),
        ("2.1", b"$BDICI," + b"1" * 600, "bad_length"),
        ("2.1", b"$BDICI,024\r\n", "bad_length"),
        ("2.1", b"$bdici,0*00\r\n", "bad_name"),
        ("2.1", bytes.fromhex(BINARY[1][0]), "other_family"),
        ("2.1", text_2_1.sentence("BDZDA", b"1,233307.00,31,02,2026,-08,00,0,0,0,Y"), "bad_field"),
        ("2.1", text_2_1.sentence("GNGGA", b"1,2,3"), "unknown"),
    ],
)
def test_damage_is_named_and_the_next_frame_is_found(family: str, raw: bytes, counter: str) -> None:
    decoder = MODULES[family].Decoder()
    _, good, message = next(row for row in WRITTEN if row[0] == family)
    got = decoder.feed(raw + good)
    while decoder.awaited_bytes:
        got += decoder.expire()
    assert got[-1] == message
    assert decoder.counters[counter] == 1


@pytest.mark.parametrize("cut", range(6))
def test_what_is_wrong_with_a_name_is_the_same_however_it_is_cut(cut: int) -> None:
    """Names of binary frames are capitals; what else ends with a zero is no frame of theirs."""
    decoder = text_2_1.Decoder()
    stream = b"$CcRM\0"
    assert decoder.feed(stream[:cut]) + decoder.feed(stream[cut:]) == []
    assert decoder.counters == {"bad_name": 1, "garbage_bytes": len(stream)}


@pytest.mark.parametrize("family", MODULES)
def test_a_frame_that_never_ends_is_given_up(family: str) -> None:
    decoder = MODULES[family].Decoder()
    begun, good = FRAMES[family][-1][:9], FRAMES[family][0]
    assert decoder.feed(begun) == []
    assert decoder.awaited_bytes > 0
    assert decoder.expire() == []
    assert decoder.counters["abandoned"] == 1
    assert decoder.awaited_bytes == 0
    assert len(decoder.feed(good)) == 1


# --------------------------------------------------------------------------- ambiguous fields


@pytest.mark.parametrize(
    ("h", "xi", "height", "anomaly"),
    [
        (0x000E, 0x0106, 14, -6),
        (0x800E, 0x8006, -14, -6),
        (0x400E, 0x4006, -14, -6),
        (0x3FFF, 0x00FF, 16383, 255),
    ],
)
def test_every_sign_bit_in_use_is_read(h: int, xi: int, height: float, anomaly: float) -> None:
    payload = bytes.fromhex("00000000 0B1C3247 7605 2F07 1822 3506".replace(" ", ""))
    raw = binary_4_0.frame("DWXX", U, payload + h.to_bytes(2, "big") + xi.to_bytes(2, "big"))
    (fix,) = binary_4_0.Decoder().feed(raw)
    assert isinstance(fix, Fix)
    assert (fix.height_m, fix.height_anomaly_m) == (height, anomaly)


@pytest.mark.parametrize(
    ("extra", "wait"),
    [
        ("00000025", 37.0),
        ("25000000", 37.0),
        ("00250000", 37.0),
        ("00000125", 293.0),
        ("00000000", None),
    ],
)
def test_wait_of_flag_4(extra: str, wait: float | None) -> None:
    raw = binary_4_0.frame("FKXX", U, b"\x04" + bytes.fromhex(extra))
    (feedback,) = binary_4_0.Decoder().feed(raw)
    assert feedback == Feedback(Outcome.FREQUENCY, wait_s=wait, code=4, user=U)


def test_high_altitude_fix_has_30_bytes() -> None:
    fix = binary_fix(height_m=20000.0, height_anomaly_m=0.0, high_altitude=True)
    raw = binary_4_0.encode(fix)
    assert len(raw) == 30
    assert same(binary_4_0.Decoder().feed(raw)[0], fix)


@pytest.mark.parametrize(
    ("reason", "outcome"),
    [
        (1, Outcome.FREQUENCY),
        (2, Outcome.SUPPRESSED),
        (3, Outcome.SILENCE),
        (4, Outcome.NOT_LOCKED),
        (5, Outcome.NO_CARD),
        (6, Outcome.NO_PERMISSION),
        (11, Outcome.CRC),
        (12, Outcome.OTHER),
    ],
)
def test_bds3_feedback_reasons(reason: int, outcome: Outcome) -> None:
    raw = text_2_1.sentence("BDFKI", f"082920,DWA,N,{reason},17".encode())
    (feedback,) = text_2_1.Decoder().feed(raw)
    inhibited = True if reason in (2, 3) else None
    assert feedback == Feedback(
        outcome, "DWA", 17.0, reason, inhibited=inhibited, time_of_day_s=30560
    )
    assert text_2_1.encode(feedback) == raw


@pytest.mark.parametrize("field", range(4))
def test_impossible_position_is_refused(field: int) -> None:
    bad = [("0", "9999.0000"), ("1", "X"), ("2", "18160.0000"), ("3", "N")][field][1]
    fields = ["2302.2434", "N", "11323.6667", "E"]
    fields[field] = bad
    text = f"1,0242286,084936.50,{','.join(fields)},14,M,-6,M,1,V,V,L"
    decoder = text_2_1.Decoder()
    assert decoder.feed(text_2_1.sentence("BDDWR", text.encode())) == []
    assert decoder.counters["bad_field"] == 1


# --------------------------------------------------------------------------- never sent


@pytest.mark.parametrize("name", sorted(FORBIDDEN))
def test_what_destroys_or_silences_is_never_encoded(name: str) -> None:
    for module in (binary_4_0, text_2_1):
        with pytest.raises(EncodeError):
            module.encode(Unknown(name, b"N"))
    with pytest.raises(EncodeError):
        binary_4_0.encode(StopRequest(0, name))
