"""A u-blox receiver that sends UBX navigation messages: see `docs/gnss-ubx.md`."""

from __future__ import annotations

from typing import ClassVar

from drivers.base import Emit, Now, monotonic_ns
from drivers.receiver import ReceiverDriver, ReceiverOptions
from drivers.solution import REFUSALS, SolutionDecoding
from drivers.ubx.decoder import UbxDecoder


class UbxOptions(ReceiverOptions, SolutionDecoding):
    """Options of a `driver = "ubx"` source."""


class UbxDriver(ReceiverDriver):
    """Reads the line, hands over fixes, headings and times."""

    Options: ClassVar[type[UbxOptions]] = UbxOptions
    alive_by = ("ubx_frames",)

    def __init__(
        self, name: str, options: UbxOptions, emit: Emit, now_ns: Now = monotonic_ns
    ) -> None:
        self._options = options
        super().__init__(name, options, emit, now_ns)

    def _make_decoder(self) -> UbxDecoder:
        self._ubx = UbxDecoder(self.name, self._options, self.counters)
        return self._ubx

    def _useless_detail(self) -> str:
        if not self.counters["nav_messages"]:
            return "UBX frames arrive, but none with a solution: switch on UBX-NAV-PVT"
        return REFUSALS.get(self._ubx.refusal, "UBX-NAV arrives, but no position: switch on PVT")

    def _unintelligible_detail(self) -> str:
        if self._since_alive("sentences"):
            return 'NMEA arrives, but no UBX: switch on UBX-NAV-PVT, or take driver = "nmea"'
        return f"bytes arrive, but no UBX frame verifies{self._where_to_look()}"
