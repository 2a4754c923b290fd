"""Driver `nmea`: a GNSS receiver with NMEA 0183 on a serial line, see `docs/gnss-nmea.md`."""

from __future__ import annotations

from typing import ClassVar

from drivers.base import Emit, Now, monotonic_ns
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from drivers.nmea.reasons import REFUSALS
from drivers.receiver import ReceiverDriver, ReceiverOptions

__all__ = ["REFUSALS", "NmeaDecoder", "NmeaDecoding", "NmeaDriver", "NmeaOptions"]


class NmeaOptions(ReceiverOptions, NmeaDecoding):
    """Options of a `driver = "nmea"` source."""


class NmeaDriver(ReceiverDriver):
    """Driver that reads a line and hands over fixes, headings and times; `status` has the reason if
    it cannot."""

    Options: ClassVar[type[NmeaOptions]] = NmeaOptions

    def __init__(
        self, name: str, options: NmeaOptions, emit: Emit, now_ns: Now = monotonic_ns
    ) -> None:
        self._options = options
        super().__init__(name, options, emit, now_ns)

    def _make_decoder(self) -> NmeaDecoder:
        self._nmea = NmeaDecoder(self.name, self._options, self.counters)
        return self._nmea

    @property
    def cause(self) -> str:
        """Reason for the absence of a fix, as a sentence; "" if unknown."""
        return self._nmea.cause if self.counters["bytes_in"] else ""

    def _useless_detail(self) -> str:
        return self.cause

    def _unintelligible_detail(self) -> str:
        if self._since_alive("ubx_frames") or self._since_alive("rtcm_frames"):
            return (
                "UBX or RTCM 3 frames arrive, but no NMEA: switch on NMEA output on this port, or "
                'have UBX read: driver = "ubx"'
            )
        unknown = f"bytes arrive, but no NMEA sentence verifies{self._where_to_look()}"
        return unknown if self.counters["sentences"] else self.cause or unknown
