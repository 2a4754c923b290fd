"""Messages between RDSS terminal and host, for both wire families.

Both codecs (`binary_4_0`, `text_2_1`) decode to these classes and encode from them, in both
directions. `user` is the card number in the frame's address field, 0 without one or for "this
terminal". A field that one family lacks has a default.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import date
from enum import IntEnum, StrEnum
from typing import Literal, Protocol

from drivers.rdss.mail import TextEncoding

Family = Literal["4.0", "2.1"]

FORBIDDEN = frozenset({"JJZH", "ZHSQ", "JMSZ", "CCJMS"})
"""Never encoded: destruction of the card's keys (JJZH, ZHSQ) and radio silence (JMSZ, CCJMS)."""


class EncodeError(ValueError):
    """Error: a message that this family cannot encode, or that must never be sent."""


class FieldError(ValueError):
    """Error: an implausible value in a verified frame."""


# --------------------------------------------------------------------------- host to terminal


class HeightMode(IntEnum):
    """Source of the height (4.0 DWSQ bits 3-2, 2.1 CCDWA field 3)."""

    GIVEN = 0
    NONE = 1
    ALTIMETER_1 = 2
    ALTIMETER_2 = 3


@dataclass(frozen=True, slots=True)
class IdentityRequest:
    """ICJC, CCICA: read the card; `index` >= 1 lists subordinates."""

    user: int = 0
    index: int = 0


@dataclass(frozen=True, slots=True)
class SelfTestRequest:
    """XTZJ, CCRMO ZTI: read the terminal's state every `period_s`, 0 once."""

    user: int = 0
    period_s: int = 0


@dataclass(frozen=True, slots=True)
class BeamPowerRequest:
    """GLJC, CCRMO BSI: read the power of the beams every `period_s`, 0 once."""

    user: int = 0
    period_s: int = 0


@dataclass(frozen=True, slots=True)
class TimeRequest:
    """SJSC, CCRMO ZDA: read the terminal's clock every `period_s`, 0 once."""

    user: int = 0
    period_s: int = 0


@dataclass(frozen=True, slots=True)
class VersionRequest:
    """BBDQ (4.0 only)."""

    user: int = 0


@dataclass(frozen=True, slots=True)
class PortRateRequest:
    """CKSC (4.0 only): set the serial rate by the vendor's code."""

    user: int = 0
    code: int = 0


@dataclass(frozen=True, slots=True)
class StopRequest:
    """JSZL (4.0 only): end the periodic output of a command, by its four letters."""

    user: int = 0
    command: str = "DWSQ"


@dataclass(frozen=True, slots=True)
class OutputRequest:
    """CCRMO (2.1 only) for any other sentence: mode 1 off, 2 on, 3 all off, 4 all on."""

    sentence: str
    mode: int
    period_s: int | None = None


@dataclass(frozen=True, slots=True)
class PositionRequest:
    """DWSQ, CCDWA: ask the centre for a position; `period_s` 0 is a single one.

    Heights in metres: `height_m` ellipsoidal, of the antenna; `antenna_height_m` above the ground.
    """

    user: int = 0
    height_mode: HeightMode = HeightMode.NONE
    height_m: float | None = None
    antenna_height_m: float | None = None
    pressure_pa: float | None = None
    temperature_c: float | None = None
    period_s: int = 0
    emergency: bool = False
    high_altitude: bool = False


@dataclass(frozen=True, slots=True)
class TextRequest:
    """TXSQ, CCTXA: send a short message; `acknowledge` only in 4.0, `category` only in 2.1.

    `odd`: a code's number of digits is odd, and the last half byte of `payload` means nothing.
    """

    receiver: int
    payload: bytes
    encoding: TextEncoding
    user: int = 0
    acknowledge: bool = False
    category: int = 1
    odd: bool = False


# --------------------------------------------------------------------------- terminal to host


@dataclass(frozen=True, slots=True)
class Identity:
    """ICXX frame 0, BDICI: the card. `user` 0: no card."""

    user: int
    service_frequency_s: int
    broadcast_id: int = 0
    user_class: int = 0
    comm_level: int = 0
    encryption: int = 0
    """Encryption as sent (4.0) or 1 for E, 0 for N (2.1); public sources invert it: for logs only.
    """
    subordinates: int = 0
    serial: int = 0


@dataclass(frozen=True, slots=True)
class Subordinates:
    """ICXX frame N (4.0 only): a part of the list of subordinate addresses."""

    user: int
    index: int
    addresses: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class BeamPower:
    """GLZK (6 beams), BDBSI (up to 10): levels 0 to 4 of beam 1, 2, ..."""

    levels: tuple[int, ...]
    user: int = 0
    response_beam: int = 0
    time_difference_beam: int = 0

    @property
    def serving(self) -> int | None:
        """Number of the serving beam, from 1: the one that the terminal names, else the
        strongest."""
        if self.response_beam:
            return self.response_beam
        best = max(self.levels, default=0)
        return self.levels.index(best) + 1 if best else None


CARD_FAULTS = {
    7: "card_handling",
    6: "card_id",
    5: "card_check_code",
    4: "card_serial_number",
    3: "card_kind",
    2: "card_data",
    1: "card_damaged",
}
HARDWARE_FAULTS = {7: "antenna", 6: "channel", 5: "main_board"}
ZTI_FAULTS = ("rf_module", "encryption_module", "antenna", "channel")


@dataclass(frozen=True, slots=True)
class SelfTest:
    """ZJXX, BDZTI: `faults` by the names of CARD_FAULTS, HARDWARE_FAULTS and ZTI_FAULTS.

    `inbound_state` is byte 13 of ZJXX as sent: its bits differ from vendor to vendor.
    """

    battery_percent: float
    faults: tuple[str, ...] = ()
    user: int = 0
    inbound_state: int | None = None
    levels: tuple[int, ...] = ()
    external_power: bool | None = None
    charging: bool | None = None
    remaining_min: int | None = None


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """SJXX, RDSS form of BDZDA. SJXX states neither its zone nor whether it is locked: None."""

    year: int
    month: int
    day: int
    time_of_day_s: float
    user: int = 0
    zone_h: int | None = None
    zone_min: int = 0
    locked: bool | None = None
    mode: int = 1
    precision: int = 0


class Outcome(StrEnum):
    """Contents of a feedback."""

    OK = "ok"
    FAILED = "failed"
    NOT_LOCKED = "not_locked"
    LOW_BATTERY = "low_battery"
    FREQUENCY = "frequency"
    ENCRYPTION = "encryption"
    CRC = "crc"
    SUPPRESSED = "suppressed"
    SILENCE = "silence"
    SILENCE_OR_LIFTED = "silence_or_lifted"
    """Flag 8 of FKXX: public sources read it as radio silence, one as suppression lifted."""
    NOT_SENT = "not_sent"
    """Refused with no reason given; typically no beam."""
    NO_CARD = "no_card"
    NO_PERMISSION = "no_permission"
    OTHER = "other"


@dataclass(frozen=True, slots=True)
class Feedback:
    """FKXX, BDFKI. `command` as printed ("DWSQ", "DWA"), None where the frame names none.

    `wait_s` is the stated remaining wait; `code` the flag or reason as sent. `inhibited` is BDFKI's
    state of transmission (suppression, silence, battery), None without one. Only the BDS-3 form of
    BDFKI has `time_of_day_s`.
    """

    outcome: Outcome
    command: str | None = None
    wait_s: float | None = None
    code: int = 0
    user: int = 0
    inhibited: bool | None = None
    time_of_day_s: int | None = None


FixKind = Literal["own", "query", "report"]


@dataclass(frozen=True, slots=True)
class Fix:
    """DWXX, BDDWR: a position, degrees (south and west negative) and metres.

    `time_of_day_s` is the time of day printed; `fraction` is the last byte of T in 4.0, whose unit
    differs from vendor to vendor and which `time_of_day_s` does not include; None in 2.1.
    `height_m` is taken as ellipsoidal, `height_anomaly_m` is the quasi-geoid's height.
    """

    user: int
    time_of_day_s: float
    lat_deg: float
    lon_deg: float
    height_m: float
    height_anomaly_m: float = 0.0
    precision_class_m: Literal[20, 100] = 20
    kind: FixKind = "own"
    queried: int = 0
    fraction: int | None = None
    emergency: bool = False
    multi_value: bool = False
    high_altitude: bool = False


@dataclass(frozen=True, slots=True)
class Text:
    """TXXX, BDTXR: a short message received; `minute_of_day` as printed, `odd` as in TextRequest.

    `user` is the receiver, 0 if the frame does not name it (2.1).
    """

    sender: int
    payload: bytes
    encoding: TextEncoding
    user: int = 0
    minute_of_day: int | None = None
    crc_ok: bool = True
    odd: bool = False


@dataclass(frozen=True, slots=True)
class Unknown:
    """Well-formed frame of an unsupported kind: name and payload or field text."""

    name: str
    payload: bytes
    user: int = 0


Request = (
    IdentityRequest
    | SelfTestRequest
    | BeamPowerRequest
    | TimeRequest
    | VersionRequest
    | PortRateRequest
    | StopRequest
    | OutputRequest
    | PositionRequest
    | TextRequest
)
Reply = Identity | Subordinates | BeamPower | SelfTest | DeviceClock | Feedback | Fix | Text
Message = Request | Reply | Unknown


class Decoder(Protocol):
    """Receiving side of a codec: bytes to messages. No bytes make it raise."""

    counters: Counter[str]

    @property
    def awaited_bytes(self) -> int:
        """Largest possible length of the incomplete frame, 0 for none."""

    def feed(self, data: bytes) -> list[Message]:
        """Add received bytes; return the messages that they complete."""

    def expire(self) -> list[Message]:
        """Give up the overdue frame, and search behind its `$`."""


def ascii_name(raw: bytes) -> str:
    """Frame name, already checked to be ASCII letters."""
    return raw.decode("ascii")


def split_time(whole_s: int) -> tuple[int, int, int]:
    """Second of the day to hour, minute, second; 86400, a leap second, is 23, 59, 60."""
    hour = min(whole_s // 3600, 23)
    minute = min((whole_s - hour * 3600) // 60, 59)
    return hour, minute, whole_s - hour * 3600 - minute * 60


def check_range(name: str, value: float, low: float, high: float) -> None:
    """FieldError unless low <= value <= high (NaN fails)."""
    if not low <= value <= high:
        raise FieldError(f"{name} {value} outside [{low}, {high}]")


def check_date(year: int, month: int, day: int) -> None:
    """Check that a day exists and is plausible for BeiDou receivers. Raises FieldError."""
    check_range("year", year, 1980, 2399)
    try:
        date(year, month, day)
    except ValueError as error:
        raise FieldError(str(error)) from None
