"""Envelope of short messages between vehicles with fusiond: kind, version and check.

    0    1  0xF8 + kind
    1    n  body
    1+n  2  CRC-16 (polynomial 0x1021, start 0xFFFF) of all before, big-endian

    kind 1  position report          24 bytes (`report`)
    kind 2  short position report     9 bytes
    kind 3  text that asks for a receipt: number 2, length of the text 1, the text (GB 18030)
    kind 4  receipt: number 2, CRC of the message that came 2
    kind 5, 6  not used yet           kind 7  a later version, whose number is the next byte

The layout of a kind never changes: another layout is another kind. A card of level 1 sends 13 bytes
with 0xA4, and a version by itself would not fit. No text begins with 0xF8 or more, the part of
GB 18030 that is left to private use.

The carriage is what the terminal's message types allow:

    binary  mixed: the bytes as they are
    ascii   mixed: base 64, for a terminal or a centre that passes on printable characters only
    bcd     code: decimal digits of the number whose bytes are 0x01 and the envelope
"""

from __future__ import annotations

import base64
import binascii
from typing import Literal, NamedTuple

from drivers.rdss.messages import FieldError
from drivers.rdss.position_report_coding import FULL, REPORT, SHORT, SHORT_REPORT
from drivers.rdss.text_coding import MIXED, EncodedText, encode_bytes, encode_digits

MARK = 0xF8
TEXT, RECEIPT = 3, 4
BODY_BYTES = {REPORT: FULL.size, SHORT_REPORT: SHORT.size, RECEIPT: 4}
OVERHEAD = 3
MOST_TEXT = 255

Carriage = Literal["binary", "ascii", "bcd"]


class EnvelopeLengthError(FieldError):
    """Error: an envelope shorter or longer than it states."""


class EnvelopeDamagedError(FieldError):
    """Error: an envelope with a wrong check or contents."""


class EnvelopeVersionError(FieldError):
    """Error: an envelope of an unknown version or kind."""


class Envelope(NamedTuple):
    """Envelope; its `crc` identifies it in receipts."""

    kind: int
    body: bytes
    crc: int


class Receipt(NamedTuple):
    """Contents of a receipt: the sender's number of the message, and the message's CRC."""

    number: int
    crc: int


def encode_envelope(kind: int, body: bytes) -> bytes:
    """Envelope around a body, as bytes."""
    head = bytes((MARK | kind,)) + body
    return head + _crc(head).to_bytes(2, "big")


def envelope_crc(envelope: bytes) -> int:
    """CRC at the end of an envelope."""
    return int.from_bytes(envelope[-2:], "big")


def encode_text_body(number: int, text: bytes) -> bytes:
    """Body of a text that asks for a receipt. Raises ValueError for too long a text."""
    if len(text) > MOST_TEXT:
        raise ValueError(f"{len(text)} bytes of text, at most {MOST_TEXT}")
    return number.to_bytes(2, "big") + bytes((len(text),)) + text


def decode_text_body(body: bytes) -> tuple[int, bytes]:
    """Number and text of such a body. CutError where the text has another length."""
    if len(body) < 3 or len(body) - 3 != body[2]:
        raise EnvelopeLengthError("a text that is not as long as it says")
    return int.from_bytes(body[:2], "big"), body[3:]


def encode_receipt_body(receipted: Receipt) -> bytes:
    """Body of a receipt."""
    return receipted.number.to_bytes(2, "big") + receipted.crc.to_bytes(2, "big")


def decode_receipt_body(body: bytes) -> Receipt:
    """Contents of a receipt."""
    return Receipt(int.from_bytes(body[:2], "big"), int.from_bytes(body[2:], "big"))


def envelope_to_text(envelope: bytes, carriage: Carriage) -> EncodedText:
    """Encode an envelope as a terminal's text."""
    match carriage:
        case "binary":
            return encode_bytes(envelope)
        case "ascii":
            return encode_bytes(base64.b64encode(envelope).rstrip(b"="))
        case "bcd":
            return encode_digits(str(int.from_bytes(b"\x01" + envelope, "big")))


def envelope_from_text(wording: EncodedText) -> Envelope | None:
    """Envelope in a message, None for other messages.

    CutError, DamagedError, VersionError for one that is ours by its mark and cannot be read.
    """
    found = _found(wording)
    if not found or found[0] < MARK:
        return None
    if len(found) < OVERHEAD:
        raise EnvelopeLengthError(f"{len(found)} bytes")
    kind, body = found[0] & ~MARK, found[1:-2]
    if not (kind == TEXT or kind in BODY_BYTES):
        raise EnvelopeVersionError(f"kind {kind}")
    if kind == TEXT:
        if len(body) < 3 or len(body) - 3 != body[2]:
            raise EnvelopeLengthError("a text that is not as long as it says")
    elif len(body) != BODY_BYTES[kind]:
        raise EnvelopeLengthError(f"{len(body)} bytes in kind {kind}")
    if _crc(found[:-2]) != envelope_crc(found):
        raise EnvelopeDamagedError("CRC differs")
    return Envelope(kind, body, envelope_crc(found))


def _found(wording: EncodedText) -> bytes | None:
    """The bytes that may be an envelope."""
    payload = wording.payload
    if wording.encoding == "code":
        shown = payload.hex()[: len(payload) * 2 - wording.odd]
        if not (shown.isdigit() and shown):
            return None
        number = int(shown)
        data = number.to_bytes((number.bit_length() + 7) // 8, "big")
        return data[1:] if data[:1] == b"\x01" else None
    if wording.encoding == "chinese" or not payload.startswith(MIXED):
        return None
    data = payload[1:]
    if data and data[0] >= MARK:
        return data
    try:
        return base64.b64decode(data + b"=" * (-len(data) % 4), validate=True)
    except (binascii.Error, ValueError):
        return None


def _crc(data: bytes) -> int:
    return binascii.crc_hqx(data, 0xFFFF)
