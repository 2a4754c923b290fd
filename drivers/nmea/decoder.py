"""Decoder of a GNSS receiver's bytes into measurements: groups, dates and judges epochs. No I/O, no
clock.

An epoch ends when the time of day changes, when a sentence repeats, with its last sentence, or on
`silence`. The last sentence is configured or learned, and so are the receiver's pauses inside an
epoch (drivers.nmea.sentence_order).
"""

from __future__ import annotations

from collections import Counter
from typing import Literal

from drivers.decoder_options import SolutionDecoding
from drivers.measurements import (
    Measurement,
)
from drivers.nmea.epoch_assembly import (
    FORMATTERS,
    MAX_CYCLE,
    TALKERS,
    Epoch,
    time_of_day_ns,
)
from drivers.nmea.epoch_to_measurement import EpochConverter
from drivers.nmea.fields import BadFieldError
from drivers.nmea.mixed_framing import NmeaSplitter, Sentence, is_rdss_sentence
from drivers.nmea.reasons import (
    ATTITUDES,
    FULLER,
    OWN_SENTENCES,
    POSITIONS,
    Received,
    cautions,
    count_name,
    no_fix,
    nothing_verified,
    proprietary_name,
)
from drivers.nmea.sentence_order import SentenceOrder
from drivers.nmea.time import (
    same_printed_time,
    time_step_ns,
)

_TIMELESS = frozenset({"GSA", "VTG"})
Formatter = Literal["GGA", "GNS", "RMC", "GLL", "VTG", "GSA", "GST", "ZDA", "HDT", "THS"]


class NmeaDecoding(SolutionDecoding):
    """Options of the decoder."""

    last_sentence: Formatter | None = None
    """Sentence that ends an epoch (one that is sent once an epoch); learned by default."""


class NmeaDecoder:
    """Decoder: `feed` bytes to get measurements; `flush` at the end of the file.

    Counts, beside those of `NmeaSplitter`, `Calendar` and `EpochOrder`: `epochs`, `fixes`;
    refused sentences `other_talker`, `unused_sentence`, `rdss_sentence`, `bad_field`,
    `repeated_sentence`; noted `late_sentence`; refused epochs `no_fix`,
    `dead_reckoning_refused`, `manual_refused`, `simulator_refused`, `unknown_quality`,
    `datum_refused`, `height_implausible`, `speed_implausible`, `sigma_too_large`; within one
    `heading_mode_refused`, `height_not_measured`, `height_above_sea`, `rmc_alone`, `gll_alone`,
    `gga_awaited`, `integrated`, `unknown_status`, `sigma_too_small`, `untimed_epoch`, `bad_date`,
    `course_missing`, `speed_held_at_zero`, `two_receivers`.
    """

    def __init__(
        self,
        source: str,
        decoding: NmeaDecoding | None = None,
        counters: Counter[str] | None = None,
    ) -> None:
        self.counters: Counter[str] = Counter() if counters is None else counters
        self.gga = b""
        """Last GGA with a position, without its line end; empty before one."""
        self.received = Received()
        self._decoding = decoding or NmeaDecoding()
        self._splitter = NmeaSplitter(self.counters)
        self._judge = EpochConverter(source, self._decoding, self.counters, self.received)
        self._epoch: Epoch | None = None
        self._t_seen_ns = 0
        self._cycle = SentenceOrder()
        self._closed: Epoch | None = None
        """The epoch before."""
        self._closed_by = ""
        """Closing event: `last` sentence, `silence`, or what came then."""
        self._raw_before = b""
        """The sentence before."""
        self._doubling = False
        """True if that was said twice."""

    @property
    def refusal(self) -> str:
        """Reason why the last epoch was refused, by counter name; empty when it was not."""
        return self._judge.refusal

    @property
    def cautions(self) -> dict[str, str]:
        """Cautions by counter: limits on the quality of fixes, and the actions taken."""
        return cautions(self.counters, self.received, self._decoding.earliest_date)

    @property
    def cause(self) -> str:
        """Reason for the absence of a fix, as a sentence; "" if unknown."""
        if not self.counters["sentences"]:
            return nothing_verified(self.counters, self._splitter.unread)
        return no_fix(self.counters, self.received, self.refusal)

    @property
    def epoch_open(self) -> bool:
        """True if `silence` would close an epoch."""
        return self._epoch is not None

    def feed(self, data: bytes, t_seen_ns: int) -> list[Measurement]:
        """Measurements that `data`, seen at `t_seen_ns`, completes."""
        found: list[Measurement] = []
        self._t_seen_ns = t_seen_ns
        for sentence in self._splitter.feed(data):
            self._take(sentence, t_seen_ns, found)
        return found

    def take(self, sentence: Sentence, t_seen_ns: int) -> list[Measurement]:
        """Feed a sentence that is already verified."""
        found: list[Measurement] = []
        self._t_seen_ns = t_seen_ns
        self._take(sentence, t_seen_ns, found)
        return found

    def silence(self) -> list[Measurement]:
        """Handle a silence longer than a receiver's pauses within an epoch (50 ms)."""
        found: list[Measurement] = []
        epoch = self._epoch
        if epoch is None or self._cycle.pauses(epoch.cycle) or _is_tail(epoch):
            return found
        self._close(found, learn=True, by="silence")
        return found

    def flush(self) -> list[Measurement]:
        """End the stream; return what its last bytes still complete."""
        found: list[Measurement] = []
        for sentence in self._splitter.finish():
            self._take(sentence, self._t_seen_ns, found)
        self._close(found, learn=False)
        return found

    # ----------------------------------------------------------------- sentences to epochs

    def _take(self, sentence: Sentence, t_seen_ns: int, found: list[Measurement]) -> None:
        if is_rdss_sentence(sentence):
            self.counters["rdss_sentence"] += 1
            return
        if sentence.formatter == "DTM" and sentence.talker in TALKERS:
            self.received.datum = sentence.fields[0] if sentence.fields else ""
        if sentence.formatter not in FORMATTERS:
            self.counters["unused_sentence"] += 1
            own = sentence.talker == "P" or sentence.address in (*OWN_SENTENCES, *ATTITUDES)
            name = (
                proprietary_name(sentence.address, sentence.fields) if own else sentence.formatter
            )
            count_name(self.received.unused, name)
            if sentence.address[2:] in POSITIONS:  # talkers with P, as Quectel's PQ
                count_name(self.received.talkers, sentence.address[:2])
            return
        if sentence.talker not in TALKERS:
            self.counters["other_talker"] += 1
            if sentence.formatter in POSITIONS:
                count_name(self.received.talkers, sentence.talker)
            else:
                count_name(self.received.unused, sentence.formatter)
            return
        try:
            self._group(sentence, t_seen_ns, found)
        except BadFieldError:
            self.counters["bad_field"] += 1
            return
        count_name(self.received.used, sentence.formatter)
        if sentence.formatter == "GGA" and sentence.fields[5:6] not in ((), ("",), ("0",)):
            self.gga = sentence.raw

    def _group(self, sentence: Sentence, t_seen_ns: int, found: list[Measurement]) -> None:
        formatter, time_ns = sentence.formatter, time_of_day_ns(sentence)
        if self._doubled(sentence, time_ns):
            self.counters["repeated_sentence"] += 1
            return
        epoch = self._epoch
        if formatter == "GLL" and time_ns is not None and self._given_already(time_ns, sentence):
            self.counters["unused_sentence"] += 1
            return
        if epoch is not None and time_ns is not None and self._belongs_before(epoch, t_seen_ns):
            epoch = self._epoch = None
            self._delayed()
        if epoch is not None:
            again = formatter in epoch.cycle and formatter != "GSA"
            if (
                (time_ns is not None and not self._of_epoch(epoch, time_ns, sentence))
                or (again and sentence.address in epoch.addresses)
                or len(epoch.cycle) >= MAX_CYCLE
            ):
                self._close(found, learn=True)
            elif again:  # the same fix by another talker
                self.counters["repeated_sentence"] += 1
                self.counters["two_receivers"] += _is_elsewhere(sentence, epoch)
                return
        elif time_ns is None and self._closed_by == "last" and formatter not in self._cycle.last:
            self._delayed()
            return
        epoch = self._epoch or Epoch()
        epoch.take(sentence, t_seen_ns)
        self._epoch = epoch
        if epoch.time_of_day_ns is None and time_ns is not None:
            epoch.time_of_day_ns, epoch.time_step_ns = time_ns, time_step_ns(sentence)
            closed = self._closed
            if (
                closed is not None
                and closed.time_of_day_ns is not None
                and formatter not in self._cycle.last
                and self._of_epoch(closed, time_ns, sentence)
            ):
                self._delayed()
        elif time_ns is not None and time_step_ns(sentence) < epoch.time_step_ns:
            epoch.time_of_day_ns, epoch.time_step_ns = time_ns, time_step_ns(sentence)
        epoch.whole = self._cycle.whole(epoch.cycle, epoch.phase_ns)
        last = self._decoding.last_sentence
        if formatter == last or (last is None and epoch.whole):
            self._close(found, learn=False, by="last")

    def _doubled(self, sentence: Sentence, time_ns: int | None) -> bool:
        """True if each sentence, or each burst, comes twice, as in a log of two ports of one
        receiver. A third time shows a receiver that repeats itself."""
        raw, before = sentence.raw, self._raw_before
        self._raw_before = raw
        epoch = self._epoch
        if epoch is None and self._closed_by == "last" and raw == before:
            epoch = self._closed
        if epoch is None or raw not in epoch.raws or epoch.time_of_day_ns is None:
            self._doubling = False
        else:
            self._doubling = time_ns is not None or self._doubling or raw == before
            if self._doubling:
                epoch.raws.discard(raw)
        return self._doubling

    def _of_epoch(self, epoch: Epoch, time_ns: int, sentence: Sentence) -> bool:
        """True if a sentence with a time belongs to an epoch by that time."""
        if epoch.time_of_day_ns is None:
            return True
        step_ns = time_step_ns(sentence)
        return same_printed_time(epoch.time_of_day_ns, epoch.time_step_ns, time_ns, step_ns)

    def _given_already(self, time_ns: int, sentence: Sentence) -> bool:
        """True if a better sentence gave this instant's position. Many bursts end with GLL, behind
        all GSV, and the epoch need not wait for it."""
        epoch = self._epoch if self._epoch is not None else self._closed
        if epoch is None or epoch.time_of_day_ns is None or FULLER.isdisjoint(epoch.cycle):
            return False
        return self._of_epoch(epoch, time_ns, sentence)

    def _belongs_before(self, epoch: Epoch, t_seen_ns: int) -> bool:
        """True if a sentence without time is closer to the epoch that a silence has closed than to
        the new one."""
        closed = self._closed
        if closed is None or self._closed_by != "silence" or not _is_tail(epoch):
            return False
        return epoch.t_seen_ns - closed.t_seen_ns < t_seen_ns - epoch.t_seen_ns

    def _delayed(self) -> None:
        """Process a sentence of an epoch already closed, and learn its end again."""
        self.counters["late_sentence"] += 1
        self._judge.in_two_parts()
        if self._closed_by == "silence":
            self._cycle.paused()
        else:
            self._cycle.too_short()

    def _close(self, found: list[Measurement], *, learn: bool, by: str = "") -> None:
        epoch, self._epoch = self._epoch, None
        if epoch is None:
            return
        self._cycle.ended(epoch.cycle, epoch.phase_ns, learn=learn)
        self._closed, self._closed_by = epoch, by
        self._judge.epoch(epoch, found)


def _is_elsewhere(sentence: Sentence, epoch: Epoch) -> bool:
    """True if another talker's GGA of this epoch has another place."""
    place = ",".join(sentence.fields[1:5]).encode()
    others = [raw for raw in epoch.raws if raw[3:6] == b"GGA"]
    return sentence.formatter == "GGA" and bool(others) and not any(place in r for r in others)


def _is_tail(epoch: Epoch) -> bool:
    """True if it contains only sentences without time of another epoch."""
    return epoch.time_of_day_ns is None and _TIMELESS.issuperset(epoch.cycle)
