"""RDSS terminal interface, family 4.0: messages to frames. `binary_4_0` describes the format."""

from __future__ import annotations

import struct

from drivers.rdss.framing import checksum, encode_frame
from drivers.rdss.messages import (
    CARD_FAULTS,
    FORBIDDEN,
    HARDWARE_FAULTS,
    BeamPower,
    BeamPowerRequest,
    DeviceClock,
    EncodeError,
    Feedback,
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
    split_time,
)

HEADER = 7
"""Bytes up to the length: name 5, length 2."""
OVERHEAD = 11
"""Bytes around the payload: name 5, length 2, address 3, XOR 1."""
MAX_LENGTH = 240
"""Longest frame believed: 210 bytes of text (1680 bits) and its header, rounded up."""
MAX_TEXT = 210
LENGTHS = {
    "ICJC": (12, 12),
    "XTZJ": (13, 13),
    "GLJC": (12, 12),
    "SJSC": (13, 13),
    "BBDQ": (11, 11),
    "CKSC": (12, 12),
    "DWSQ": (22, 22),
    "TXSQ": (18, 18 + MAX_TEXT),
    "JSZL": (15, 15),
    "GLZK": (17, 17),
    "ICXX": (12, MAX_LENGTH),
    "ZJXX": (21, 21),
    "SJXX": (18, 18),
    "FKXX": (16, 16),
    "DWXX": (30, 31),
    "TXXX": (20, 20 + MAX_TEXT),
}
"""Least and greatest length of each frame that is read; other names take any up to MAX_LENGTH."""
MAX_USER = 0x1FFFFF
MAX_ORDINARY_HEIGHT_M = 16300
MAX_ORDINARY_ANTENNA_M = 400.0


def frame(name: str, user: int, payload: bytes) -> bytes:
    """Make a frame of a payload. EncodeError for a name that must never be sent."""
    if name in FORBIDDEN:
        raise EncodeError(f"{name} is never sent")
    if len(name) != 4 or not (name.isascii() and name.isalpha() and name.isupper()):
        raise EncodeError(f"{name!r} is not four capital letters")
    length = OVERHEAD + len(payload)
    if length > MAX_LENGTH or not 0 <= user <= MAX_USER:
        raise EncodeError(f"{name}: length {length} or user {user} out of range")
    body = b"$" + name.encode() + length.to_bytes(2, "big") + user.to_bytes(3, "big") + payload
    return body + bytes((checksum(body),))


FLAGS = {
    0: Outcome.OK,
    1: Outcome.FAILED,
    2: Outcome.NOT_LOCKED,
    3: Outcome.LOW_BATTERY,
    4: Outcome.FREQUENCY,
    5: Outcome.ENCRYPTION,
    6: Outcome.CRC,
    7: Outcome.SUPPRESSED,
    8: Outcome.SILENCE_OR_LIFTED,
}


def _signed(value: float, sign_bit: int) -> int:
    """Sign and magnitude, the sign in bit `sign_bit`."""
    magnitude = round(abs(value))
    if magnitude >= 1 << sign_bit:
        raise EncodeError(f"{value} does not fit {sign_bit} bits and a sign")
    return magnitude | (1 << sign_bit if value < 0 and magnitude else 0)


def _angle_bytes(angle_deg: float) -> bytes:
    tenths = round(angle_deg * 36000)
    if not 0 <= tenths <= 180 * 36000:
        raise EncodeError(f"{angle_deg} deg: family 4.0 has no south and no west")
    seconds, tenths = divmod(tenths, 10)
    minutes, seconds = divmod(seconds, 60)
    return bytes((*divmod(minutes, 60), seconds, tenths))


def _time_bytes(time_of_day_s: float) -> bytes:
    return bytes(split_time(int(time_of_day_s)))


def _encode_position_request(m: PositionRequest) -> bytes:
    height, antenna = m.height_m or 0.0, m.antenna_height_m or 0.0
    if m.high_altitude:
        if m.height_mode is not HeightMode.GIVEN or not 0 <= height < 1 << 32:
            raise EncodeError("high-altitude user: only a given height of 0 m or more is public")
        field = round(height)
    else:
        if abs(height) >= MAX_ORDINARY_HEIGHT_M or not 0 <= antenna < MAX_ORDINARY_ANTENNA_M:
            raise EncodeError(f"height {height} m, antenna {antenna} m: not an ordinary user's")
        high = low = 0
        if m.height_mode in (HeightMode.GIVEN, HeightMode.ALTIMETER_2):
            high = _signed(height, 15)
        if m.height_mode is not HeightMode.GIVEN:
            low = round(antenna * 10)
        field = high << 16 | low
    weather = _signed((m.temperature_c or 0.0) * 10, 11)
    pressure = round(m.pressure_pa or 0.0)
    if not 0 <= pressure < 1 << 20 or not 0 <= m.period_s < 1 << 16:
        raise EncodeError(f"pressure {pressure} or period {m.period_s} out of range")
    info = m.emergency << 5 | m.height_mode << 2 | m.high_altitude
    return frame(
        "DWSQ", m.user, struct.pack(">BIIH", info, field, pressure << 12 | weather, m.period_s)
    )


def _encode_feedback(m: Feedback) -> bytes:
    flags = {outcome: flag for flag, outcome in FLAGS.items()}
    flags |= {Outcome.SILENCE: 8, Outcome.NOT_SENT: 1, Outcome.OTHER: m.code}
    if m.outcome not in flags:
        raise EncodeError(f"FKXX has no flag for {m.outcome}")
    flag = flags[m.outcome]
    if m.outcome is Outcome.FREQUENCY:
        extra = round(m.wait_s or 0).to_bytes(4, "big")
    else:
        extra = (m.command or "").encode("ascii").ljust(4, b"\0")[:4]
    return frame("FKXX", m.user, bytes((flag,)) + extra)


def _encode_fix(m: Fix) -> bytes:
    info = (
        (m.kind != "own") << 5
        | (m.precision_class_m == 100) << 3
        | m.emergency << 2
        | m.multi_value << 1
        | m.high_altitude
    )
    fraction = m.fraction if m.fraction is not None else int(m.time_of_day_s * 100 % 100)
    head = bytes((info,)) + m.queried.to_bytes(3, "big")
    when = _time_bytes(m.time_of_day_s) + bytes((fraction,))
    where = _angle_bytes(m.lon_deg) + _angle_bytes(m.lat_deg)
    if m.high_altitude:
        height = round(m.height_m).to_bytes(3, "big")
    else:
        height = struct.pack(">HH", _signed(m.height_m, 14), _signed(m.height_anomaly_m, 8))
    return frame("DWXX", m.user, head + when + where + height)


def _encode_self_test(m: SelfTest) -> bytes:
    card = sum(1 << bit for bit, name in CARD_FAULTS.items() if name in m.faults)
    hardware = sum(1 << bit for bit, name in HARDWARE_FAULTS.items() if name in m.faults)
    levels = bytes(m.levels[:6]).ljust(6, b"\0")
    head = bytes((card, hardware, round(m.battery_percent), m.inbound_state or 0))
    return frame("ZJXX", m.user, head + levels)


def _text_bits(m: Text | TextRequest) -> bytes:
    if len(m.payload) > MAX_TEXT:
        raise EncodeError(f"{len(m.payload)} bytes of text: {MAX_TEXT} at most")
    return (8 * len(m.payload) - 4 * m.odd).to_bytes(2, "big")


def _encode(m: Message) -> bytes:
    match m:
        case IdentityRequest():
            return frame("ICJC", m.user, bytes((m.index,)))
        case SelfTestRequest():
            return frame("XTZJ", m.user, m.period_s.to_bytes(2, "big"))
        case BeamPowerRequest():
            return frame("GLJC", m.user, bytes((m.period_s,)))
        case TimeRequest():
            return frame("SJSC", m.user, m.period_s.to_bytes(2, "big"))
        case VersionRequest():
            return frame("BBDQ", m.user, b"")
        case PortRateRequest():
            return frame("CKSC", m.user, bytes((m.code,)))
        case StopRequest():
            if m.command not in LENGTHS:
                raise EncodeError(f"{m.command} is no command")
            return frame("JSZL", m.user, m.command.encode())
        case PositionRequest():
            return _encode_position_request(m)
        case TextRequest():
            if not 0 <= m.receiver <= MAX_USER:
                raise EncodeError(f"{m.receiver} is no card of family 4.0")
            info = 0x44 if m.encoding == "chinese" else 0x46
            head = bytes((info,)) + m.receiver.to_bytes(3, "big") + _text_bits(m)
            return frame("TXSQ", m.user, head + bytes((m.acknowledge,)) + m.payload)
        case Text():
            info = 0x40 if m.encoding == "chinese" else 0x60
            when = bytes(divmod(m.minute_of_day or 0, 60))
            head = bytes((info,)) + m.sender.to_bytes(3, "big") + when + _text_bits(m)
            return frame("TXXX", m.user, head + m.payload + bytes((not m.crc_ok,)))
        case Identity():
            payload = (
                b"\0"
                + m.broadcast_id.to_bytes(3, "big")
                + bytes((m.user_class,))
                + m.service_frequency_s.to_bytes(2, "big")
                + bytes((m.comm_level, m.encryption))
                + m.subordinates.to_bytes(2, "big")
            )
            return frame("ICXX", m.user, payload)
        case Subordinates():
            addresses = b"".join(a.to_bytes(3, "big") for a in m.addresses)
            return frame("ICXX", m.user, bytes((m.index,)) + addresses)
        case BeamPower():
            return frame("GLZK", m.user, bytes(m.levels[:6]).ljust(6, b"\0"))
        case SelfTest():
            return _encode_self_test(m)
        case DeviceClock():
            date = m.year.to_bytes(2, "big") + bytes((m.month, m.day))
            return frame("SJXX", m.user, date + _time_bytes(m.time_of_day_s))
        case Feedback():
            return _encode_feedback(m)
        case Fix():
            return _encode_fix(m)
        case Unknown():
            return frame(m.name, m.user, m.payload)
        case _:
            raise EncodeError(f"{type(m).__name__} does not exist in family 4.0")


def encode(message: Message) -> bytes:
    """Frame of a message. Raises EncodeError for a message that 4.0 lacks or that is forbidden."""
    return encode_frame(_encode, message)
