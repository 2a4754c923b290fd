"""RDSS terminal interface, family 2.1: text sentences.

    $ talker(2) formatter(3) , fields * XOR of what stands between $ and *, two hex digits, CR LF

Talker CC is from host to terminal, BD from terminal to host. The same port may carry ordinary GNSS
sentences (any talker), which become `Unknown`. A raw Chinese text may hold bytes of 0x80 and more.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from drivers.rdss.framing import FrameDecoder, checksum
from drivers.rdss.mail import TextEncoding
from drivers.rdss.messages import (
    ZTI_FAULTS,
    BeamPower,
    BeamPowerRequest,
    DeviceClock,
    Feedback,
    FieldError,
    Fix,
    HeightMode,
    Identity,
    IdentityRequest,
    Message,
    Outcome,
    OutputRequest,
    PositionRequest,
    SelfTest,
    SelfTestRequest,
    Text,
    TextRequest,
    TimeRequest,
    Unknown,
    ascii_name,
    check_date,
    check_range,
)
from drivers.rdss.text_2_1_encode import (
    ENCODINGS,
    INHIBIT,
    KINDS,
    MAX_SENTENCE,
    REASONS,
    encode,
    sentence,
)

__all__ = ["Decoder", "checksum", "encode", "sentence"]

_HEADER = 7
_CONTROL = re.compile(rb"[\x00-\x1f]")

Fields = list[str]

# --------------------------------------------------------------------------- fields


def _count(fields: Fields, *allowed: int) -> None:
    if len(fields) not in allowed:
        raise FieldError(f"{len(fields)} fields, not {allowed}")


def _int(field: str, low: int, high: int) -> int:
    """Decimal integer of a field; 0 for an empty one."""
    if field and not (field.lstrip("+-").isdigit() and field.isascii()):
        raise FieldError(f"{field!r} is no integer")
    value = int(field or "0")
    check_range("field", value, low, high)
    return value


def _number(field: str, low: float, high: float) -> float:
    if set(field) - set("+-.0123456789"):
        raise FieldError(f"{field!r} is no number")
    value = float(field)
    check_range("field", value, low, high)
    return value


def _optional(field: str, low: float, high: float) -> float | None:
    return _number(field, low, high) if field else None


def _choice(field: str, yes: str, no: str) -> bool:
    if field not in (yes, no):
        raise FieldError(f"{field!r} is neither {yes} nor {no}")
    return field == yes


def _user(field: str) -> int:
    return _int(field, 0, 9_999_999)


def _time(field: str) -> float:
    """hhmmss.ss to seconds of the day, up to a leap second."""
    if len(field) < 6 or not field[:6].isdigit():
        raise FieldError(f"{field!r} is no time")
    hour, minute = _int(field[:2], 0, 23), _int(field[2:4], 0, 59)
    return round(hour * 3600 + minute * 60 + _number(field[4:], 0, 60.999999), 6)


def _angle(field: str, hemisphere: str, positive: str, negative: str, limit: float) -> float:
    """dddmm.mmmm and hemisphere to signed degrees."""
    value = _number(field, 0, limit * 100)
    minutes = value % 100
    check_range("minutes", minutes, 0, 59.999999)
    angle = value // 100 + minutes / 60
    check_range("angle", angle, 0, limit)
    return angle if _choice(hemisphere, positive, negative) else -angle


# --------------------------------------------------------------------------- decoding by name


def _position_request(f: Fields) -> Message:
    _count(f, 9)
    return PositionRequest(
        user=_user(f[0]),
        emergency=_choice(f[1], "A", "V"),
        height_mode=HeightMode(_int(f[2], 0, 3)),
        high_altitude=_choice(f[3], "H", "L"),
        height_m=_optional(f[4], -12_000, 1e8),
        antenna_height_m=_optional(f[5], 0, 1e5),
        pressure_pa=_optional(f[6], 0, 2e6),
        temperature_c=_optional(f[7], -273, 1000),
        period_s=_int(f[8], 0, 99_999),
    )


def _output_request(f: Fields) -> Message:
    _count(f, 3)
    mode = _int(f[1], 1, 4)
    period = _int(f[2], 0, 99_999) if f[2] else None
    if mode == 2 and period is not None and f[0] in _OUTPUTS:
        return _OUTPUTS[f[0]](0, period)
    return OutputRequest(f[0], mode, period)


_OUTPUTS: dict[str, Callable[[int, int], Message]] = {
    "BSI": BeamPowerRequest,
    "ZDA": TimeRequest,
    "ZTI": SelfTestRequest,
}


def _fix(f: Fields) -> Message:
    _count(f, 15)
    if f[0] not in KINDS or f[8] != "M" or f[10] != "M" or f[11] not in ("0", "1"):
        raise FieldError("DWR type, unit or precision")
    return Fix(
        kind=KINDS[f[0]],
        user=_user(f[1]),
        time_of_day_s=_time(f[2]),
        lat_deg=_angle(f[3], f[4], "N", "S", 90),
        lon_deg=_angle(f[5], f[6], "E", "W", 180),
        height_m=_number(f[7], -12_000, 1e8),
        height_anomaly_m=_number(f[9] or "0", -255, 255),
        precision_class_m=100 if f[11] == "1" else 20,
        emergency=_choice(f[12], "A", "V"),
        multi_value=_choice(f[13], "A", "V"),
        high_altitude=_choice(f[14], "H", "L"),
    )


def _feedback(f: Fields) -> Message:
    """Feedback, in the old form (letters in field 1) or the BDS-3 form (digits)."""
    _count(f, 5)
    if f[0].isdigit():
        executed, reason = _choice(f[2], "Y", "N"), _int(f[3], 0, 99)
        sent = executed and not reason
        inhibited = False if sent else True if reason in (2, 3) else None
        return Feedback(
            Outcome.OK if sent else REASONS.get(reason, Outcome.OTHER),
            command=f[1] or None,
            wait_s=_optional(f[4], 0, 1e6) or None,
            code=reason,
            inhibited=inhibited,
            time_of_day_s=int(_time(f[0])),
        )
    executed, frequency_ok = _choice(f[1], "Y", "N"), _choice(f[2], "Y", "N")
    inhibit = _int(f[3], 0, 9)
    if len(f[4]) != 4:
        raise FieldError("wait is mmss")
    wait = _int(f[4][:2], 0, 99) * 60 + _int(f[4][2:], 0, 59)
    if inhibit:
        outcome = INHIBIT.get(inhibit, Outcome.OTHER)
    elif executed:
        outcome = Outcome.OK
    else:
        outcome = Outcome.FREQUENCY if wait or not frequency_ok else Outcome.NOT_SENT
    return Feedback(
        outcome,
        command=f[0] or None,
        wait_s=float(wait) if wait else None,
        code=inhibit,
        inhibited=inhibit != 0,
    )


def _identity(f: Fields) -> Message:
    _count(f, 8)
    return Identity(
        user=_user(f[0]),
        serial=_int(f[1], 0, 10**12),
        broadcast_id=_user(f[2]),
        user_class=_int(f[3], 0, 7),
        service_frequency_s=_int(f[4], 0, 99_999),
        comm_level=_int(f[5], 0, 99),
        encryption=int(_choice(f[6], "E", "N")),
        subordinates=_int(f[7], 0, 99_999),
    )


def _beam_power(f: Fields) -> Message:
    if not 3 <= len(f) <= 12:
        raise FieldError("BSI has two beams and up to ten levels")
    return BeamPower(
        levels=tuple(_int(level, 0, 9) for level in f[2:]),
        response_beam=_int(f[0], 0, 99),
        time_difference_beam=_int(f[1], 0, 99),
    )


def _clock(f: Fields) -> Message | None:
    """Clock of the RDSS form: 11 fields, the first one digit. None for six fields, a GNSS
    receiver's ZDA."""
    if len(f[0]) != 1:
        return None
    _count(f, 11)
    day, month, year = _int(f[2], 1, 31), _int(f[3], 1, 12), _int(f[4], 1980, 2399)
    check_date(year, month, day)
    return DeviceClock(
        year,
        month,
        day,
        _time(f[1]),
        mode=_int(f[0], 1, 9),
        zone_h=_int(f[5], -13, 13),
        zone_min=_int(f[6], 0, 59),
        precision=_int(f[9], 0, 3),
        locked=_choice(f[10], "Y", "N"),
    )


def _self_test(f: Fields) -> Message | None:
    """Self test, only of the form with 8 fields; the number differs between vendors."""
    if len(f) != 8:
        return None
    remaining = f[7]
    if remaining and len(remaining) != 4:
        raise FieldError("remaining time is hhmm")
    return SelfTest(
        faults=tuple(
            name for name, v in zip(ZTI_FAULTS, f[:4], strict=True) if _choice(v, "1", "0")
        ),
        external_power=_choice(f[4], "1", "0"),
        charging=_choice(f[5], "1", "0"),
        battery_percent=_number(f[6], 0, 100),
        remaining_min=_int(remaining[:2], 0, 99) * 60 + _int(remaining[2:], 0, 59)
        if remaining
        else None,
    )


def _text_payload(field: str, encoding: TextEncoding) -> tuple[bytes, bool]:
    """Payload of a field: hexadecimal for code and mixed text, a code with possibly an odd number
    of digits; Chinese text is plain."""
    if encoding == "chinese":
        return field.encode("latin-1"), False
    odd = encoding == "code" and len(field) % 2 == 1
    return bytes.fromhex(field + "0" * odd), odd


def _text_request(f: Fields) -> Message:
    _count(f, 4)
    encoding = ENCODINGS[_int(f[2], 0, 2)]
    payload, odd = _text_payload(f[3], encoding)
    return TextRequest(_user(f[0]), payload, encoding, category=_int(f[1], 0, 9), odd=odd)


def _text(f: Fields) -> Message:
    _count(f, 5)
    encoding = ENCODINGS[_int(f[2], 0, 2)]
    when = int(_time(f[3] + "00")) // 60 if f[3] else None
    payload, odd = _text_payload(f[4], encoding)
    return Text(_user(f[1]), payload, encoding, minute_of_day=when, odd=odd)


def _identity_request(f: Fields) -> Message:
    _count(f, 2)
    return IdentityRequest(0, _int(f[1], 0, 99))


_DECODE: dict[str, Callable[[Fields], Message | None]] = {
    "CCICA": _identity_request,
    "CCRMO": _output_request,
    "CCDWA": _position_request,
    "CCTXA": _text_request,
    "BDICI": _identity,
    "BDBSI": _beam_power,
    "BDZDA": _clock,
    "BDZTI": _self_test,
    "BDFKI": _feedback,
    "BDDWR": _fix,
    "BDTXR": _text,
}


# --------------------------------------------------------------------------- framing


class Decoder(FrameDecoder):
    """Decoder of bytes into messages, of both directions. Buffers at most one sentence.

    Counters: `frames`, `unknown` (well-formed, not read here), `bad_checksum`, `bad_length` (no
    end), `bad_name`, `bad_field` (good checksum, impossible value), `other_family` (a binary
    frame), `abandoned` (sentence whose rest never came), `garbage_bytes`.
    """

    BETWEEN = b"\r\n"

    def _extent(self, buffer: bytearray, at: int) -> tuple[int, str]:
        """Length of a sentence, which ends with its first control character."""
        fault = _header_fault(bytes(buffer[at + 1 : at + _HEADER]))
        if fault:
            return 0, fault
        limit = at + MAX_SENTENCE
        end = _CONTROL.search(buffer, at, limit)
        if end is not None:
            return end.end() - at, ""
        return (0, "bad_length") if len(buffer) >= limit else (MAX_SENTENCE, "")

    def _read(self, whole: bytes) -> Message | None:
        body, star, digits = whole[1:-1].rpartition(b"*")
        if not whole.endswith((b"\r", b"\n")) or not star or len(digits) != 2:
            self.counters["bad_length"] += 1
            return None
        if digits.upper() != b"%02X" % checksum(body):
            self.counters["bad_checksum"] += 1
            return None
        name, fields = ascii_name(body[:5]), body[6:]
        read = _DECODE.get(name)
        return self._judge(
            read and (lambda: read(fields.decode("latin-1").split(","))), Unknown(name, fields)
        )


def _header_fault(header: bytes) -> str:
    """Fault of the name and comma behind `$`, which may be incomplete."""
    if len(header) >= 5 and header[:4].isalpha() and header[:4].isupper() and header[4] == 0:
        return "other_family"
    name = header[:5]
    if not name:
        return ""
    letters = name[:2].isalpha() and name.isalnum() and name.isupper()
    return "" if letters and header[5:] in (b"", b",") else "bad_name"
