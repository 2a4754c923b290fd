"""Tasks of the outputs: one supervised task each, stopped one by one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping
from functools import partial

from fusiond.live.supervision import supervise
from fusiond.outputs.base import Output


class OutputTasks:
    """Tasks of the outputs. `on_event(source, code, text)` receives failures and restarts."""

    def __init__(self, on_event: Callable[[str, str, str], None]) -> None:
        self._on_event = on_event
        self._tasks: dict[str, asyncio.Task[None]] = {}

    def start(self, outputs: Mapping[str, Output]) -> None:
        """Start a task for each output without one."""
        for name, output in outputs.items():
            if name not in self._tasks:
                fell = partial(self._on_event, name, "output_fault")
                serve = supervise(f"output {name}", output.run, fell)
                self._tasks[name] = asyncio.create_task(serve, name=f"output {name}")

    async def stop(self, names: Iterable[str] | None = None) -> None:
        """Stop these outputs, or all; returns once they have disconnected."""
        ending = [
            self._tasks.pop(name)
            for name in (tuple(self._tasks) if names is None else names)
            if name in self._tasks
        ]
        for task in ending:
            task.cancel()
        await asyncio.gather(*ending, return_exceptions=True)
