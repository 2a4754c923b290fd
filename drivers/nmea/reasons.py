"""Reasons why a receiver's bytes give no fix, or a poor one: one sentence each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import date, timedelta

from drivers.nmea.unsupported_protocols import protocol_sentence, verified_protocol

REFUSALS = {
    "no_fix": "the receiver has no fix",
    "dead_reckoning_refused": "only the receiver's own dead reckoning, which is not fused",
    "manual_refused": "the receiver repeats a position that was put in by hand",
    "simulator_refused": "the receiver simulates: allow_simulator would accept it",
    "duplicate_epoch": "the receiver repeats an epoch or goes back in time",
    "unknown_quality": "the receiver states a GGA quality that NMEA does not know",
    "datum_refused": "the receiver states another datum than WGS 84 (DTM): set it to W84",
    "height_implausible": "the receiver states a height at which no vehicle can be",
    "speed_implausible": "the receiver states a speed that no vehicle has",
    "sigma_too_large": "the receiver states that it does not know where it is (GST)",
}
"""Reasons by the counter of a refused epoch."""
TALKERS_NOT_READ = {
    "EC": "a chart display",
    "EI": "a chart display",
    "AI": "AIS",
    "LC": "Loran-C",
    "SN": "an electronic positioning system",
}
"""NMEA 0183 4.11, table of talker identifiers."""
FULLER = frozenset({"GGA", "GNS", "RMC"})
"""Sentences that say all that GLL does."""
POSITIONS = FULLER | {"GLL"}
OF_A_COMPASS = ("HDM", "HDG", "HDT", "THS")
OWN_SENTENCES = {
    "PUBX": "u-blox",
    "PTNL": "Trimble",
    "PSTI": "SkyTraq",
    "PASHR": "Ashtech, Applanix and others: attitude of an inertial system",
    "PQTM": "Quectel",
    "PSAT": "Hemisphere",
    "PSSN": "Septentrio",
    "PGLOR": "Broadcom",
    "PMTK": "MediaTek",
    "PAIR": "Airoha, Quectel",
    "PSTM": "ST",
    "PSRF": "SiRF",
    "PNVG": "NVS",
    "PGRM": "Garmin",
    "KSXT": "Unicore, ComNav and others",
    "GPHPD": "ComNav and others",
    "GNHPD": "ComNav and others",
    "GPFPD": "inertial systems: their own solution",
    "GTIMU": "inertial systems",
}
"""Owners of proprietary sentences, by prefix, with position or attitude."""
ATTITUDES = (
    "PASHR",
    "PTNL,AVR",
    "PSAT,HPR",
    "PSSN,HRP",
    "PSTI,036",
    "PQTMTAR",
    "GPHPR",
    "GNHPR",
    "KSXT",
)
"""Prefixes of sentences of two-antenna receivers with heading, roll or pitch."""
MOST_NAMES = 8
"""Most talkers and formatters to remember; the first are enough to name."""
KIND_LETTERS = (2, 3)
"""Letters of the field that names a kind (PUBX,00; PTNL,GGK; PSTI,030)."""
ROLLOVER = timedelta(weeks=1024)
ROLLOVER_SPAN = timedelta(days=3653)
"""Span of dates that are plausible after correction of a rollover: ten years from this software's
on."""
MANY = 3
"""Sentences without a checksum before a report; a single one may have lost its own."""
FIRST_FIXES = 10
"""First fixes of a cold receiver, which may be two-dimensional for a while."""
UBX = (
    "UBX frames arrive, but no NMEA: switch on NMEA output on this port, or have UBX read: "
    'driver = "ubx" (process: --aid ubx=FILE)'
)
CHECKSUMS = (
    "sentences come without a checksum and are not used, for a damaged digit would pass: switch "
    "checksums on at the receiver"
)


@dataclass(slots=True)
class Received:
    """Received items that a decoder does not use, beside its counters."""

    talkers: Counter[str] = field(default_factory=Counter)
    """Talkers of sentences with a position."""
    unused: Counter[str] = field(default_factory=Counter)
    """Formatters that are not read."""
    used: Counter[str] = field(default_factory=Counter)
    """Used sentences."""
    statuses: Counter[str] = field(default_factory=Counter)
    """Statuses of RMC outside the standard."""
    datum: str = ""
    """Datum of DTM."""
    implausible_date: date | None = None
    no_date: str = ""
    """Invalid printed date of RMC."""


def count_name(names: Counter[str], name: str) -> None:
    """Count a name, up to a limit of different names."""
    if name in names or len(names) < MOST_NAMES:
        names[name] += 1


def proprietary_name(address: str, fields: Sequence[str]) -> str:
    """Name of a proprietary sentence: its address, and its kind if the first field states one."""
    kind = fields[0] if fields else ""
    is_kind = kind.isalnum() and len(kind) in KIND_LETTERS
    return f"{address},{kind}" if is_kind else address


def wrong_checksums(counters: Counter[str]) -> str:
    """Reason why no sentence verifies, if the checksums are wrong; "" otherwise."""
    if counters["checksum_missing"] >= MANY > counters["sentences"]:
        return f"NMEA {CHECKSUMS}"
    if counters["checksum_bad"] >= MANY > counters["sentences"]:
        return (
            f"{counters['checksum_bad']} wrong checksums against 0 sound: check ground, cable "
            "length and that nobody else reads this port, or has edited this file"
        )
    return ""


def nothing_verified(counters: Counter[str], unread: bytes) -> str:
    """Reason why none of the received sentences verifies; "" if the baud rate may be wrong."""
    # Some bytes of a binary protocol look like sentences without a checksum, or with a wrong one.
    if found := verified_protocol(unread) or wrong_checksums(counters):
        return found
    if counters["address_bad"] >= MANY:
        return (
            "sentences arrive whose names are not NMEA's (small letters?) and are not read: use "
            "the receiver's unchanged output, or switch on GGA and RMC"
        )
    if counters["ubx_frames"]:
        return UBX
    if counters["rtcm_frames"]:
        return "RTCM 3 frames arrive, but no NMEA: switch on NMEA output on this port"
    if counters["ubx_damaged"] >= MANY:
        return (
            f"{counters['ubx_damaged']} UBX frames arrive with wrong checksums: check ground, "
            "cable length and that nobody else reads this port"
        )
    return protocol_sentence(unread)


def no_fix(counters: Counter[str], received: Received, refusal: str) -> str:
    """Reason why sentences arrive without a fix; `refusal` is the last epoch's."""
    if refusal:
        return REFUSALS.get(refusal, refusal)
    if received.talkers and not POSITIONS & set(received.used):
        talker = received.talkers.most_common(1)[0][0]
        what = TALKERS_NOT_READ.get(talker)
        kind = f" ({what})" if what else ""
        return (
            f"positions of talker {talker}{kind} arrive, which are not read: set the receiver to "
            "talker GP or GN"
        )
    own = next((a for a in received.unused for o in OWN_SENTENCES if a.startswith(o)), "")
    if own and not POSITIONS & set(received.used):
        whose = next(who for o, who in OWN_SENTENCES.items() if own.startswith(o))
        return (
            f"sentences of a maker's own arrive (${own}: {whose}), which are not read: switch on "
            "GGA, RMC and GST"
        )
    if counters["checksum_missing"] >= MANY:
        return CHECKSUMS
    if counters["ubx_frames"] > counters["sentences"] and not POSITIONS & set(received.used):
        return UBX  # and a text now and then
    if counters["untimed_epoch"] and POSITIONS & set(received.used):
        return "positions arrive without a time of day, and are not used: give the antenna more sky"
    if counters["bad_field"] and not POSITIONS & set(received.used):
        return (
            "the positions that arrive have fields that cannot be true (bad_field): check the "
            "line, or reset the receiver"
        )
    heading = _heading(received)
    if heading and not POSITIONS & set(received.used):
        return (
            f"headings of a compass arrive ({heading}), and no position: a source with "
            'driver = "compass" reads them'
        )
    names = [*received.used, *received.unused]
    which = f" ({', '.join(names[:MOST_NAMES])})" if names else ""
    if not counters["epochs"]:
        return f"sentences arrive{which}, but none that counts: switch on GGA and RMC"
    return f"epochs arrive{which}, but none has a position: switch on GGA"


def _heading(received: Received) -> str:
    """Sentence on a compass's sentences that were left out; "" without any."""
    return next((name for name in OF_A_COMPASS if name in received.unused), "")


def _attitude(received: Received) -> str:
    """Sentence on a heading that only a proprietary sentence has; "" otherwise."""
    name = next((n for n in received.unused for own in ATTITUDES if n.startswith(own)), "")
    if not name or {"HDT", "THS"} & set(received.used):
        return ""
    return (
        f"the receiver's heading arrives in a sentence of its maker's alone (${name}), which is "
        "not read: switch on THS or HDT"
    )


def cautions(counters: Counter[str], received: Received, earliest: date) -> dict[str, str]:
    """Cautions by counter: limits on the quality of fixes, and the actions taken."""
    found = {}
    day = received.implausible_date
    if day is not None:
        found["implausible_date"] = implausible_date(day, earliest)
    if counters["bad_date"] >= MANY:
        found["bad_date"] = (
            f"RMC has {received.no_date[:8]!r} for a date, which is none: its times of day are "
            "used, and the date is another source's"
        )
    if counters["checksum_missing"] >= MANY and counters["sentences"]:
        found["checksum_missing"] = CHECKSUMS
    if counters["height_above_sea"] > counters["fixes"] // 2:
        found["height_above_sea"] = (
            "the receiver does not say how high the geoid is: its altitude above the sea is used, "
            "with one sigma of 62 m; switch on the geoid separation in GGA"
        )
    if counters["height_not_measured"] > max(counters["fixes"] // 2, FIRST_FIXES):
        found["height_not_measured"] = (
            "GSA says that fixes are two-dimensional: they are used without their height; give the "
            "antenna more sky, or set the receiver to three dimensions"
        )
    if counters["height_missing"] > counters["fixes"] // 2:
        found["height_missing"] = (
            "the altitude in GGA is empty or not in metres: fixes are used without a height; "
            "switch it on, in metres"
        )
    if counters["rmc_alone"]:
        refused = " (other sentences have fields that cannot be true)" * (
            counters["bad_field"] >= MANY
        )
        found["rmc_alone"] = (
            f"only RMC has a position{refused}: it is used without height and with the sigma of a "
            "poor sky; switch on GGA and GST"
        )
    if counters["gll_alone"]:
        found["gll_alone"] = (
            "only GLL has a position: it is used without height and with the sigma of a poor sky; "
            "switch on GGA, RMC and GST"
        )
    heading = _heading(received)
    if heading and counters["fixes"]:
        found["compass_left_out"] = (
            f"headings of a compass arrive ({heading}), which a receiver's source does not use: a "
            'source with driver = "compass" reads them'
        )
    if attitude := _attitude(received) * bool(counters["fixes"]):
        found["attitude_left_out"] = attitude
    if counters["integrated"]:
        found["integrated"] = (
            "the positions' talker is II or IN: a plotter or an adapter may have smoothed them, or "
            "gone on by dead reckoning, and its sigma does not say so; better the receiver's own "
            "sentences (GP, GN)"
        )
    if counters["unknown_status"]:
        status = received.statuses.most_common(1)[0][0]
        found["unknown_status"] = (
            f"RMC has the status {status!r}, which NMEA does not define: its velocity is not used; "
            "update the firmware"
        )
    if counters["two_receivers"] > max(counters["fixes"] // 2, MANY):
        found["two_receivers"] = (
            "positions of two talkers alternate and differ: two receivers are on this line, and "
            "their fixes are mixed; give each a port of its own"
        )
    if counters["course_missing"] > max(counters["fixes"] // 2, MANY):
        found["course_missing"] = (
            "the receiver moves and gives a speed without a course: its fixes are used without "
            "velocity; switch the course on in RMC or VTG"
        )
    if counters["speed_held_at_zero"] >= MANY:
        found["speed_held_at_zero"] = (
            "the receiver prints a speed of 0 whenever it is slow: it is used as one below 1.4 "
            "m/s; switch static navigation (static hold) off"
        )
    return found


def implausible_date(day: date, earliest: date) -> str:
    """Sentence on an impossible date."""
    wrong = f"before {earliest}" if day < earliest else "too far ahead"
    text = f"the receiver's date is {day}, {wrong}: its dates are not used, its times of day are"
    later = day + ROLLOVER if day < earliest else day
    if earliest <= later <= earliest + ROLLOVER_SPAN and later != day:
        return f"{text}; if {later} is right, 1024 weeks later, its GPS week has rolled over"
    return text
