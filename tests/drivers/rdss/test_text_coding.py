"""Texts in a terminal's three encodings, and what each takes of a card's allowance."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.rdss.text_coding import (
    EncodedText,
    card_level_bits,
    encode_digits,
    encode_shortest,
    printable_text,
)


@pytest.mark.parametrize(
    ("text", "encoding", "bits"),
    [
        ("12345", "code", 20),
        ("1234", "code", 16),
        ("你好", "chinese", 28),
        ("go 2 你", "mixed", 64),
    ],
)
def test_a_text_takes_the_encoding_that_needs_least(text: str, encoding: str, bits: int) -> None:
    wording = encode_shortest(text)
    assert (wording.encoding, wording.bits) == (encoding, bits)
    assert printable_text(wording) == text


@given(st.text(max_size=60).filter(lambda t: t.isprintable()))
def test_any_printable_text_comes_back(text: str) -> None:
    assert printable_text(encode_shortest(text)) == text


@given(st.binary(max_size=60), st.sampled_from(("chinese", "code", "mixed")), st.booleans())
def test_any_bytes_are_read_as_a_line_that_can_be_shown_or_as_none(
    data: bytes, encoding: str, odd: bool
) -> None:
    text = printable_text(EncodedText(data, encoding, odd and bool(data)))  # type: ignore[arg-type]
    assert text is None or text.isprintable()


def test_levels_have_the_lesser_of_both_public_tables_and_level_0_has_nothing() -> None:
    assert [card_level_bits(level) for level in range(7)] == [0, 110, 360, 580, 848, 848, 848]


def test_an_odd_number_of_digits_is_no_half_byte_more() -> None:
    assert encode_digits("123") == EncodedText(b"\x12\x30", "code", True)
