"""RDSS terminal interface, family 4.0: binary frames.

    offset 0  5  name, `$` and four capital letters
           5  2  length of the whole frame, big-endian
           7  3  user address, big-endian, 21 bits
          10  n  payload
        10+n  1  XOR of everything before

There is no terminator, and `$` may occur inside a payload. Signed numbers are sign and magnitude.
Public copies of the interface agree on the above. They disagree on the sign bits of H and xi, the
wait of FKXX flag 4, and the fraction of T: there the decoder accepts all readings, see the
comments.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from drivers.rdss.binary_4_0_encode import (
    FLAGS,
    HEADER,
    LENGTHS,
    MAX_LENGTH,
    MAX_USER,
    OVERHEAD,
    encode,
    frame,
)
from drivers.rdss.framing import FrameDecoder, checksum
from drivers.rdss.mail import TextEncoding
from drivers.rdss.messages import (
    CARD_FAULTS,
    HARDWARE_FAULTS,
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
    PortRateRequest,
    PositionRequest,
    SelfTest,
    SelfTestRequest,
    StopRequest,
    Subordinates,
    Text,
    TextRequest,
    TimeRequest,
    Unknown,
    VersionRequest,
    ascii_name,
    check_date,
    check_range,
)

__all__ = ["LENGTHS", "MAX_USER", "Decoder", "checksum", "encode", "frame"]

# --------------------------------------------------------------------------- numbers


def _from_signed(value: int, sign_bit: int) -> int:
    sign = 1 << sign_bit
    return -(value & (sign - 1)) if value & sign else value


def _angle(raw: bytes, name: str, limit: int) -> float:
    """Degrees, minutes, seconds, tenths of a second; no hemisphere (north and east implied)."""
    degrees, minutes, seconds, tenths = raw
    check_range(f"{name} minutes", minutes, 0, 59)
    check_range(f"{name} seconds", seconds, 0, 59)
    check_range(f"{name} tenths", tenths, 0, 9)
    angle = degrees + minutes / 60 + (seconds + tenths / 10) / 3600
    check_range(name, angle, 0, limit)
    return angle


def _time(hour: int, minute: int, second: int) -> int:
    check_range("hour", hour, 0, 23)
    check_range("minute", minute, 0, 59)
    check_range("second", second, 0, 60)
    return hour * 3600 + minute * 60 + second


# --------------------------------------------------------------------------- decoding by name


def _period(payload: bytes) -> int:
    return int.from_bytes(payload, "big")


def _position_request(user: int, p: bytes) -> Message:
    info, field, weather, period = struct.unpack(">BIIH", p)
    mode = HeightMode((info >> 2) & 3)
    high = bool(info & 1)
    height: float | None = None
    antenna: float | None = None
    if high:
        if mode is not HeightMode.GIVEN:
            raise FieldError("high-altitude user without a given height: layout not public")
        height = float(field)
    else:
        if mode in (HeightMode.GIVEN, HeightMode.ALTIMETER_2):
            height = float(_from_signed(field >> 16, 15))
        if mode is not HeightMode.GIVEN:
            antenna = (field & 0xFFFF) / 10
    barometer = mode in (HeightMode.ALTIMETER_1, HeightMode.ALTIMETER_2)
    return PositionRequest(
        user=user,
        height_mode=mode,
        height_m=height,
        antenna_height_m=antenna,
        pressure_pa=float(weather >> 12) if barometer else None,
        temperature_c=_from_signed(weather & 0xFFF, 11) / 10 if barometer else None,
        period_s=period,
        emergency=bool(info & 0x20),
        high_altitude=high,
    )


def _text_kind(payload: bytes, code: bool) -> TextEncoding:
    if not code:
        return "chinese"
    return "mixed" if payload.startswith(b"\xa4") else "code"


def _odd_digits(bits: int, text: bytes, encoding: TextEncoding) -> bool:
    """True if a code ends with half a byte. FieldError if the stated length is not the text's."""
    if (bits + 7) // 8 != len(text):
        raise FieldError(f"{bits} bits of text in {len(text)} bytes")
    return encoding == "code" and 0 < bits % 8 <= 4


def _text_request(user: int, p: bytes) -> Message:
    text = p[7:]
    encoding = _text_kind(text, bool(p[0] & 2))
    return TextRequest(
        user=user,
        receiver=int.from_bytes(p[1:4], "big"),
        payload=text,
        encoding=encoding,
        acknowledge=bool(p[6]),
        odd=_odd_digits(int.from_bytes(p[4:6], "big"), text, encoding),
    )


def _text(user: int, p: bytes) -> Message:
    text = p[8:-1]
    encoding = _text_kind(text, bool(p[0] & 0x20))
    return Text(
        user=user,
        sender=int.from_bytes(p[1:4], "big"),
        payload=text,
        encoding=encoding,
        minute_of_day=_time(p[4], p[5], 0) // 60,
        crc_ok=p[-1] == 0,
        odd=_odd_digits(int.from_bytes(p[6:8], "big"), text, encoding),
    )


def _identity(user: int, p: bytes) -> Message:
    if p[0] == 0:
        if len(p) != 11:
            raise FieldError("ICXX frame 0 has 22 bytes")
        return Identity(
            user=user,
            broadcast_id=int.from_bytes(p[1:4], "big"),
            user_class=p[4],
            service_frequency_s=int.from_bytes(p[5:7], "big"),
            comm_level=p[7],
            encryption=p[8],
            subordinates=int.from_bytes(p[9:11], "big"),
        )
    if (len(p) - 1) % 3:
        raise FieldError("ICXX frame N holds addresses of 3 bytes")
    addresses = tuple(int.from_bytes(p[i : i + 3], "big") for i in range(1, len(p), 3))
    return Subordinates(user=user, index=p[0], addresses=addresses)


def _self_test(user: int, p: bytes) -> Message:
    check_range("battery", p[2], 0, 100)
    faults = [name for bit, name in CARD_FAULTS.items() if p[0] >> bit & 1]
    faults += [name for bit, name in HARDWARE_FAULTS.items() if p[1] >> bit & 1]
    return SelfTest(
        user=user,
        faults=tuple(faults),
        battery_percent=float(p[2]),
        inbound_state=p[3],
        levels=tuple(p[4:10]),
    )


def _clock(user: int, p: bytes) -> Message:
    year, month, day, hour, minute, second = struct.unpack(">HBBBBB", p)
    check_date(year, month, day)
    return DeviceClock(year, month, day, float(_time(hour, minute, second)), user=user)


def _wait_s(extra: bytes) -> float | None:
    """Wait (s) of flag 4, of which public code has five encodings: a single non-zero byte is the
    number of seconds, wherever it stands; otherwise big-endian. None: no wait stated.
    """
    nonzero = [b for b in extra if b]
    if not nonzero:
        return None
    return float(nonzero[0]) if len(nonzero) == 1 else float(int.from_bytes(extra, "big"))


def _feedback(user: int, p: bytes) -> Message:
    extra = p[1:5]
    named = extra.isalpha() and extra.isascii()
    outcome = FLAGS.get(p[0], Outcome.OTHER)
    return Feedback(
        outcome,
        command=ascii_name(extra) if named else None,
        wait_s=_wait_s(extra) if outcome is Outcome.FREQUENCY else None,
        code=p[0],
        user=user,
    )


def _fix(user: int, p: bytes) -> Message:
    info = p[0]
    high = bool(info & 1)
    if len(p) != (19 if high else 20):
        raise FieldError("DWXX has 31 bytes, 30 for a high-altitude user")
    if high:
        height, anomaly = int.from_bytes(p[16:19], "big"), 0
    else:
        # Sign of H: bit 15 in the text, bit 14 in public code; of xi: bit 15, 14 or 8. Any of them
        # is read as minus, which is safe for |H| <= 16383 m and |xi| <= 255 m.
        raw_h, raw_xi = struct.unpack(">HH", p[16:20])
        height = -(raw_h & 0x3FFF) if raw_h & 0xC000 else raw_h
        anomaly = -(raw_xi & 0xFF) if raw_xi & 0xC100 else raw_xi & 0xFF
    return Fix(
        user=user,
        time_of_day_s=float(_time(*p[4:7])),
        fraction=p[7],
        lon_deg=_angle(p[8:12], "longitude", 180),
        lat_deg=_angle(p[12:16], "latitude", 90),
        height_m=float(height),
        height_anomaly_m=float(anomaly),
        precision_class_m=100 if info & 8 else 20,
        kind="query" if info & 0x20 else "own",
        queried=int.from_bytes(p[1:4], "big"),
        emergency=bool(info & 4),
        multi_value=bool(info & 2),
        high_altitude=high,
    )


_DECODE: dict[str, Callable[[int, bytes], Message]] = {
    "ICJC": lambda user, p: IdentityRequest(user, p[0]),
    "XTZJ": lambda user, p: SelfTestRequest(user, _period(p)),
    "GLJC": lambda user, p: BeamPowerRequest(user, p[0]),
    "SJSC": lambda user, p: TimeRequest(user, _period(p)),
    "BBDQ": lambda user, p: VersionRequest(user),
    "CKSC": lambda user, p: PortRateRequest(user, p[0]),
    "JSZL": lambda user, p: StopRequest(user, p.decode("ascii")),
    "DWSQ": _position_request,
    "TXSQ": _text_request,
    "GLZK": lambda user, p: BeamPower(tuple(p), user),
    "ICXX": _identity,
    "ZJXX": _self_test,
    "SJXX": _clock,
    "FKXX": _feedback,
    "DWXX": _fix,
    "TXXX": _text,
}


# --------------------------------------------------------------------------- framing


class Decoder(FrameDecoder):
    """Decoder of bytes into messages, of both directions. Buffers at most one frame.

    Counters: `frames`, `unknown` (well-formed, not read here), `bad_checksum`, `bad_length`,
    `bad_name`, `bad_field` (good checksum, impossible value), `other_family` (a text sentence),
    `abandoned` (frame whose rest never came), `garbage_bytes`.
    """

    def _extent(self, buffer: bytearray, at: int) -> tuple[int, str]:
        header = bytes(buffer[at : at + HEADER])
        if len(header) < HEADER:
            return HEADER, ""
        letters = header[1:5]
        if not (letters.isalpha() and letters.isupper()):
            return 0, "bad_name"
        if header[5:6].isalnum() and header[6:7] == b",":
            return 0, "other_family"
        length = int.from_bytes(header[5:7], "big")
        least, greatest = LENGTHS.get(ascii_name(letters), (OVERHEAD, MAX_LENGTH))
        return length, "" if least <= length <= greatest else "bad_length"

    def _read(self, whole: bytes) -> Message | None:
        if checksum(whole):
            self.counters["bad_checksum"] += 1
            return None
        name, payload = ascii_name(whole[1:5]), whole[10:-1]
        user = int.from_bytes(whole[7:10], "big") & MAX_USER
        read = _DECODE.get(name)
        return self._judge(read and (lambda: read(user, payload)), Unknown(name, payload, user))
