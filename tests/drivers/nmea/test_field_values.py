"""Fields of sentences that verify and yet cannot be true; the same ones as `pynmeagps` reads."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pynmeagps.exceptions import NMEATypeError
from pynmeagps.nmeahelpers import dmm2ddd
from pynmeagps.nmeareader import NMEAReader

from drivers.measurements import (
    PositionFix,
)
from drivers.nmea.fields import typed_fields
from tests.drivers.nmea.sentences import (
    GGA,
    GGA_SW,
    GNS,
    GSA,
    GST,
    HDT,
    RMC,
    THS,
    VTG,
    ZDA,
    changed,
    decode,
    fixes,
    made,
)


@pytest.mark.parametrize(
    ("sentence", "old", "new"),
    [
        (GGA, "3958.12345", "3960.12345"),
        (GGA, "3958.12345", "9158.12345"),
        (GGA, "11619.54321", "18019.54321"),
        (GGA, "3958.12345", "-958.12345"),
        (GGA, ",N,", ",,"),
        (GGA, ",N,", ",X,"),
        (GGA, "0.62", "nan"),
        (GGA, "45.300", "inf"),
        (GGA, "E,4,18", "E,4,x"),
        (GGA, "021429.00", "241429.00"),
        (GGA, "021429.00", "021460.00"),
        (GGA, "021429.00", "2:14:29"),
        (RMC, "19.438", "-1.0"),
        (RMC, "090.00", "361.0"),
        (GST, "0.014", "-0.1"),
        (ZDA, ",06,", ",13,"),
        (HDT, "350.00", "400.0"),
    ],
)
def test_a_field_that_cannot_be_true_refuses_the_sentence_only(
    sentence: str, old: str, new: str
) -> None:
    found, one = decode(changed(sentence, old, new), GGA)
    assert one.counters["bad_field"] == 1
    assert len(fixes(found)) == 1


def test_cut_sentences_that_verify() -> None:
    for whole in (GGA, RMC, VTG, GNS, GSA, GST, ZDA, HDT, THS):
        fields = whole[1:-3].split(",")
        for length in range(1, len(fields)):
            decode(made(",".join(fields[:length])), GGA)


@given(
    st.sampled_from(["GGA", "RMC", "VTG", "GNS", "GSA", "GST", "ZDA", "HDT", "THS"]),
    st.lists(
        st.sampled_from(["", "021429.00", "9999999", "A", "nan", "-1", "3958.1", "N", "E", "6"])
        | st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=8),
        max_size=20,
    ),
)
@settings(max_examples=300)
def test_no_verified_sentence_raises(formatter: str, fields: list[str]) -> None:
    body = ",".join(["GN" + formatter, *fields]).replace("$", "").replace("*", "")
    for measurement in decode(made(body), GGA, RMC)[0]:
        if isinstance(measurement, PositionFix):
            assert math.isfinite(measurement.lat_rad)
            assert math.isfinite(measurement.lon_rad)


_ANGLES = {
    **{("GGA", 1): "lat", ("GGA", 3): "lon", ("GNS", 1): "lat", ("GNS", 3): "lon"},
    **{("RMC", 2): "lat", ("RMC", 4): "lon"},
}


@given(
    st.sampled_from([GGA, GGA_SW, RMC, VTG, GNS, GSA, GST, ZDA, HDT, THS]),
    st.dictionaries(
        st.integers(1, 14),
        st.sampled_from(["", "021429.00", "A", "nan", "-1", "3958.1", "N", "S", "W", "7", "1e5"])
        | st.sampled_from(["201126", "311299", "320199", "11619.54321", "x", "inf"]),
        max_size=2,
    ),
    st.integers(1, 20),
)
def test_fields_as_pynmeagps_has_them(whole: str, other: dict[int, str], length: int) -> None:
    address, *fields = whole[1:-3].split(",")
    printed = [other.get(k, text) for k, text in enumerate(fields, start=1)][:length]
    try:
        wanted = NMEAReader.parse(made(",".join([address, *printed])), validate=0)
    except NMEATypeError:
        # Here an angle that is none raises as well: without it the other bad field is met.
        plain = [
            "" if text and (address[2:], k) in _ANGLES and dmm2ddd(text) == "" else text
            for k, text in enumerate(printed)
        ]
        with pytest.raises(ValueError, match=r"could not convert|invalid literal"):
            typed_fields(address[2:], plain)
        return
    angles = (_ANGLES.get((address[2:], k), "") for k, text in enumerate(printed) if text)
    if any(name and getattr(wanted, name) == "" for name in angles):  # passed there as empty
        with pytest.raises(ValueError, match="not an angle"):
            typed_fields(address[2:], printed)
        return
    found = typed_fields(address[2:], printed)
    # Its time is an object that nobody asks for; satellites are numbered there.
    for name in found.keys() - {"printed", "time", "svid"}:
        assert repr(found[name]) == repr(getattr(wanted, name))
