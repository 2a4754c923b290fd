"""Decoder of a receiver's raw output into observations and ephemerides: no I/O, no clock.

Every verified frame ends in exactly one of these counters:

    UBX     rawx, rawx_unreadable, time_unset, time_implausible; sfrbx_unreadable, one name per
            subframe; ubx_not_used
    RTCM 3  msm, week_unknown, rtcm_ephemerides, rtcm_ssr, ..._not_used, rtcm_unreadable,
            ssr_unreadable, and the refusals of an ephemeris

The counter of a subframe is `subframes_lnav`, `_cnav`, `_d1`, `_d2`, `_bcnav1`, `_bcnav2` or
`_inav` if it was used, `fnav_not_used` for a message that is not decoded, or the reason of its
refusal (`parity_bad`). See `docs/gnss-raw.md`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from typing import Protocol

from drivers.decoder_options import BUILD_DATE
from drivers.measurements import UtcStamp
from drivers.nmea.mixed_framing import Frame, StreamSplitter
from drivers.raw.bcnav import Bcnav1Decoder, Bcnav2Decoder
from drivers.raw.beidou_words import GEO
from drivers.raw.cnav_group_delay import CnavDecoder
from drivers.raw.d1 import D1Decoder
from drivers.raw.d2 import D2Decoder
from drivers.raw.inav import InavDecoder
from drivers.raw.lnav import PREAMBLE, LnavDecoder
from drivers.raw.messages import (
    Bdgim,
    Correction,
    Ephemeris,
    Klobuchar,
    NavigationMessage,
    RawEvent,
    RawGnssEpoch,
    SignalDelays,
)
from drivers.raw.rtcm import RtcmDecoder
from drivers.raw.subframes import Decoded, RefusedError, Subframe
from drivers.raw.ubx import (
    MAX_PRN,
    OTHER_SYSTEMS,
    RAWX,
    SFRBX,
    SYSTEM_BY_ID,
    Sfrbx,
    parse_rawx,
    parse_sfrbx,
)
from drivers.raw.weeks import FIRST_RAWX_WEEK, LAST_WEEK, WeekReference, leap_seconds, utc_ns


class MessageDecoder(Protocol):
    """Decoder of one satellite's message."""

    def decode(self, subframe: Subframe, weeks: WeekReference) -> Decoded: ...


_DECODERS: dict[str, Callable[[], MessageDecoder]] = {
    "lnav": LnavDecoder,
    "cnav": CnavDecoder,
    "d1": D1Decoder,
    "d2": D2Decoder,
    "bcnav1": Bcnav1Decoder,
    "bcnav2": Bcnav2Decoder,
    "inav": InavDecoder,
}
_BEIDOU_D1, _BEIDOU_D2 = frozenset({0, 2, 4}), frozenset({1, 3, 10})
_BCNAV = {5: "bcnav1", 6: "bcnav1", 7: "bcnav2", 8: "bcnav2"}
_GALILEO_INAV, _GALILEO_FNAV = frozenset({0, 1, 5}), frozenset({3, 4})


class RawDecoder:
    """Decoder: `feed` bytes to get events; `flush` at the end of the file.

    `earliest` resolves a 10-bit GPS week if the stream has no longer one; set it back to read an
    old RTCM log. With `rtcm` off, RTCM 3 frames are counted as `rtcm_not_used`. With it on, the
    first frame raises PermanentDriverError if pyrtcm is not installed.
    """

    def __init__(
        self,
        source: str,
        counters: Counter[str] | None = None,
        *,
        earliest: date = BUILD_DATE,
        rtcm: bool = True,
    ) -> None:
        self.counters: Counter[str] = Counter() if counters is None else counters
        self.leap_seconds: int | None = None
        """GPS time minus UTC, as the receiver last confirmed."""
        self._source = source
        self._splitter = StreamSplitter(self.counters)
        self._t_seen_ns = 0
        self._weeks = WeekReference(earliest)
        self._rtcm = RtcmDecoder(source, self._weeks, self.counters) if rtcm else None
        self._messages: dict[tuple[str, int, int], MessageDecoder] = {}
        self._ionosphere: dict[str, Klobuchar | Bdgim] = {}
        """Last ionosphere by model."""

    def feed(self, data: bytes, t_seen_ns: int) -> list[RawEvent]:
        """Events that `data`, seen at `t_seen_ns`, completes. Sentences are ignored."""
        found: list[RawEvent] = []
        self._t_seen_ns = t_seen_ns
        for item in self._splitter.feed(data):
            if isinstance(item, Frame):
                found += self.decode(item, t_seen_ns)
        return found

    def flush(self) -> list[RawEvent]:
        """End the stream; return what its last bytes still complete."""
        found: list[RawEvent] = []
        for item in self._splitter.finish():
            if isinstance(item, Frame):
                found += self.decode(item, self._t_seen_ns)
        return found + self.flush_epoch()

    @property
    def epoch_open(self) -> bool:
        """True if `flush_epoch` would end an epoch of MSM."""
        return self._rtcm is not None and self._rtcm.epoch_open

    def flush_epoch(self) -> list[RawEvent]:
        """End an open epoch of MSM, of which nothing more will come."""
        return [] if self._rtcm is None else self._rtcm.flush()

    def note_utc(self, utc: int) -> None:
        """Note trusted UTC (POSIX ns) from another source, to date MSM epochs."""
        self._weeks.note_utc(utc, self.leap_seconds)

    def correct(self, frame: bytes, t_seen_ns: int) -> list[RawEvent]:
        """Decode a verified RTCM 3 frame that is not the receiver's."""
        return [] if self._rtcm is None else self._rtcm.decode(frame, t_seen_ns)

    def decode(self, frame: Frame, t_seen_ns: int) -> list[RawEvent]:
        """Result of a frame that `StreamSplitter` verified."""
        if frame.kind == "rtcm":
            if self._rtcm is not None:
                return self._rtcm.decode(frame.raw, t_seen_ns)
            self.counters["rtcm_not_used"] += 1
            return []
        kind, payload = frame.raw[2:4], frame.raw[6:-2]
        if kind == RAWX:
            return self._observe(payload, t_seen_ns)
        if kind == SFRBX:
            subframe = parse_sfrbx(payload)
            if subframe is None:
                self.counters["sfrbx_unreadable"] += 1
                return []
            return self._broadcast(subframe, t_seen_ns)
        self.counters["ubx_not_used"] += 1
        return []

    def _observe(self, payload: bytes, t_seen_ns: int) -> list[RawEvent]:
        epoch = parse_rawx(payload, self.counters)
        if epoch is None:
            self.counters["rawx_unreadable"] += 1
            return []
        if epoch.week < FIRST_RAWX_WEEK:
            self.counters["time_unset"] += 1
            return []
        if epoch.week > LAST_WEEK:
            self.counters["time_implausible"] += 1
            return []
        self.counters["rawx"] += 1
        self.counters["epochs_raw"] += 1
        self.counters["clock_reset"] += epoch.clock_reset
        self.leap_seconds = leap = epoch.leap_seconds
        if leap is None:
            self.counters["leap_seconds_assumed"] += 1
            leap = leap_seconds(epoch.week, epoch.tow_s)
        elif self._rtcm is not None:
            self._rtcm.leap_seconds = leap
        self._weeks.note(epoch.week, epoch.tow_s)
        stamp = UtcStamp(utc_ns(epoch.week, epoch.tow_s, leap))
        return [
            RawGnssEpoch(
                self._source,
                t_seen_ns,
                stamp,
                epoch.week,
                epoch.tow_s,
                epoch.signals,
                epoch.clock_reset,
            )
        ]

    def _broadcast(self, sfrbx: Sfrbx, t_seen_ns: int) -> list[RawEvent]:
        message = message_of(sfrbx)
        system = SYSTEM_BY_ID.get(sfrbx.gnss_id)
        if system is None or message not in _DECODERS:
            self.counters[message] += 1
            return []
        if not 1 <= sfrbx.prn <= MAX_PRN[system]:
            self.counters["satellite_unknown"] += 1
            return []
        key = (message, sfrbx.prn, sfrbx.signal_id)
        decoder = self._messages.get(key)
        if decoder is None:
            decoder = self._messages[key] = _DECODERS[message]()
        subframe = Subframe(
            self._source, t_seen_ns, system, sfrbx.prn, sfrbx.signal_id, sfrbx.words
        )
        try:
            decoded = decoder.decode(subframe, self._weeks)
        except RefusedError as refused:
            self.counters[str(refused)] += 1
            return []
        self.counters[f"subframes_{message}"] += 1
        return [event for event in decoded if self._is_news(event)]

    def _is_news(self, event: NavigationMessage) -> bool:
        """True for every complete ephemeris, since its health and age count, and for a new
        ionosphere."""
        if isinstance(event, Ephemeris):
            self.counters["ephemerides"] += 1
            return True
        if isinstance(event, SignalDelays):
            self.counters["signal_delays"] += 1
            return True
        assert not isinstance(event, Correction)  # not of a subframe
        model = "bdgim" if isinstance(event, Bdgim) else event.system
        last = self._ionosphere.get(model)
        if last is not None and replace(last, t_seen_ns=event.t_seen_ns) == event:
            return False
        self._ionosphere[model] = event
        self.counters["ionospheres"] += 1
        return True


def message_of(sfrbx: Sfrbx) -> str:
    """Message type in a SFRBX: the key of its decoder, or the counter of one that is not decoded.

    Receivers before generation 9 leave sigId 0; then satellite or words decide.
    """
    signal = sfrbx.signal_id
    if sfrbx.gnss_id == 0:
        # CNAV starts with its preamble in the top byte, LNAV two bits later.
        cnav = signal != 0 or (bool(sfrbx.words) and sfrbx.words[0] >> 24 == PREAMBLE)
        return "cnav" if cnav else "lnav"
    if sfrbx.gnss_id == 2:
        if signal in _GALILEO_INAV:
            return "inav"
        return "fnav_not_used" if signal in _GALILEO_FNAV else "galileo_cnav_not_used"
    if sfrbx.gnss_id == 3:
        if signal in _BEIDOU_D2 or (signal in _BEIDOU_D1 and sfrbx.prn in GEO):
            return "d2"
        return "d1" if signal in _BEIDOU_D1 else _BCNAV.get(signal, "bcnav_not_used")
    return f"{OTHER_SYSTEMS.get(sfrbx.gnss_id, 'unknown_system')}_not_used"
