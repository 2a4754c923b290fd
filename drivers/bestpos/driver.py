"""A NovAtel or Unicore receiver that sends ASCII logs: see `docs/gnss-bestpos.md`."""

from __future__ import annotations

from typing import ClassVar

from drivers.base import Emit, Now, monotonic_ns
from drivers.bestpos.decoder import BestposDecoder
from drivers.receiver import ReceiverDriver, ReceiverOptions
from drivers.solution import REFUSALS, SolutionDecoding


class BestposOptions(ReceiverOptions, SolutionDecoding):
    """Options of a `driver = "bestpos"` source."""


class BestposDriver(ReceiverDriver):
    """Reads the line, hands over fixes, headings and times."""

    Options: ClassVar[type[BestposOptions]] = BestposOptions
    alive_by = ("logs",)

    def __init__(
        self, name: str, options: BestposOptions, emit: Emit, now_ns: Now = monotonic_ns
    ) -> None:
        self._options = options
        super().__init__(name, options, emit, now_ns)

    def _make_decoder(self) -> BestposDecoder:
        self._logs = BestposDecoder(self.name, self._options, self.counters)
        return self._logs

    def _useless_detail(self) -> str:
        if self.counters["position_type_unknown"]:
            return "the receiver names a type of position that is not known here: please report it"
        return REFUSALS.get(
            self._logs.refusal, "logs arrive, but none with a position: LOG BESTPOSA ONTIME 0.1"
        )

    def _unintelligible_detail(self) -> str:
        return f"bytes arrive, but no log such as #BESTPOSA verifies{self._where_to_look()}"
