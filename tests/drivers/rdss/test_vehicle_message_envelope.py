"""Position reports and envelopes: exact to their steps, never sharper than the solution, and read
from any bytes without harm."""

from __future__ import annotations

import contextlib
import math
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.rdss.position_report_coding import (
    MODES,
    REPORT,
    SHORT_REPORT,
    PositionReport,
    decode_report,
    encode_report,
    encode_short,
)
from drivers.rdss.text_coding import EncodedText, card_level_bits, encode_bytes
from drivers.rdss.vehicle_message_envelope import (
    RECEIPT,
    TEXT,
    Carriage,
    EnvelopeDamagedError,
    EnvelopeLengthError,
    EnvelopeVersionError,
    Receipt,
    decode_receipt_body,
    decode_text_body,
    encode_envelope,
    encode_receipt_body,
    encode_text_body,
    envelope_crc,
    envelope_from_text,
    envelope_to_text,
)
from fusiond.navigation.solution import Mode

sigmas = st.one_of(st.none(), st.floats(0.0, 1e6))
reports = st.builds(
    PositionReport,
    t_s=st.floats(0.0, 2**32 - 1),
    lat_deg=st.floats(-90.0, 90.0),
    lon_deg=st.floats(-180.0, 180.0),
    mode=st.sampled_from(MODES),
    sd_ned_m=st.tuples(sigmas, sigmas, sigmas),
    height_m=st.one_of(st.none(), st.floats(-1000.0, 100_000.0)),
    speed_m_s=st.one_of(st.none(), st.floats(0.0, 600.0)),
    course_deg=st.one_of(st.none(), st.floats(0.0, 360.0)),
)
carriages = st.sampled_from(get_args(Carriage))


def close(a: float | None, b: float | None, step: float) -> bool:
    return a is b is None or (a is not None and b is not None and abs(a - b) <= step)


def test_the_modes_are_those_of_a_solution() -> None:
    assert set(MODES) == {str(mode) for mode in Mode}


@given(reports, carriages)
def test_a_report_comes_back_to_its_steps_in_every_carriage(
    report: PositionReport, carriage: Carriage
) -> None:
    envelope = envelope_from_text(
        envelope_to_text(encode_envelope(REPORT, encode_report(report)), carriage)
    )
    assert envelope is not None
    got = decode_report(envelope.kind, envelope.body)
    assert 0.0 <= report.t_s - got.t_s <= 1 / 256
    assert close(got.lat_deg, report.lat_deg, 4.2e-8)
    assert close(got.lon_deg, report.lon_deg, 8.4e-8)
    assert close(got.height_m, report.height_m, 0.0501)
    assert close(got.speed_m_s, report.speed_m_s, 0.00501)
    assert (got.course_deg is None) == (report.course_deg is None)
    if got.course_deg is not None and report.course_deg is not None:
        turn = math.remainder(got.course_deg - report.course_deg, 360.0)
        assert abs(turn) <= 360.0 / 2**16
    assert got.mode == report.mode
    for told, true in zip(got.sd_ned_m, report.sd_ned_m, strict=True):
        if told is not None:
            assert true is not None
            assert max(true, 0.01) * (1 - 1e-9) <= told <= max(true, 0.01) * 1.06
        else:
            assert true is None or true > 22_000


@given(reports)
def test_a_short_report_fits_level_1_and_claims_no_more_than_the_solution(
    report: PositionReport,
) -> None:
    wording = envelope_to_text(encode_envelope(SHORT_REPORT, encode_short(report)), "binary")
    assert wording.bits <= card_level_bits(1)
    envelope = envelope_from_text(wording)
    assert envelope is not None
    got = decode_report(envelope.kind, envelope.body)
    assert (got.t_s, got.dated) == (math.floor(report.t_s) % 86400, False)
    assert close(got.lat_deg, report.lat_deg, 1.1e-5)
    assert close(got.lon_deg, report.lon_deg, 2.2e-5)
    north, east = report.sd_ned_m[:2]
    told = got.sd_ned_m[0]
    if told is not None:
        assert north is not None
        assert east is not None
        assert told >= max(north, east) * (1 - 1e-9)


@given(reports, carriages)
def test_every_full_report_fits_level_2(report: PositionReport, carriage: Carriage) -> None:
    assert envelope_to_text(
        encode_envelope(REPORT, encode_report(report)), carriage
    ).bits <= card_level_bits(2)


@given(st.one_of(reports), st.data())
def test_what_was_read_is_written_as_the_same_bytes(
    report: PositionReport, data: st.DataObject
) -> None:
    body = encode_report(report)
    assert encode_report(decode_report(REPORT, body)) == body


@pytest.mark.parametrize(
    "wrong", [{"lat_deg": 90.1}, {"lon_deg": math.nan}, {"t_s": -1.0}, {"t_s": 2.0**32}]
)
def test_a_place_that_is_none_is_not_reported(wrong: dict[str, float]) -> None:
    place = {"t_s": 0.0, "lat_deg": 0.0, "lon_deg": 0.0, **wrong}
    with pytest.raises(ValueError, match="is no"):
        encode_report(PositionReport(mode="navigating", **place))


@given(st.integers(0, 65535), st.binary(max_size=200), carriages)
def test_texts_and_receipts_come_back(number: int, text: bytes, carriage: Carriage) -> None:
    wording = envelope_to_text(encode_envelope(TEXT, encode_text_body(number, text)), carriage)
    envelope = envelope_from_text(wording)
    assert envelope is not None
    assert decode_text_body(envelope.body) == (number, text)
    receipted = Receipt(number, envelope.crc)
    answer = envelope_from_text(
        envelope_to_text(encode_envelope(RECEIPT, encode_receipt_body(receipted)), carriage)
    )
    assert answer is not None
    assert decode_receipt_body(answer.body) == receipted


@given(reports, st.integers(0, 26), st.integers(1, 255))
def test_no_changed_byte_is_passed(report: PositionReport, at: int, flip: int) -> None:
    raw = bytearray(encode_envelope(REPORT, encode_report(report)))
    raw[at] ^= flip
    try:
        found = envelope_from_text(encode_bytes(bytes(raw)))
    except (EnvelopeLengthError, EnvelopeDamagedError, EnvelopeVersionError):
        return
    assert found is None  # no envelope by its mark: somebody's own text


@given(reports, st.integers(1, 26))
def test_a_cut_report_is_said_to_be_cut(report: PositionReport, kept: int) -> None:
    raw = encode_envelope(REPORT, encode_report(report))
    with pytest.raises(EnvelopeLengthError):
        envelope_from_text(encode_bytes(raw[:kept]))


def test_a_later_version_is_said_to_be_one() -> None:
    with pytest.raises(EnvelopeVersionError):
        envelope_from_text(encode_bytes(encode_envelope(7, b"\x02abc")))


@given(
    st.binary(max_size=80),
    st.sampled_from(("chinese", "code", "mixed")),
    st.booleans(),
)
def test_any_bytes_are_survived(payload: bytes, encoding: str, odd: bool) -> None:
    wording = EncodedText(payload, encoding, odd and bool(payload))  # type: ignore[arg-type]
    try:
        envelope = envelope_from_text(wording)
    except (EnvelopeLengthError, EnvelopeDamagedError, EnvelopeVersionError):
        return
    if envelope is not None and envelope.kind in (REPORT, SHORT_REPORT):
        with contextlib.suppress(ValueError):
            decode_report(envelope.kind, envelope.body)


@given(st.integers(1, 2), st.binary(min_size=24, max_size=24))
def test_any_body_under_a_good_check_is_a_report_or_refused(kind: int, body: bytes) -> None:
    body = body if kind == REPORT else body[:9]
    envelope = envelope_from_text(encode_bytes(encode_envelope(kind, body)))
    assert envelope is not None
    assert envelope.crc == envelope_crc(encode_envelope(kind, body))
    try:
        report = decode_report(kind, envelope.body)
    except ValueError:
        return
    assert abs(report.lat_deg) <= 90.0
    assert abs(report.lon_deg) <= 180.0
