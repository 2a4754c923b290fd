"""Text encodings of short messages, and the share of a card's limit that a text takes.

    chinese   GB 2312, two bytes a character          7 bits a byte in the air
    code      decimal digits, two a byte              4 bits a digit
    mixed     0xA4, then any bytes; a text in GB 18030   8 bits a byte, 0xA4 included

A card's communication level, 1 to 4, limits the length of a message. Public code has two tables,
for plain and for encrypted cards, and interprets the card's flag for that in opposite ways; so the
smaller limit is used. A card of level 0 may send nothing. A level above 4 belongs to a later system
and has the limit of level 4.
"""

from __future__ import annotations

from typing import NamedTuple

from drivers.rdss.mail import TextEncoding

PLAIN_BITS = (110, 408, 628, 848)
ENCRYPTED_BITS = (140, 360, 580, 1680)
LEVEL_BITS = (0, *map(min, PLAIN_BITS, ENCRYPTED_BITS))
"""Bits by communication level: 0, 110, 360, 580, 848."""
MIXED = b"\xa4"


class EncodedText(NamedTuple):
    """Encoded text: payload for TXSQ and CCTXA; `odd` as in `TextRequest`."""

    payload: bytes
    encoding: TextEncoding
    odd: bool = False

    @property
    def bits(self) -> int:
        """Size in a card's allowance."""
        if self.encoding == "chinese":
            return 7 * len(self.payload)
        return 8 * len(self.payload) - 4 * self.odd


def card_level_bits(comm_level: int) -> int:
    """Longest message (bits) from a card of this level."""
    return LEVEL_BITS[min(comm_level, len(LEVEL_BITS) - 1)]


def encode_shortest(text: str) -> EncodedText:
    """Encode a text as short as possible. Raises ValueError for characters outside GB 18030."""
    if text and text.isascii() and text.isdigit():
        return encode_digits(text)
    try:
        chinese = text.encode("gb2312")
    except UnicodeEncodeError:
        return encode_bytes(text.encode("gb18030"))
    if text and len(chinese) == 2 * len(text):
        return EncodedText(chinese, "chinese")
    return encode_bytes(chinese)


def encode_bytes(data: bytes) -> EncodedText:
    """Encode bytes as mixed."""
    return EncodedText(MIXED + data, "mixed")


def encode_digits(text: str) -> EncodedText:
    """Encode decimal digits, two a byte."""
    odd = len(text) % 2 == 1
    return EncodedText(bytes.fromhex(text + "0" * odd), "code", odd)


def printable_text(wording: EncodedText) -> str | None:
    """Printable text without control characters; None for other bytes."""
    if wording.encoding == "code":
        text = wording.payload.hex().upper()
        return text[:-1] if wording.odd else text
    try:
        text = wording.payload.removeprefix(MIXED).decode("gb18030")
    except UnicodeDecodeError:
        return None
    return text if text.isprintable() else _printable(text)


def _printable(text: str) -> str | None:
    """Text without line ends and tabs; None if other control characters show that it is no text."""
    flat = text.replace("\r", " ").replace("\n", " ").replace("\t", " ")
    return flat if flat.isprintable() else None
