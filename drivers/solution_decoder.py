"""Common part of the decoders `ubx`, `bestpos` and `sbf`: bytes to messages, messages to epochs.

`drivers.epoch_ends` finds the end of an epoch, `drivers.solution` judges it. No I/O, no clock.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Hashable, Iterable
from typing import Generic, TypeVar

from drivers.decoder_options import SolutionDecoding
from drivers.epoch_ends import Cycle, Name
from drivers.framing_base import Splitter
from drivers.measurements import Measurement
from drivers.nmea.reasons import implausible_date
from drivers.solution import Solution, SolutionJudge

Message = TypeVar("Message")
Epoch = TypeVar("Epoch")


class SolutionDecoder(ABC, Generic[Message, Epoch]):
    """Decoder: `feed` bytes to get measurements; `flush` at the end of the file.

    A subclass splits the bytes, adds messages to `_epoch`, and makes a `Solution` of a closed
    epoch.
    """

    def __init__(
        self,
        source: str,
        decoding: SolutionDecoding | None = None,
        counters: Counter[str] | None = None,
    ) -> None:
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._decoding = decoding or SolutionDecoding()
        self._splitter = self._make_splitter()
        self._judge = SolutionJudge(source, self._decoding, self.counters)
        self._cycle = Cycle(self.counters)
        self._epoch: Epoch | None = None
        self._t_seen_ns = 0
        self.left_out: Counter[str] = Counter()
        """Names of unused messages, the first few of an unreadable stream."""

    @property
    def refusal(self) -> str:
        """Reason why the last epoch gave no fix, by counter name."""
        return self._judge.refusal

    @property
    def cautions(self) -> dict[str, str]:
        """Cautions by counter: limits on the quality of fixes, and the actions taken."""
        day = self._judge.implausible_date
        if day is None:
            return {}
        return {"implausible_date": implausible_date(day, self._decoding.earliest_date)}

    @property
    def gga(self) -> bytes:
        """Last fix as a GGA; empty before the first one."""
        return self._judge.gga

    @property
    def epoch_open(self) -> bool:
        """True if `silence` would close an epoch."""
        return self._epoch is not None

    def feed(self, data: bytes, t_seen_ns: int) -> list[Measurement]:
        """Measurements that `data`, seen at `t_seen_ns`, completes."""
        self._t_seen_ns = t_seen_ns
        found: list[Measurement] = []
        self._take_all(self._splitter.feed(data), found)
        return found

    def silence(self) -> list[Measurement]:
        """Handle a silence longer than any receiver's pause within an epoch (50 ms)."""
        found: list[Measurement] = []
        self._end(found, learn=True)
        return found

    def flush(self) -> list[Measurement]:
        """End the stream; return what its last bytes still complete."""
        found: list[Measurement] = []
        self._take_all(self._splitter.finish(), found)
        self._end(found, learn=False)
        return found

    def _take_all(self, messages: Iterable[Message], found: list[Measurement]) -> None:
        for message in messages:
            self._take(message, found)

    # ----------------------------------------------------------------- protocol

    @abstractmethod
    def _make_splitter(self) -> Splitter[Message]:
        """Make the splitter, which counts in `self.counters`."""

    @abstractmethod
    def _take(self, message: Message, found: list[Measurement]) -> None:
        """Process a message; add what it completes to `found`."""

    @abstractmethod
    def _solution(self, epoch: Epoch) -> Solution | None:
        """Solution of a closed epoch; None without a position to judge."""

    # ----------------------------------------------------------------- epochs

    def _belongs(self, key: Hashable, name: Name, found: list[Measurement]) -> bool:
        """True if a message of instant `key` belongs to the open epoch or starts a new one; a
        closed epoch's results are added to `found`."""
        if self._cycle.restarts(key, name):
            self._close(found, learn=True)
        return not self._cycle.delayed(key, name)

    def _close(self, found: list[Measurement], *, learn: bool, at_once: bool = False) -> None:
        epoch, self._epoch = self._epoch, None
        if epoch is None:
            return
        self._cycle.close(learn=learn, at_once=at_once)
        solution = self._solution(epoch)
        if solution is not None:
            found += self._judge.epoch(solution)

    def _end(self, found: list[Measurement], *, learn: bool) -> None:
        """End the open epoch."""
        self._close(found, learn=learn)
