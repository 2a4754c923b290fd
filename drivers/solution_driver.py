"""Common part of the drivers `ubx`, `bestpos` and `sbf`, which read a receiver's own solutions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, ClassVar

from drivers.base import Emit, Now, monotonic_ns
from drivers.decoder_options import SolutionDecoding
from drivers.nmea.mixed_framing import StreamSplitter
from drivers.nmea.reasons import MANY
from drivers.nmea.unsupported_protocols import protocol_sentence
from drivers.receiver import ReceiverDriver, ReceiverOptions
from drivers.solution import REFUSALS

KEPT_BYTES = 4096
"""Bytes searched for the protocol: an epoch or two of anything."""


class SolutionOptions(ReceiverOptions, SolutionDecoding):
    """Options of a receiver with its own solutions."""


class SolutionDriver(ReceiverDriver):
    """Driver that reads a line and hands over fixes, headings and times; `status` has the reason if
    it cannot."""

    Options: ClassVar[type[SolutionOptions]] = SolutionOptions
    Decoder: ClassVar[Callable[..., Any]]
    kind: ClassVar[str]
    """The driver's name."""
    wanted: ClassVar[str]
    """Name of verified input, as in "bytes arrive, but no ... verifies"."""
    switch_on: ClassVar[str]
    """Advice where no input has a position."""

    def __init__(
        self, name: str, options: SolutionOptions, emit: Emit, now_ns: Now = monotonic_ns
    ) -> None:
        self._options = options
        self._foreign = bytearray()
        super().__init__(name, options, emit, now_ns)

    def _make_decoder(self) -> Any:
        self._solutions = type(self).Decoder(self.name, self._options, self.counters)
        return self._solutions

    def _on_bytes(self, data: bytes, t_seen_ns: int) -> None:
        super()._on_bytes(data, t_seen_ns)
        if self._signs_of_life():
            self._foreign.clear()
        else:
            self._foreign += data[-KEPT_BYTES:]
            del self._foreign[:-KEPT_BYTES]

    @property
    def cause(self) -> str:
        """Sentence on another protocol on the line; "" if none is recognised."""
        if not self._foreign:
            return ""
        counters = Counter[str]()
        splitter = StreamSplitter(counters)
        splitter.feed(bytes(self._foreign))
        splitter.finish()
        for counter, what, driver in (
            ("sentences", "NMEA", "nmea"),
            ("ubx_frames", "UBX", "ubx"),
            ("rtcm_frames", "RTCM 3", "gnss"),
        ):
            if counters[counter] and driver != self.kind:
                return (
                    f"{what} arrives, but no {self.wanted}: {self.switch_on}, or have {what} "
                    f'read: driver = "{driver}"'
                )
        if self.kind == "ubx" and counters["ubx_damaged"] >= MANY:
            return (
                "UBX frames arrive with wrong checksums: check ground, cable length and that "
                "nobody else reads this port"
            )
        found = protocol_sentence(bytes(self._foreign))
        return "" if f'driver = "{self.kind}"' in found else found

    def _useless_detail(self) -> str:
        if self.counters["position_type_unknown"]:
            return "the receiver names a kind of position that is not known here: please report it"
        left_out = self._solutions.left_out
        names = f" ({', '.join(left_out)})" if left_out else ""
        nothing = f"nothing with a position arrives{names}: {self.switch_on}"
        return REFUSALS.get(self._solutions.refusal, nothing)

    def _unintelligible_detail(self) -> str:
        nothing = f"bytes arrive, but no {self.wanted} verifies{self._where_to_look()}"
        return self.cause or nothing
