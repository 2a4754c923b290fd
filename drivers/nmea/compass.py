"""Driver `compass`: headings of a compass that speaks NMEA 0183, see `docs/compass.md`.

    HDG   sensor heading, deviation, variation     magnetic heading = sensor heading + deviation HDM
    magnetic heading HDT   true heading, by the compass's own declination, or of a gyrocompass

A device may send all three of one reading: the first received kind in this order is used, the
others are counted as `other_sentence`. The variation of HDG is ignored; the declination is computed
for the vehicle's position. Source: NMEA 0183 4.11, section 6.3.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import ClassVar

from pydantic import Field, NonNegativeFloat

from drivers.base import DriverOptions, Emit, Now, monotonic_ns
from drivers.measurements import ArrivalStamp, Heading, MagneticHeading
from drivers.nmea.mixed_framing import NmeaSplitter, Sentence
from drivers.quantization import NEAREST_SD
from drivers.receiver import ReceiverDriver, ReceiverOptions

FORMATTERS = ("HDG", "HDM", "HDT")


class CompassDecoding(DriverOptions):
    """Options of the decoder."""

    heading_offset_deg: float = Field(0.0, ge=-360.0, le=360.0)
    """Added to every heading: from the compass's lubber line to the forward axis, clockwise."""
    latency_s: NonNegativeFloat = 0.1
    """Latency of a heading: half of a damping of 0.2 s."""


class CompassOptions(ReceiverOptions, CompassDecoding):
    """Options of a `driver = "compass"` source."""

    baud: int = Field(4800, ge=1200, le=4_000_000)
    """4800 is NMEA 0183's own."""


class CompassDecoder:
    """Decoder of bytes into headings; no I/O, no clock.

    Counts, beside those of `NmeaSplitter`: `headings`; refused `unused_sentence`,
    `other_sentence`, `no_heading` (an empty field), `bad_field`.
    """

    gga = b""
    epoch_open = False
    cautions: ClassVar[dict[str, str]] = {}

    def __init__(self, source: str, decoding: CompassDecoding, counters: Counter[str]) -> None:
        self.counters = counters
        self._source = source
        self._decoding = decoding
        self._splitter = NmeaSplitter(counters)
        self._best = len(FORMATTERS)

    def feed(self, data: bytes, t_seen_ns: int) -> list[Heading | MagneticHeading]:
        """Headings that `data`, seen at `t_seen_ns`, completes."""
        found = [self._heading(s, t_seen_ns) for s in self._splitter.feed(data)]
        return [heading for heading in found if heading is not None]

    def silence(self) -> list[Heading | MagneticHeading]:
        """Ignore silence: each sentence is complete."""
        return []

    def flush(self) -> list[Heading | MagneticHeading]:
        """End of the line: drop incomplete data."""
        self._splitter.finish()
        return []

    def _heading(self, sentence: Sentence, t_seen_ns: int) -> Heading | MagneticHeading | None:
        if sentence.formatter not in FORMATTERS:
            self.counters["unused_sentence"] += 1
            return None
        rank = FORMATTERS.index(sentence.formatter)
        try:
            heading_deg, step_deg = _printed(sentence)
        except ValueError:
            self.counters["bad_field"] += 1
            return None
        if heading_deg is None:
            self.counters["no_heading"] += 1
            return None
        if rank > self._best:
            self.counters["other_sentence"] += 1
            return None
        self._best = rank
        self.counters["headings"] += 1
        o = self._decoding
        yaw = math.remainder(math.radians(heading_deg + o.heading_offset_deg), math.tau)
        rounding = math.radians(step_deg) * NEAREST_SD
        stamp = ArrivalStamp(o.latency_s)
        if sentence.formatter == "HDT":
            return Heading(self._source, t_seen_ns, stamp, yaw, None, rounding)
        return MagneticHeading(self._source, t_seen_ns, stamp, yaw, rounding)


def _printed(sentence: Sentence) -> tuple[float | None, float]:
    """Heading (deg; None for an empty field) and the step of its last digit.

    ValueError where a field cannot be true."""
    fields = [*sentence.fields, "", "", ""]
    text = fields[0]
    if not text:
        return None, 0.0
    heading_deg = _number(text, 360.0)
    if sentence.formatter == "HDG" and fields[1]:
        heading_deg += _number(fields[1], 180.0) * {"E": 1.0, "W": -1.0}.get(fields[2], math.nan)
        if math.isnan(heading_deg):
            raise ValueError("a deviation without E or W")
    return heading_deg, 10.0 ** -len(text.partition(".")[2])


def _number(text: str, most: float) -> float:
    """Number of digits and a decimal point only."""
    if not text.replace(".", "", 1).isdecimal() or not text.isascii():
        raise ValueError(text)
    value = float(text)
    if value > most:
        raise ValueError(text)
    return value


class CompassDriver(ReceiverDriver):
    """Driver that reads a line and hands over headings."""

    Options: ClassVar[type[CompassOptions]] = CompassOptions

    def __init__(
        self, name: str, options: CompassOptions, emit: Emit, now_ns: Now = monotonic_ns
    ) -> None:
        self._options = options
        super().__init__(name, options, emit, now_ns)

    def _make_decoder(self) -> CompassDecoder:
        return CompassDecoder(self.name, self._options, self.counters)

    def _useless_detail(self) -> str:
        if self.counters["no_heading"]:
            return "the compass sends sentences without a heading"
        return "sentences arrive, but neither HDG nor HDM nor HDT"

    def _unintelligible_detail(self) -> str:
        return f"bytes arrive, but no NMEA sentence verifies{self._where_to_look()}"
