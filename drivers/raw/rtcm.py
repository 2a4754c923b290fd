"""RTCM 3: MSM4 to 7 of GPS, Galileo and BeiDou, ephemerides 1019, 1042, 1045, 1046, 1013, and SSR.

    pseudorange  c/1000 * (DF397 + DF398 + DF400)     DF405 in place of DF400 in MSM6 and 7; ms
    carrier      f/1000 * (DF397 + DF398 + DF401)     DF406 in MSM6 and 7; cycles
    rate         DF399 + DF404                        MSM5 and 7; m/s, positive while it grows
    epoch        DF004, DF248: GPS time; DF427: BeiDou time, 14 s behind it; ms of week
    angles       semicircles, times PI

The messages of one epoch become one `RawGnssEpoch`. It ends with the message whose multiple-message
bit (DF393) is off, whatever its system, or with the next epoch. If a system sends several kinds of
MSM, only the highest is used: kinds may differ in the receiver clock (by 108 km between MSM6 and
MSM7 in a public log). The week is not sent; it is the one nearest to the last full instant. pyrtcm
parses the payloads; it is imported with the first frame. Source: RTCM 10403.3, section 3.5.
"""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

from drivers.base import PermanentDriverError
from drivers.measurements import UtcStamp
from drivers.plausible import LEAP_SECONDS as PLAUSIBLE_LEAP_SECONDS
from drivers.plausible import within
from drivers.raw.beidou_words import GEO
from drivers.raw.bits import PI, Bits
from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    Ephemeris,
    RawEvent,
    RawGnssEpoch,
    RawSignal,
    System,
)
from drivers.raw.ssr import GLONASS, MESSAGES, OTHERS, SsrDecoder
from drivers.raw.subframes import RefusedError, check_orbit, sisa_m, ura_m
from drivers.raw.ubx import MAX_PRN, PSEUDORANGE_M
from drivers.raw.weeks import BDT_BEHIND_GPS_S, WEEK_S, WeekReference, leap_seconds, utc_ns

MSM_SYSTEMS: dict[int, System] = {107: "G", 109: "E", 112: "C"}
"""Systems by MSM message number without its last digit, the kind of MSM."""
MSM_KINDS = frozenset({4, 5, 6, 7})
OTHER_MSM = {
    108: "glonass_not_used",
    110: "sbas_not_used",
    111: "qzss_not_used",
    113: "navic_not_used",
}
SYSTEM_PARAMETERS = 1013
SSR = frozenset((*MESSAGES, *GLONASS, *OTHERS))
"""Message numbers of corrections, decoded in drivers.raw.ssr."""
MJD_1980_01_06 = 44_244
"""Day 0 of GPS time as a modified Julian date."""
EPHEMERIDES: dict[int, System] = {1019: "G", 1042: "C", 1045: "E", 1046: "E"}

_MS_M = SPEED_OF_LIGHT_M_S / 1000.0
_NO_RANGE_MS = 255
_NO_RATE_M_S = -8192
_EPOCH_FIELD: dict[System, str] = {"G": "DF004", "E": "DF248", "C": "DF427"}

# Value of a field that is marked invalid: its most negative number.
_NO_FINE_RANGE_MS = {"DF400": -(2.0**-10), "DF405": -(2.0**-10)}
_NO_FINE_CARRIER_MS = {"DF401": -(2.0**-8), "DF406": -(2.0**-8)}
_NO_FINE_RATE_M_S = -1.6384

# Fields of the ephemerides: GPS, BeiDou, Galileo.
_NAMES = (
    ("inclination_rate", "DF079", "DF491", "DF292"),
    ("toc_s", "DF081", "DF493", "DF293"),
    ("clock_drift_rate", "DF082", "DF494", "DF294"),
    ("clock_drift", "DF083", "DF495", "DF295"),
    ("clock_bias_s", "DF084", "DF496", "DF296"),
    ("crs", "DF086", "DF498", "DF297"),
    ("mean_motion_correction", "DF087", "DF499", "DF298"),
    ("mean_anomaly", "DF088", "DF500", "DF299"),
    ("cuc", "DF089", "DF501", "DF300"),
    ("eccentricity", "DF090", "DF502", "DF301"),
    ("cus", "DF091", "DF503", "DF302"),
    ("sqrt_a", "DF092", "DF504", "DF303"),
    ("toe_s", "DF093", "DF505", "DF304"),
    ("cic", "DF094", "DF506", "DF305"),
    ("ascending_node", "DF095", "DF507", "DF306"),
    ("cis", "DF096", "DF508", "DF307"),
    ("inclination", "DF097", "DF509", "DF308"),
    ("crc", "DF098", "DF510", "DF309"),
    ("perigee", "DF099", "DF511", "DF310"),
    ("ascending_node_rate", "DF100", "DF512", "DF311"),
)
_COLUMN: dict[System, int] = {"G": 1, "C": 2, "E": 3}
_ANGLES = frozenset(
    {
        "inclination_rate",
        "mean_motion_correction",
        "mean_anomaly",
        "ascending_node",
        "inclination",
        "perigee",
        "ascending_node_rate",
    }
)

Parse = Callable[[bytes], Any]


def message_number(frame: bytes) -> int:
    """Message number of a frame, 0 of one too short."""
    return int.from_bytes(frame[3:5], "big") >> 4 if len(frame) >= 8 else 0


def load_pyrtcm() -> Parse:
    """Import the parser of verified frames. It skips the CRC, which would take longer than the
    rest. PermanentDriverError if pyrtcm is not installed."""
    try:
        pyrtcm = importlib.import_module("pyrtcm")
    except ImportError as error:
        raise PermanentDriverError(
            "RTCM 3 needs the package pyrtcm: install fusiond[raw], or set rtcm = false"
        ) from error
    return partial(pyrtcm.RTCMReader.parse, validate=pyrtcm.VALNONE)


class RtcmDecoder:
    """Decoder of verified frames into events. Counts every frame under one name, and refused
    signals."""

    def __init__(self, source: str, weeks: WeekReference, counters: Counter[str]) -> None:
        self.leap_seconds: int | None = None
        """Store another message of the stream."""
        self._source = source
        self._weeks = weeks
        self._counters = counters
        self._ssr = SsrDecoder(source, weeks, counters)
        self._parse: Parse | None = None
        self._epoch: tuple[int, float] | None = None
        self._signals: dict[tuple[str, int, str], RawSignal] = {}
        self._kinds: dict[System, int] = {}
        self._t_seen_ns = 0

    @property
    def epoch_open(self) -> bool:
        """True if `flush` would end an epoch."""
        return self._epoch is not None

    def decode(self, frame: bytes, t_seen_ns: int) -> list[RawEvent]:
        """Result of a frame."""
        bits = Bits.of_bytes(frame[3:-3])
        number = bits.unsigned(0, 12) if bits.length >= 12 else 0
        group, kind = divmod(number, 10)
        msm = 1 <= kind <= 7 and (group in MSM_SYSTEMS or group in OTHER_MSM)
        if msm and bits.length < 55:
            self._counters["rtcm_unreadable"] += 1
            return []
        if number == SYSTEM_PARAMETERS and bits.length >= 70:
            self._parameters(bits)
            return []
        if number in SSR:
            return list(self._ssr.decode(number, bits, t_seen_ns))
        if not msm and number not in EPHEMERIDES:
            self._counters["rtcm_not_used"] += 1
            return []
        found: list[RawEvent] = []
        if not msm or (group in MSM_SYSTEMS and kind in MSM_KINDS):
            message = self._message(frame)
            if message is None:
                self._counters["rtcm_unreadable"] += 1
            elif msm:
                self._observe(MSM_SYSTEMS[group], kind, message, t_seen_ns, found)
            else:
                self._ephemeris(number, message, t_seen_ns, found)
        elif group in MSM_SYSTEMS:
            self._counters["msm_kind_not_used"] += 1
        else:
            self._counters[OTHER_MSM[group]] += 1
        if msm and not bits.unsigned(54, 1):  # DF393: this was the last message of the epoch
            found += self.flush()
        return found

    def flush(self) -> list[RawEvent]:
        """Open epoch, if any."""
        epoch, signals = self._epoch, tuple(self._signals.values())
        self._epoch = None
        self._signals.clear()
        self._kinds.clear()
        if epoch is None:
            return []
        week, tow_s = epoch
        leap = self.leap_seconds
        if leap is None:
            self._counters["leap_seconds_assumed"] += 1
            leap = leap_seconds(week, tow_s)
        self._counters["epochs_raw"] += 1
        stamp = UtcStamp(utc_ns(week, tow_s, leap))
        return [RawGnssEpoch(self._source, self._t_seen_ns, stamp, week, tow_s, signals)]

    def _parameters(self, bits: Bits) -> None:
        """Note the system parameters of 1013: day (DF051, modified Julian), second of UTC's day
        (DF052), leap seconds (DF054); implausible ones are None."""
        self._counters["rtcm_system_parameters"] += 1
        day, second, leap = bits.unsigned(24, 16), bits.unsigned(40, 17), bits.unsigned(62, 8)
        if not within(leap, PLAUSIBLE_LEAP_SECONDS):
            self._counters["leap_seconds_implausible"] += 1
            return
        self.leap_seconds = leap
        if day >= MJD_1980_01_06 and second < 86_400:
            self._weeks.note(0, (day - MJD_1980_01_06) * 86_400 + second + leap)

    def _message(self, frame: bytes) -> Any | None:
        """Frame as parsed by pyrtcm; None for any error of pyrtcm."""
        if self._parse is None:
            self._parse = load_pyrtcm()
        try:
            return self._parse(frame)
        except Exception:  # it may raise anything for a damaged or newer message
            return None

    # ----------------------------------------------------------------- observations

    def _observe(
        self, system: System, kind: int, message: Any, t_seen_ns: int, found: list[RawEvent]
    ) -> None:
        # Whole ms until the end, so that equal instants in BDT and GPS time compare equal.
        tow_ms = int(getattr(message, _EPOCH_FIELD[system]))
        if system == "C":
            tow_ms = (tow_ms + BDT_BEHIND_GPS_S * 1000) % (WEEK_S * 1000)
        tow_s = tow_ms * 1e-3
        if not 0.0 <= tow_s < WEEK_S:
            self._counters["rtcm_unreadable"] += 1
            return
        week = self._weeks.week_of_tow(tow_s)
        if week is None:
            self._counters["week_unknown"] += 1
            return
        if self._epoch is not None and self._epoch != (week, tow_s):
            found += self.flush()
        known = self._kinds.get(system, kind)
        if kind < known:
            self._counters["msm_superseded"] += 1
            return
        if kind > known:
            old = [key for key in self._signals if key[0] == system]
            self._counters["signal_superseded"] += len(old)
            for key in old:
                del self._signals[key]
        self._kinds[system] = kind
        self._counters["msm"] += 1
        self._epoch, self._t_seen_ns = (week, tow_s), t_seen_ns
        self._weeks.note_tow(week, tow_s)
        for signal in _signals(system, message, self._counters):
            key = (signal.system, signal.prn, signal.signal)
            if key in self._signals:
                self._counters["signal_repeated"] += 1
                continue
            self._signals[key] = signal

    # ----------------------------------------------------------------- ephemerides

    def _ephemeris(self, number: int, message: Any, t_seen_ns: int, found: list[RawEvent]) -> None:
        system = EPHEMERIDES[number]
        try:
            ephemeris = self._build(system, number, message, t_seen_ns)
            check_orbit(ephemeris)
        except RefusedError as refused:
            self._counters[str(refused)] += 1
        except (AttributeError, TypeError, ValueError):
            self._counters["rtcm_unreadable"] += 1
        else:
            self._counters["rtcm_ephemerides"] += 1
            found.append(ephemeris)

    def _build(self, system: System, number: int, message: Any, t_seen_ns: int) -> Ephemeris:
        def value(name: str) -> Any:
            return getattr(message, name)

        numbers: dict[str, Any] = {}
        for row in _NAMES:
            scale = PI if row[0] in _ANGLES else 1.0
            numbers[row[0]] = float(value(row[_COLUMN[system]])) * scale
        toe_s = numbers["toe_s"]
        prn = int(value({"G": "DF009", "C": "DF488", "E": "DF252"}[system]))
        if not 1 <= prn <= MAX_PRN[system]:
            raise RefusedError("satellite_unknown")
        rest: dict[str, Any]
        if system == "G":
            if value("DF085") & 0xFF != value("DF071"):
                raise RefusedError("ephemeris_mixed")
            rest = {
                "message": "lnav",
                "week": self._weeks.gps_week(value("DF076"), toe_s),
                "group_delay_s": (value("DF101"),),
                "issue": value("DF071"),
                "accuracy_m": ura_m(value("DF077")),
                "healthy": value("DF102") == 0,
            }
        elif system == "C":
            if numbers["toc_s"] != toe_s:
                raise RefusedError("ephemeris_mixed")
            rest = {
                "message": "d2" if prn in GEO else "d1",
                "week": self._weeks.bdt_week(value("DF489"), toe_s),
                "group_delay_s": (value("DF513") * 1e-9, value("DF514") * 1e-9),
                "issue": value("DF492"),
                "accuracy_m": ura_m(value("DF490")),
                "healthy": value("DF515") == 0,
            }
        else:
            rest = {
                "week": self._weeks.galileo_week(value("DF289"), toe_s),
                "issue": value("DF290"),
            }
            if number == 1045:
                rest |= {
                    "message": "fnav",
                    "group_delay_s": (value("DF312"),),
                    "accuracy_m": sisa_m(value("DF291")),
                    "healthy": value("DF314") == 0 and value("DF315") == 0,
                }
            else:
                rest |= {
                    "message": "inav",
                    "group_delay_s": (value("DF312"), value("DF313")),
                    "accuracy_m": sisa_m(value("DF286")),
                    "healthy": value("DF287") == 0 and value("DF288") == 0,
                }
        return Ephemeris(self._source, t_seen_ns, system, prn, **rest, **numbers)


def _signals(system: System, message: Any, counters: Counter[str]) -> list[RawSignal]:
    """Good cells of an MSM; the others are counted."""
    satellites = {
        getattr(message, f"PRN_{i:02d}"): (
            getattr(message, f"DF397_{i:02d}"),
            getattr(message, f"DF398_{i:02d}"),
            getattr(message, f"DF399_{i:02d}", _NO_RATE_M_S),
        )
        for i in range(1, message.NSat + 1)
    }
    fine = "DF405" if hasattr(message, "DF405_01") else "DF400"
    phase = "DF406" if fine == "DF405" else "DF401"
    strength = "DF408" if fine == "DF405" else "DF403"
    lock = "DF407" if fine == "DF405" else "DF402"
    found: list[RawSignal] = []
    for i in range(1, message.NCell + 1):
        counters[f"measured_{system}"] += 1
        name, code = getattr(message, f"CELLPRN_{i:02d}"), getattr(message, f"CELLSIG_{i:02d}")
        carrier_hz = CARRIER_HZ.get((system, code[:1]))
        if carrier_hz is None or len(code) != 2:
            counters["signal_unknown"] += 1
            continue
        if not (name.isdigit() and 1 <= int(name) <= MAX_PRN[system]):
            counters["prn_unknown"] += 1
            continue
        whole, part, rough_rate = satellites[name]
        rest = getattr(message, f"{fine}_{i:02d}")
        if whole == _NO_RANGE_MS or rest <= _NO_FINE_RANGE_MS[fine]:
            counters["pseudorange_invalid"] += 1
            continue
        pseudorange_m = (whole + part + rest) * _MS_M
        if not PSEUDORANGE_M[0] <= pseudorange_m <= PSEUDORANGE_M[1]:
            counters["pseudorange_implausible"] += 1
            continue
        turn = getattr(message, f"{phase}_{i:02d}")
        carrier = None
        if turn > _NO_FINE_CARRIER_MS[phase]:
            carrier = (whole + part + turn) * carrier_hz * 1e-3
        if carrier is not None and getattr(message, f"DF420_{i:02d}"):
            counters["half_cycle_open"] += 1
            carrier = None
        fine_rate = getattr(message, f"DF404_{i:02d}", _NO_FINE_RATE_M_S)
        rate = None
        if rough_rate != _NO_RATE_M_S and fine_rate > _NO_FINE_RATE_M_S + 1e-9:
            rate = rough_rate + fine_rate
        cno = getattr(message, f"{strength}_{i:02d}") or None
        lock_s = _lock_s(getattr(message, f"{lock}_{i:02d}"), lock)
        found.append(
            RawSignal(
                system, int(name), code, pseudorange_m, rate, carrier, cno, None, None, lock_s
            )
        )
    return found


def _lock_s(indicator: int, name: str) -> float:
    """Least lock time (s) of an indicator: DF402, 0 or 2^(i + 4) ms; DF407, 2^k (i - 32 k) ms with
    k = i / 32 - 1, not below 0 (RTCM 10403.3, tables 3.5-74 and 3.5-75)."""
    if name == "DF402":
        return float(1 << (indicator + 4)) * 1e-3 if indicator else 0.0
    k = max(indicator // 32 - 1, 0)
    return float((indicator - 32 * k) << k) * 1e-3
