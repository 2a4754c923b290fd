"""Driver `gnss`: a receiver's line with raw observations, NMEA and UBX, see `docs/gnss-raw.md`."""

from __future__ import annotations

from collections import Counter
from typing import ClassVar

from drivers.base import Emit, Now, monotonic_ns
from drivers.measurements import Measurement, PositionFix, TimeReport, UtcStamp
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from drivers.nmea.driver import REFUSALS as NMEA_REFUSALS
from drivers.nmea.driver import NmeaOptions
from drivers.nmea.mixed_framing import Item, Sentence, StreamSplitter
from drivers.nmea.reasons import nothing_verified
from drivers.nmea.time import TimeTrust
from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import Ephemeris, RawEvent, RawGnssEpoch
from drivers.raw.rtcm import SSR, load_pyrtcm, message_number
from drivers.receiver import ReceiverDriver
from drivers.solution import REFUSALS
from drivers.ubx.decoder import UbxDecoder
from drivers.ubx.messages import CLASS_NAV

Found = Measurement | RawEvent

NMEA_TIME_NS = 5_000_000_000
"""Time without RMC or ZDA after which another message gives the time: five epochs at 1 Hz. That of
RXM-RAWX is off by up to some milliseconds, with the receiver's clock."""
UBX_FIX_NS = 5_000_000_000
"""Time without UBX-NAV after which fixes of NMEA are used.

Those of UBX-NAV are the same fixes with a velocity down and sigmas of their own."""
SAME_FIX_NS = 20_000_000
"""Tolerance of equal instants: NMEA prints hundredths of a second, UBX gives nanoseconds; fixes are
at least 50 ms apart."""


class GnssOptions(NmeaOptions):
    """Options of a `driver = "gnss"` source: those of `nmea`, and the parts of the stream to
    use."""

    use_nmea_fix: bool = True
    """Hand over the receiver's own fixes too, of NMEA or UBX-NAV. They are made of the same
    pseudoranges: fuse one of the two. Headings and times are handed over in any case."""
    use_raw: bool = True
    """Hand over observations, ephemerides and ionosphere models."""
    rtcm: bool = True
    """Decode RTCM 3, which needs the package pyrtcm (extra `raw`)."""


ALIVE_BY = ("sentences", "ubx_frames", "rtcm_frames")


class GnssDecoder:
    """Decoders of one stream: for sentences, for UBX-NAV, and for all other frames.

    Counts `nmea_fix_superseded`: fixes that UBX-NAV has, too.
    """

    def __init__(
        self,
        source: str,
        decoding: NmeaDecoding,
        counters: Counter[str] | None = None,
        *,
        use_nmea_fix: bool = True,
        use_raw: bool = True,
        rtcm: bool = True,
    ) -> None:
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._source = source
        self._use_nmea_fix = use_nmea_fix
        self._splitter = StreamSplitter(self.counters)
        self._nmea = NmeaDecoder(source, decoding, self.counters)
        self._ubx = UbxDecoder(source, decoding, self.counters)
        self._ubx_fix_ns: int | None = None
        self._nmea_fix: UtcStamp | None = None
        self._raw = (
            RawDecoder(source, self.counters, earliest=decoding.earliest_date, rtcm=rtcm)
            if use_raw
            else None
        )
        self._trust = TimeTrust()
        self._nmea_utc_ns: int | None = None
        """Last UTC of RMC or ZDA, else of the first epoch of RXM-RAWX."""
        self._delays: set[int] = set()
        """BeiDou satellites with received B-CNAV."""
        self.undelayed = 0
        """BeiDou satellites of the last epoch that are tracked on B1C or B2a alone without a known
        group delay; 0 if any is usable."""
        self._t_seen_ns = 0

    @property
    def refusal(self) -> str:
        """Refusal of the last NMEA epoch, or else of UBX-NAV, by counter name."""
        return self._nmea.refusal or self._ubx.refusal

    @property
    def cautions(self) -> dict[str, str]:
        """Cautions by counter: limits on the quality of fixes, and the actions taken."""
        return self._ubx.cautions | self._nmea.cautions

    @property
    def unread(self) -> str:
        """Sentence on unreadable input; "" if unknown."""
        if not any(self.counters[name] for name in ALIVE_BY):
            return nothing_verified(self.counters, self._splitter.unread)
        received = self._nmea.received
        return self._nmea.cause if received.talkers and not received.used else ""

    @property
    def gga(self) -> bytes:
        """Last GGA with a position, or else the last fix of UBX-NAV as one; empty before."""
        return self._nmea.gga or self._ubx.gga

    @property
    def epoch_open(self) -> bool:
        """True if `silence` would close an epoch."""
        raw = self._raw is not None and self._raw.epoch_open
        return self._nmea.epoch_open or self._ubx.epoch_open or raw

    def feed(self, data: bytes, t_seen_ns: int) -> list[Found]:
        """Measurements and messages that `data`, seen at `t_seen_ns`, completes."""
        self._t_seen_ns = t_seen_ns
        found: list[Found] = []
        for item in self._splitter.feed(data):
            self._take(item, found)
        return found

    def correct(self, frame: bytes, t_seen_ns: int) -> list[RawEvent]:
        """Corrections in a frame of a service beside the receiver."""
        return [] if self._raw is None else self._raw.correct(frame, t_seen_ns)

    def silence(self) -> list[Found]:
        """Handle a silence longer than any receiver's pause within an epoch (50 ms)."""
        found: list[Found] = []
        self._take_nmea(self._nmea.silence(), found)
        self._take_ubx(self._ubx.silence(), found)
        if self._raw is not None:
            self._take_raw(self._raw.flush_epoch(), found)
        return found

    def flush(self) -> list[Found]:
        """End the stream; return what its last bytes still complete."""
        found: list[Found] = []
        for item in self._splitter.finish():
            self._take(item, found)
        self._take_nmea(self._nmea.flush(), found)
        self._take_ubx(self._ubx.flush(), found)
        if self._raw is not None:
            self._take_raw(self._raw.flush_epoch(), found)
        return found

    def _take(self, item: Item, found: list[Found]) -> None:
        if isinstance(item, Sentence):
            self._take_nmea(self._nmea.take(item, self._t_seen_ns), found)
        elif item.kind == "ubx" and item.raw[2] == CLASS_NAV:
            self._take_ubx(self._ubx.decode(item.raw, self._t_seen_ns), found)
        elif self._raw is not None:
            self._take_raw(self._raw.decode(item, self._t_seen_ns), found)

    def _take_nmea(self, measurements: list[Measurement], found: list[Found]) -> None:
        for measurement in measurements:
            if isinstance(measurement, TimeReport):
                self._nmea_utc_ns = measurement.utc_ns
                if measurement.trusted and self._raw is not None:
                    self._raw.note_utc(measurement.utc_ns)
            if isinstance(measurement, PositionFix) and not self._own_fix(measurement):
                continue
            found.append(measurement)

    def _own_fix(self, fix: PositionFix) -> bool:
        """True if a fix by NMEA is to be handed over."""
        if not self._use_nmea_fix:
            return False
        if self._ubx_fix_ns is not None and self._t_seen_ns - self._ubx_fix_ns < UBX_FIX_NS:
            self.counters["nmea_fix_superseded"] += 1
            return False
        self._nmea_fix = fix.stamp if isinstance(fix.stamp, UtcStamp) else None
        return True

    def _take_ubx(self, measurements: list[Measurement], found: list[Found]) -> None:
        for measurement in measurements:
            if isinstance(measurement, TimeReport):
                if measurement.trusted and self._raw is not None:
                    self._raw.note_utc(measurement.utc_ns)
                if not self._known_from_nmea(measurement.utc_ns):
                    found.append(measurement)
                continue
            if isinstance(measurement, PositionFix):
                if not self._use_nmea_fix:
                    continue
                self._ubx_fix_ns = self._t_seen_ns
                if self._already(measurement):
                    continue
            found.append(measurement)

    def _already(self, fix: PositionFix) -> bool:
        """True if NMEA gave this fix already, at the first epoch when its sentences come first."""
        last, self._nmea_fix = self._nmea_fix, None
        if last is None or not isinstance(fix.stamp, UtcStamp):
            return False
        return abs(fix.stamp.utc_ns - last.utc_ns) < SAME_FIX_NS

    def _take_raw(self, events: list[RawEvent], found: list[Found]) -> None:
        for event in events:
            if isinstance(event, RawGnssEpoch):
                self._report_time(event, found)
                self._look_for_delays(event)
            elif isinstance(event, Ephemeris) and event.message.startswith("bcnav"):
                self._delays.add(event.prn)
            found.append(event)

    def _look_for_delays(self, epoch: RawGnssEpoch) -> None:
        beidou = [(prn, signal) for system, prn, signal in epoch.packed.keys if system == "C"]
        served = any(signal[0] not in "15" or prn in self._delays for prn, signal in beidou)
        self.undelayed = 0 if served else len({prn for prn, _ in beidou})

    def _report_time(self, epoch: RawGnssEpoch, found: list[Found]) -> None:
        """Report UTC of RXM-RAWX, if the receiver knows the leap seconds and sends no RMC or
        ZDA."""
        if self._raw is None or self._raw.leap_seconds is None:
            return
        if not isinstance(epoch.stamp, UtcStamp):
            return
        utc_ns = epoch.stamp.utc_ns
        if self._known_from_nmea(utc_ns):
            return
        trusted = self._trust.report(utc_ns, epoch.t_seen_ns, valid=True)
        if trusted is not None:
            found.append(TimeReport(self._source, epoch.t_seen_ns, utc_ns, trusted))

    def _known_from_nmea(self, utc_ns: int) -> bool:
        """True if RMC or ZDA gave the time recently, or still may."""
        if self._nmea_utc_ns is None:
            self._nmea_utc_ns = utc_ns
        return abs(utc_ns - self._nmea_utc_ns) < NMEA_TIME_NS


class GnssDriver(ReceiverDriver):
    """Driver for raw observations, with the output of the NMEA driver.

    PermanentDriverError if RTCM 3 is to be decoded and pyrtcm is not installed.
    """

    Options: ClassVar[type[GnssOptions]] = GnssOptions
    alive_by = ALIVE_BY

    def __init__(
        self, name: str, options: GnssOptions, emit: Emit, now_ns: Now = monotonic_ns
    ) -> None:
        if options.use_raw and options.rtcm:
            load_pyrtcm()
        self._options = options
        super().__init__(name, options, emit, now_ns)
        self.inputs.on("correction", self._on_correction)

    def _make_decoder(self) -> GnssDecoder:
        options = self._options
        self._gnss = GnssDecoder(
            self.name,
            options,
            self.counters,
            use_nmea_fix=options.use_nmea_fix,
            use_raw=options.use_raw,
            rtcm=options.rtcm,
        )
        return self._gnss

    def _pass_on(self, frame: bytes) -> bool:
        if self._options.use_raw and self._options.rtcm and message_number(frame) in SSR:
            self.inputs.take("correction", frame)
        return super()._pass_on(frame)

    def _on_correction(self, frame: bytes, t_seen_ns: int) -> None:
        for correction in self._gnss.correct(frame, t_seen_ns):
            self._emit(correction)

    def _running_detail(self) -> str:
        useless = super()._running_detail()
        counters = self.counters
        if useless or not counters["epochs_raw"]:
            return useless
        if not (counters["ephemerides"] or counters["rtcm_ephemerides"]):
            return "no ephemeris yet: are UBX-RXM-SFRBX, or RTCM 1019, 1042, 1046, switched on?"
        if self._gnss.undelayed:
            return (
                f"no group delay of {self._gnss.undelayed} BeiDou satellites on B1C or B2a yet "
                "(no_group_delay): B-CNAV has it, so switch on UBX-RXM-SFRBX, or B1I or B3I"
            )
        return ""

    def _useless_detail(self) -> str:
        counters = self.counters
        if self._options.use_raw:
            if counters["week_unknown"]:
                return "RTCM epochs without a week: switch on RTCM 1019 or 1042, or NMEA RMC"
            if counters["time_unset"]:
                return "the receiver has observations, but no time yet"
            if not counters["epochs_raw"] and not self._gnss.refusal:
                if unread := self._gnss.unread:
                    return unread
                return "no observations arrive: switch on UBX-RXM-RAWX, or RTCM MSM4 or MSM7"
        if self._options.use_nmea_fix and counters["epochs"]:
            words = {**REFUSALS, **NMEA_REFUSALS}
            return words.get(self._gnss.refusal, "epochs arrive, but none has a position")
        return "neither observations nor epochs of NMEA arrive"

    def _unintelligible_detail(self) -> str:
        where = self._where_to_look()
        return self.cause or f"bytes arrive, but neither NMEA, UBX nor RTCM 3 verifies{where}"

    @property
    def cause(self) -> str:
        """Reason why nothing on the line verifies, as a sentence; "" if unknown."""
        alive = any(self.counters[name] for name in self.alive_by)
        return "" if alive else self._gnss.unread
