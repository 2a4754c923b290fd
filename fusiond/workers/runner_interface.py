"""Outcome of one run, and the interface of runners."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, Literal, Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")
Ended = Literal["done", "error", "died", "timeout"]


@dataclass(frozen=True, slots=True)
class Outcome(Generic[R]):
    """Outcome of item `index`: its result or the reason for its failure.

    `error`: an exception left the run; `died`: its process ended; `timeout`: it took too long.
    `reason` is the explanation, empty for a success.
    """

    index: int
    ended: Ended
    reason: str = ""
    result: R | None = None


class Runner(Protocol):
    """Runner that applies a function to each item on other processes, `workers` at a time."""

    @property
    def workers(self) -> int: ...

    def outcomes(
        self, work: Callable[[T], R], items: Sequence[T], chunk: int = 1
    ) -> Iterator[Outcome[R]]:
        """Run each item and yield outcomes in order of completion.

        `work` is a function of a module, or a partial of one; `chunk` items are handed over at
        once. No failure of a run is raised.
        """
        ...
