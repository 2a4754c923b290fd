"""RDSS codecs against any fix, any field, and noise."""

from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.messages import Fix
from tests.drivers.rdss.frames import FRAMES, MODULES

fixes = st.builds(
    Fix,
    user=st.integers(1, binary_4_0.MAX_USER),
    time_of_day_s=st.integers(0, 86400).map(float),
    lat_deg=st.integers(0, 90 * 36000).map(lambda t: t / 36000),
    lon_deg=st.integers(0, 180 * 36000).map(lambda t: t / 36000),
    height_m=st.integers(-9999, 9999).map(float),
    height_anomaly_m=st.integers(-255, 255).map(float),
    precision_class_m=st.sampled_from((20, 100)),
    kind=st.sampled_from(("own", "query")),
    emergency=st.booleans(),
    multi_value=st.booleans(),
)


@pytest.mark.parametrize("family", MODULES)
@given(fix=fixes)
@settings(max_examples=100)
def test_fix_survives_the_wire(family: str, fix: Fix) -> None:
    (got,) = MODULES[family].Decoder().feed(MODULES[family].encode(fix))
    assert isinstance(got, Fix)
    assert abs(got.lat_deg - fix.lat_deg) < 1e-6
    assert abs(got.lon_deg - fix.lon_deg) < 1e-6
    for name in ("user", "time_of_day_s", "height_m", "height_anomaly_m", "precision_class_m"):
        assert getattr(got, name) == getattr(fix, name)
    assert (got.kind, got.emergency, got.multi_value) == (fix.kind, fix.emergency, fix.multi_value)


pieces = st.one_of(
    st.binary(max_size=40),
    st.sampled_from([b"$", b"$DWXX\x00\x1f", b"$BDDWR,", b"*00\r\n", b"$ABCD\x00\xf0", b"\r\n"]),
    st.sampled_from(FRAMES["4.0"] + FRAMES["2.1"]),
)


@pytest.mark.parametrize("family", MODULES)
@given(chunks=st.lists(pieces, max_size=30))
@example(chunks=[b"$BDFKI,\xb2,,N,\xb2,\xb2*00\r\n"])
@settings(max_examples=150)
def test_any_bytes_are_survived_and_the_buffer_is_bounded(family: str, chunks: list[bytes]) -> None:
    decoder = MODULES[family].Decoder()
    for chunk in chunks:
        decoder.feed(chunk)
        assert len(decoder._buffer) <= 512
        assert decoder.awaited_bytes == 0 or decoder.awaited_bytes > len(decoder._buffer)
    while decoder.awaited_bytes:
        decoder.expire()
    assert len(decoder._buffer) == 0


@given(fields=st.text(alphabet="0123456789.,-+NYAVMEWSLH\xb2", max_size=60))
@settings(max_examples=200)
def test_any_fields_under_a_good_checksum_are_survived(fields: str) -> None:
    for name in ("BDFKI", "BDDWR", "BDICI", "BDBSI", "BDZDA", "BDZTI", "BDTXR", "CCDWA", "CCRMO"):
        body = f"{name},{fields}".encode("latin-1")
        raw = b"$%b*%02X\r\n" % (body, text_2_1.checksum(body))
        decoder = text_2_1.Decoder()
        assert len(decoder.feed(raw)) == 1 or decoder.counters["bad_field"] == 1


@given(
    name=st.sampled_from(sorted(binary_4_0.LENGTHS)),
    payload=st.binary(max_size=229),
)
@settings(max_examples=300)
def test_any_payload_under_a_good_checksum_is_survived(name: str, payload: bytes) -> None:
    least, greatest = binary_4_0.LENGTHS[name]
    payload = payload[: greatest - 11].ljust(least - 11, b"\x00")
    decoder = binary_4_0.Decoder()
    decoder.feed(binary_4_0.frame(name, 1, payload))
    assert decoder.counters["frames"] + decoder.counters["bad_field"] == 1


@pytest.mark.parametrize("family", MODULES)
@given(garbage=st.binary(max_size=300), which=st.integers(0, 1000))
@settings(max_examples=150)
def test_a_good_frame_behind_garbage_is_found(family: str, garbage: bytes, which: int) -> None:
    good = FRAMES[family][which % len(FRAMES[family])]
    decoder = MODULES[family].Decoder()
    got = decoder.feed(garbage) + decoder.feed(good)
    while decoder.awaited_bytes:
        got += decoder.expire()
    (message,) = MODULES[family].Decoder().feed(good)
    assert message in got
