"""Detection of protocols other than NMEA, UBX or RTCM 3, for a message that names them.

A protocol is named if two messages of it verify: by a cheap checksum, or else by the fixed bytes at
their end. Sources: u-blox, Septentrio (SBF reference guide), NovAtel OEM7 and Unicore command
manuals, SiRF Binary Protocol Reference Manual, Trimble (TSIP) and Garmin (device interface
specification), SkyTraq AN0003, Allystar, CASIC and MTK protocol specifications, Rockwell Zodiac
interface guide, GREIS reference guide (Topcon, JAVAD), NavCom technical reference, iTalk, SuperStar
II and GeoS-1M protocol specifications, RTCM 10402.3, gpsd_json(5).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import reduce
from operator import xor

FEWEST = 2
"""Messages that must verify; of those by their ends alone one is found in noise now and then."""
MOST_TRIES = 100
"""Beginnings that are looked at: each may ask for a sum of all bytes."""

MOSTLY = 0.98
"""Share of letters that are printed: at another rate, and in other protocols, a third."""
SHOWN = 40
"""Characters shown of a line."""

_LINE_ENDS = re.compile(rb"[\r\n]+")
_PRINTED = re.compile(rb"[\t\x20-\x7e]")
_NOVATEL_TEXT = re.compile(rb"#[A-Z][A-Z0-9]{3,15},[^\r\n#$]{20,600}\*[0-9a-fA-F]{8}\r?\n?")
_NOVATEL_SHORT = re.compile(rb"%[A-Z][A-Z0-9]{3,15}SA,[^\r\n%$]{5,600}\*[0-9a-fA-F]{8}\r?\n?")
_AIS = re.compile(rb"![A-Z]{2}VD[MO],[\x20-\x7e]{5,90}\*[0-9A-F]{2}")
_ACTISENSE = re.compile(rb"\x10\x02[\x93-\x95\xa0\xd0](?:[^\x10]|\x10\x10){5,250}\x10\x03")
_TSIP = re.compile(rb"(?<!\x10)\x10[^\x03\x10](?:[^\x10]|\x10\x10){1,250}\x10\x03")
_GPSD = re.compile(rb'\{"class":"[A-Z]+"')
_GREIS = re.compile(rb"[\r\n]*[0-~]{2}([0-9A-F]{3})")
_SENTENCE = re.compile(rb"\$([A-Z]{4,5},[\x20-\x7e]{0,100}?)\*([0-9A-F]{2})")
_BARE = re.compile(rb"(?:^|[\r\n])[A-Z]{2}(?:GGA|RMC|GSA|GSV|GLL|VTG),[^\r\n$]*[\r\n]")


def _framed(sync: bytes, whole: Callable[[bytes, int], int]) -> Callable[[bytes], int]:
    """Number of verified messages behind `sync`; `whole(data, at)` is the length of a message, 0
    for none."""

    def count(data: bytes) -> int:
        at, found, tries = data.find(sync), 0, 0
        while at >= 0 and found < FEWEST and tries < MOST_TRIES:
            length = whole(data, at)
            found, tries = found + (length > 0), tries + 1
            at = data.find(sync, at + max(length, 1))
        return found

    return count


def _sirf(d: bytes, at: int) -> int:
    """A0 A2 length16 payload sum15 B0 B3."""
    n = int.from_bytes(d[at + 2 : at + 4], "big")
    payload, end = d[at + 4 : at + 4 + n], d[at + 4 + n : at + 8 + n]
    good = end[2:] == b"\xb0\xb3" and sum(payload) & 0x7FFF == int.from_bytes(end[:2], "big")
    return n + 8 if good else 0


def _skytraq(d: bytes, at: int) -> int:
    """A0 A1 length16 payload xor CR LF."""
    n = int.from_bytes(d[at + 2 : at + 4], "big")
    payload, end = d[at + 4 : at + 4 + n], d[at + 4 + n : at + 7 + n]
    return n + 7 if end[1:] == b"\r\n" and end[0] == reduce(xor, payload, 0) else 0


def _sbf(d: bytes, at: int) -> int:
    """$@ crc16 id16 length16 ...: the length, a multiple of 4, leads to the next."""
    n = int.from_bytes(d[at + 6 : at + 8], "little")
    return n if n >= 8 and n % 4 == 0 and d[at + n : at + n + 2] == b"$@" else 0


def _novatel(d: bytes, at: int) -> int:
    """Frame of NovAtel: AA 44 and 12 (header length8, message length16 at 8), 13 (length8) or
    Unicore's B5 (length16 at 6), crc32 behind; the length leads to the next."""
    kind = d[at + 2 : at + 3]
    if kind == b"\x12":
        n = int.from_bytes(d[at + 3 : at + 4], "little")
        n += int.from_bytes(d[at + 8 : at + 10], "little")
    elif kind == b"\x13":
        n = 12 + int.from_bytes(d[at + 3 : at + 4], "little")
    elif kind == b"\xb5":
        n = 24 + int.from_bytes(d[at + 6 : at + 8], "little")
    else:
        return 0
    return n + 4 if d[at + n + 4 : at + n + 6] == b"\xaa\x44" else 0


def _allystar(d: bytes, at: int) -> int:
    """F1 D9 class id length16 payload ck_a ck_b, as UBX."""
    n = int.from_bytes(d[at + 4 : at + 6], "little")
    a = b = 0
    for byte in d[at + 2 : at + 6 + n]:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return n + 8 if d[at + 6 + n : at + 8 + n] == bytes((a, b)) else 0


def _casic(d: bytes, at: int) -> int:
    """BA CE length16 class id payload sum32: the length leads to the next."""
    n = int.from_bytes(d[at + 2 : at + 4], "little")
    return n + 10 if d[at + n + 10 : at + n + 12] == b"\xba\xce" else 0


def _mtk(d: bytes, at: int) -> int:
    """04 24 length16 command16 ... xor CR LF."""
    n = int.from_bytes(d[at + 2 : at + 4], "little")
    return n if 9 <= n <= 600 and d[at + n - 2 : at + n] == b"\r\n" else 0


def _zodiac(d: bytes, at: int) -> int:
    """FF 81 id16 words16 flags16 checksum16 data words, checksum16: the sum of the first five."""
    words = [int.from_bytes(d[at + i : at + i + 2], "little") for i in range(0, 10, 2)]
    return 10 if len(d) >= at + 10 and -sum(words[:4]) & 0xFFFF == words[4] else 0


def _oncore(d: bytes, at: int) -> int:
    """@@ and two letters, an xor and CR LF at the end."""
    end = d.find(b"\r\n", at + 4, at + 300)
    good = end > 0 and d[at + 2 : at + 4].isalpha()
    return end + 2 - at if good and reduce(xor, d[at + 2 : end], 0) == 0 else 0


def _navcom(d: bytes, at: int) -> int:
    """02 99 66 id length16 payload xor 03: the length is from id to xor."""
    n = int.from_bytes(d[at + 4 : at + 6], "little")
    said = d[at + 3 : at + 3 + n]
    good = n >= 4 and d[at + 3 + n : at + 4 + n] == b"\x03"
    return n + 4 if good and reduce(xor, said, 0) == 0 else 0


def _italk(d: bytes, at: int) -> int:
    """3C 21, four bytes, words8, so many words, sum16, 3E."""
    n = 2 * int.from_bytes(d[at + 6 : at + 7], "little") + 9
    return n + 1 if d[at + n : at + n + 1] == b">" else 0


def _geostar(d: bytes, at: int) -> int:
    """PSGG command16 words16, so many words, xor32: the length leads to the next."""
    n = 12 + 4 * int.from_bytes(d[at + 6 : at + 8], "little")
    return n if d[at + n : at + n + 4] == b"PSGG" else 0


def _superstar(d: bytes, at: int) -> int:
    """01 id and its complement, length8 payload sum16."""
    if len(d) < at + 6 or d[at + 1] ^ d[at + 2] != 0xFF:
        return 0
    n = 4 + d[at + 3]
    check = int.from_bytes(d[at + n : at + n + 2], "little")
    return n + 2 if sum(d[at : at + n]) & 0xFFFF == check else 0


def _greis(d: bytes, at: int) -> int:
    """~~005, the time: messages of two letters, length in three hexadecimal digits, and text or
    bytes; two lengths lead on to a third message."""
    end = at + 10
    for _ in range(2):
        head = _GREIS.match(d, end)
        if head is None:
            return 0
        end = head.end() + int(head[1], 16)
    return end - at if _GREIS.match(d, end) else 0


FEWEST_RTCM_2 = 100
"""Bytes of RTCM 2 that name it, some twenty words; all begin with the bits 01, as no other text or
protocol does: letters, without a space or a digit."""


def _rtcm_2(data: bytes) -> int:
    """Number of messages of RTCM 2, by its six bits of eight: all or none."""
    words = data.translate(None, b"\r\n")
    of_it = sum(byte >> 6 == 1 for byte in words)
    return FEWEST * (of_it >= FEWEST_RTCM_2 and of_it >= MOSTLY * len(words))


_SWITCH = "switch on NMEA (GGA, RMC, GST) at the receiver"


def _with_parity(data: bytes) -> int:
    """Sentences that verify without the eighth bit, the parity of a line with seven data bits."""
    found = _SENTENCE.findall(bytes(byte & 0x7F for byte in data))
    return sum(reduce(xor, said) == int(check, 16) for said, check in found)


_KNOWN: tuple[tuple[str, Callable[[bytes], int], str], ...] = (
    ("Septentrio's SBF", _framed(b"$@", _sbf), f'{_SWITCH}, or have it read: driver = "sbf"'),
    ("binary logs of NovAtel or Unicore", _framed(b"\xaa\x44", _novatel), _SWITCH),
    (
        "text logs of NovAtel or Unicore (#...)",
        lambda d: len(_NOVATEL_TEXT.findall(d)),
        f'{_SWITCH}, or have it read: driver = "bestpos"',
    ),
    (
        "NovAtel's form of logs with short headers (%...)",
        lambda d: len(_NOVATEL_SHORT.findall(d)),
        f'{_SWITCH}, or BESTPOSA and BESTVELA with their long ones: driver = "bestpos"',
    ),
    ("SiRF's binary protocol", _framed(b"\xa0\xa2", _sirf), _SWITCH),
    ("SkyTraq's binary protocol", _framed(b"\xa0\xa1", _skytraq), _SWITCH),
    ("Allystar's binary protocol", _framed(b"\xf1\xd9", _allystar), _SWITCH),
    ("CASIC's binary protocol", _framed(b"\xba\xce", _casic), _SWITCH),
    ("MTK's binary protocol", _framed(b"\x04\x24", _mtk), _SWITCH),
    ("Zodiac's binary protocol", _framed(b"\xff\x81", _zodiac), _SWITCH),
    ("Motorola's OnCore protocol", _framed(b"@@", _oncore), _SWITCH),
    (
        "GREIS, Topcon's and JAVAD's protocol,",
        lambda d: FEWEST * _framed(b"~~005", _greis)(d),  # each is three messages, of kilobytes
        _SWITCH,
    ),
    ("NavCom's binary protocol", _framed(b"\x02\x99\x66", _navcom), _SWITCH),
    ("iTalk, Fastrax' binary protocol,", _framed(b"<!", _italk), _SWITCH),
    ("GeoStar's binary protocol", _framed(b"PSGG", _geostar), _SWITCH),
    ("SuperStar II's binary protocol", _framed(b"\x01", _superstar), _SWITCH),
    ("RTCM 2", _rtcm_2, "these are corrections for a receiver: take the receiver's own output"),
    (
        "AIS (!AIVDM)",
        lambda d: len(_AIS.findall(d)),
        "it tells where others are: take the receiver's own output",
    ),
    (
        "NMEA 2000 by an Actisense gateway",
        lambda d: len(_ACTISENSE.findall(d)),
        "set the gateway to NMEA 0183",
    ),
    ("Trimble's TSIP or Garmin's binary protocol", lambda d: len(_TSIP.findall(d)), _SWITCH),
    (
        "gpsd's JSON",
        lambda d: len(_GPSD.findall(d)),
        "set port to gpsd://HOST, which asks gpsd for what the receiver says",
    ),
    (
        "NMEA with a parity bit",
        _with_parity,
        "set the receiver's port to eight data bits without parity (8N1)",
    ),
    (
        "NMEA without its $",
        lambda d: len(_BARE.findall(d)),
        "the line loses bytes, or a terminal program strips them",
    ),
)


def verified_protocol(data: bytes) -> str:
    """Sentence on the protocol whose messages in these bytes verify; "" if none."""
    for name, count, remedy in _KNOWN:
        if count(data) >= FEWEST:
            return f"{name} arrives, which is not read here: {remedy}"
    return ""


def protocol_sentence(data: bytes) -> str:
    """Sentence on the protocol of these bytes; "" if unknown."""
    return verified_protocol(data) or _text(data)


def _text(data: bytes) -> str:
    """Readable lines in these bytes; a wrong baud rate produces none."""
    lines = [line for line in _LINE_ENDS.split(data) if line.strip()]
    letters = sum(len(_PRINTED.findall(line)) for line in lines)
    if len(lines) < FEWEST + 1 or letters < MOSTLY * sum(map(len, lines)):
        return ""
    shown = max(lines[1:-1], key=len)[:SHOWN].decode("ascii", "replace")
    return (
        f"text arrives that is no NMEA, such as {shown!r}: a console or a modem is on this "
        "port, or the receiver is set to another output"
    )
