"""A Septentrio receiver that sends SBF: see `docs/gnss-sbf.md`."""

from __future__ import annotations

from typing import ClassVar

from drivers.base import Emit, Now, monotonic_ns
from drivers.receiver import ReceiverDriver, ReceiverOptions
from drivers.sbf.decoder import SbfDecoder
from drivers.solution import REFUSALS, SolutionDecoding


class SbfOptions(ReceiverOptions, SolutionDecoding):
    """Options of a `driver = "sbf"` source."""


class SbfDriver(ReceiverDriver):
    """Reads the line, hands over fixes, headings and times."""

    Options: ClassVar[type[SbfOptions]] = SbfOptions
    alive_by = ("sbf_blocks",)

    def __init__(
        self, name: str, options: SbfOptions, emit: Emit, now_ns: Now = monotonic_ns
    ) -> None:
        self._options = options
        super().__init__(name, options, emit, now_ns)

    def _make_decoder(self) -> SbfDecoder:
        self._sbf = SbfDecoder(self.name, self._options, self.counters)
        return self._sbf

    def _useless_detail(self) -> str:
        if self.counters["position_type_unknown"]:
            return "the receiver names a mode of positioning that is not known here: please report"
        return REFUSALS.get(
            self._sbf.refusal, "SBF arrives, but no position: switch on PVTGeodetic"
        )

    def _unintelligible_detail(self) -> str:
        return f"bytes arrive, but no SBF block verifies{self._where_to_look()}"
