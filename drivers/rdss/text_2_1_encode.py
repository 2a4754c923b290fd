"""RDSS terminal interface, family 2.1: messages to sentences. `text_2_1` describes the format."""

from __future__ import annotations

from typing import Literal

from drivers.rdss.framing import checksum, encode_frame
from drivers.rdss.mail import TextEncoding
from drivers.rdss.messages import (
    FORBIDDEN,
    ZTI_FAULTS,
    BeamPower,
    BeamPowerRequest,
    DeviceClock,
    EncodeError,
    Feedback,
    Fix,
    FixKind,
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
    split_time,
)

MAX_SENTENCE = 512
"""Longest sentence believed: 420 hex digits of text (1680 bits) and its header, rounded up."""


def sentence(name: str, fields: bytes) -> bytes:
    """Make a sentence. EncodeError for a name that must never be sent, or a field that cannot be in
    a sentence."""
    if name in FORBIDDEN:
        raise EncodeError(f"{name} is never sent")
    if not _is_name(name.encode()) or any(b < 0x20 or b in b"$*" for b in fields):
        raise EncodeError(f"{name},{fields!r} is no sentence")
    body = name.encode() + b"," + fields
    if len(body) + 6 > MAX_SENTENCE:
        raise EncodeError(f"{name}: {len(body)} bytes are too many")
    return b"$%b*%02X\r\n" % (body, checksum(body))


def _is_name(raw: bytes) -> bool:
    return len(raw) == 5 and raw[:2].isalpha() and raw.isalnum() and raw.isupper()


KINDS: dict[str, FixKind] = {"1": "own", "2": "query", "3": "report"}
INHIBIT = {1: Outcome.SUPPRESSED, 2: Outcome.LOW_BATTERY, 3: Outcome.SILENCE}
REASONS = {
    0: Outcome.NOT_SENT,
    1: Outcome.FREQUENCY,
    2: Outcome.SUPPRESSED,
    3: Outcome.SILENCE,
    4: Outcome.NOT_LOCKED,
    5: Outcome.NO_CARD,
    6: Outcome.NO_PERMISSION,
    11: Outcome.CRC,
}
ENCODINGS: tuple[TextEncoding, ...] = ("chinese", "code", "mixed")


def _print(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.1f}" if value else "0"


def _print_time(time_of_day_s: float, decimals: int) -> str:
    """Format hhmmss.ss without rounding up to 60 seconds."""
    scale: int = 10**decimals
    whole, part = divmod(int(time_of_day_s * scale + 1e-6), scale)
    text = "{:02d}{:02d}{:02d}".format(*split_time(whole))
    return f"{text}.{part:0{decimals}d}" if decimals else text


def _print_angle(angle_deg: float, digits: int, hemispheres: Literal["NS", "EW"]) -> str:
    degrees, parts = divmod(round(abs(angle_deg) * 600_000), 600_000)
    return f"{degrees:0{digits}d}{parts / 10_000:07.4f},{hemispheres[angle_deg < 0]}"


def _print_wait(wait_s: float | None) -> str:
    minutes, seconds = divmod(round(wait_s or 0), 60)
    if minutes > 99:
        raise EncodeError(f"wait of {wait_s} s is no mmss")
    return f"{minutes:02d}{seconds:02d}"


def _encode_feedback(m: Feedback) -> bytes:
    executed = "Y" if m.outcome is Outcome.OK else "N"
    if m.time_of_day_s is not None:
        reasons = {outcome: reason for reason, outcome in REASONS.items()}
        if m.outcome not in (Outcome.OK, Outcome.OTHER, *reasons):
            raise EncodeError(f"the BDS-3 form of BDFKI has no reason for {m.outcome}")
        reason = 0 if m.outcome is Outcome.OK else reasons.get(m.outcome, m.code)
        text = f"{_print_time(m.time_of_day_s, 0)},{m.command or ''},{executed},{reason},"
        return sentence("BDFKI", (text + str(round(m.wait_s or 0))).encode())
    inhibits = {outcome: inhibit for inhibit, outcome in INHIBIT.items()}
    inhibit = inhibits.get(m.outcome, m.code if m.outcome is Outcome.OTHER else 0)
    frequency_ok = "N" if m.outcome is Outcome.FREQUENCY and not m.wait_s else "Y"
    text = f"{m.command or ''},{executed},{frequency_ok},{inhibit},{_print_wait(m.wait_s)}"
    return sentence("BDFKI", text.encode())


def _encode_fix(m: Fix) -> bytes:
    kind = {kind: digit for digit, kind in KINDS.items()}[m.kind]
    fields = (
        f"{kind},{m.user:07d},{_print_time(m.time_of_day_s, 2)},"
        f"{_print_angle(m.lat_deg, 2, 'NS')},{_print_angle(m.lon_deg, 3, 'EW')},"
        f"{_print(m.height_m)},M,{_print(m.height_anomaly_m)},M,"
        f"{int(m.precision_class_m == 100)},{'AV'[not m.emergency]},{'AV'[not m.multi_value]},"
        f"{'HL'[not m.high_altitude]}"
    )
    return sentence("BDDWR", fields.encode())


def _encode_self_test(m: SelfTest) -> bytes:
    flags = [name in m.faults for name in ZTI_FAULTS]
    flags += [bool(m.external_power), bool(m.charging)]
    left = "" if m.remaining_min is None else "{:02d}{:02d}".format(*divmod(m.remaining_min, 60))
    text = ",".join(str(int(flag)) for flag in flags) + f",{m.battery_percent:.1f},{left}"
    return sentence("BDZTI", text.encode())


def _printed(m: Text | TextRequest) -> bytes:
    if m.encoding == "chinese":
        if b"," in m.payload:
            raise EncodeError("a comma in a Chinese text would end the field")
        return m.payload
    digits = m.payload.hex().upper().encode()
    return digits[:-1] if m.odd else digits


def _encode(m: Message) -> bytes:
    match m:
        case IdentityRequest():
            return sentence("CCICA", b"0,%02d" % m.index)
        case BeamPowerRequest():
            return sentence("CCRMO", b"BSI,2,%d" % m.period_s)
        case TimeRequest():
            return sentence("CCRMO", b"ZDA,2,%d" % m.period_s)
        case SelfTestRequest():
            return sentence("CCRMO", b"ZTI,2,%d" % m.period_s)
        case OutputRequest():
            period = "" if m.period_s is None else str(m.period_s)
            return sentence("CCRMO", f"{m.sentence},{m.mode},{period}".encode())
        case PositionRequest():
            text = (
                f"{m.user:07d},{'AV'[not m.emergency]},{m.height_mode:d},"
                f"{'HL'[not m.high_altitude]},{_print(m.height_m)},{_print(m.antenna_height_m)},"
                f"{_print(m.pressure_pa)},{_print(m.temperature_c)},{m.period_s}"
            )
            return sentence("CCDWA", text.encode())
        case TextRequest():
            head = f"{m.receiver:07d},{m.category},{ENCODINGS.index(m.encoding)},"
            return sentence("CCTXA", head.encode() + _printed(m))
        case Text():
            when = (
                ""
                if m.minute_of_day is None
                else "{:02d}{:02d}".format(*divmod(m.minute_of_day, 60))
            )
            head = f"1,{m.sender:07d},{ENCODINGS.index(m.encoding)},{when},"
            return sentence("BDTXR", head.encode() + _printed(m))
        case Identity():
            text = (
                f"{m.user:07d},{m.serial:08d},{m.broadcast_id:07d},{m.user_class},"
                f"{m.service_frequency_s},{m.comm_level},{'EN'[not m.encryption]},{m.subordinates}"
            )
            return sentence("BDICI", text.encode())
        case BeamPower():
            levels = ",".join(map(str, m.levels))
            text = f"{m.response_beam:02d},{m.time_difference_beam:02d},{levels}"
            return sentence("BDBSI", text.encode())
        case SelfTest():
            return _encode_self_test(m)
        case DeviceClock():
            zone = f"{m.zone_h or 0:0{3 if (m.zone_h or 0) < 0 else 2}d}"
            text = (
                f"{m.mode},{_print_time(m.time_of_day_s, 2)},"
                f"{m.day:02d},{m.month:02d},{m.year:04d},"
                f"{zone},{m.zone_min:02d},000000.00,0,{m.precision},"
            )
            return sentence("BDZDA", text.encode() + (b"Y" if m.locked else b"N"))
        case Feedback():
            return _encode_feedback(m)
        case Fix():
            return _encode_fix(m)
        case Unknown():
            return sentence(m.name, m.payload)
        case _:
            raise EncodeError(f"{type(m).__name__} does not exist in family 2.1")


def encode(message: Message) -> bytes:
    """Sentence of a message. EncodeError for a message that 2.1 lacks or that is forbidden."""
    return encode_frame(_encode, message)
