"""A GNSS receiver that speaks NMEA 0183 on a serial line: see `docs/gnss-nmea.md`."""

from __future__ import annotations

from typing import ClassVar

from drivers.base import Emit, Now, monotonic_ns
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from drivers.receiver import ReceiverDriver, ReceiverOptions

__all__ = ["NmeaDecoder", "NmeaDecoding", "NmeaDriver", "NmeaOptions"]

REFUSALS = {
    "no_fix": "the receiver has no fix",
    "dead_reckoning_refused": "only the receiver's own dead reckoning, which is not fused",
    "manual_refused": "the receiver repeats a position that was put in by hand",
    "simulator_refused": "the receiver simulates: allow_simulator would accept it",
    "duplicate_epoch": "the receiver repeats an epoch or goes back in time",
    "unknown_quality": "the receiver states a GGA quality that NMEA does not know",
    "height_implausible": "the receiver states a height at which no vehicle can be",
    "speed_implausible": "the receiver states a speed that no vehicle has",
    "sigma_too_large": "the receiver states that it does not know where it is (GST)",
}


class NmeaOptions(ReceiverOptions, NmeaDecoding):
    """Options of a `driver = "nmea"` source."""


class NmeaDriver(ReceiverDriver):
    """Reads the line, hands over fixes, headings and times; says in `status` what is wrong."""

    Options: ClassVar[type[NmeaOptions]] = NmeaOptions

    def __init__(
        self, name: str, options: NmeaOptions, emit: Emit, now_ns: Now = monotonic_ns
    ) -> None:
        self._options = options
        super().__init__(name, options, emit, now_ns)

    def _make_decoder(self) -> NmeaDecoder:
        self._nmea = NmeaDecoder(self.name, self._options, self.counters)
        return self._nmea

    def _useless_detail(self) -> str:
        if not self.counters["epochs"]:
            return "sentences arrive, but none that counts: switch on GGA and RMC"
        return REFUSALS.get(self._nmea.refusal, "epochs arrive, but none has a position")

    def _unintelligible_detail(self) -> str:
        if self._since_alive("ubx_frames") or self._since_alive("rtcm_frames"):
            return "UBX or RTCM 3 frames arrive, but no NMEA: switch on NMEA output on this port"
        return f"bytes arrive, but no NMEA sentence verifies{self._where_to_look()}"
