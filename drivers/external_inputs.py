"""Entry point of all external input of a driver, in sequence.

A driver's results depend on its inputs alone. While it handles an input, its clock stands at the
input's instant; so the same inputs from a recording give the same measurements, requests and
events.

    read     bytes off a serial line, as one read gave them
    frame    a frame off a CAN bus
    open     the line or bus was opened            close    it went away: why, in words
    controller  a CAN controller's state           other    a timer of the driver's own, by its name
    correction  a frame of a caster that serves fusiond itself
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from drivers.base import Now

if TYPE_CHECKING:
    from drivers.can.bus import CanFrame

Handler = Callable[[Any, int], None]
"""Callback with the payload and the instant (monotonic ns)."""


class Inputs:
    """Inputs of one driver by kind. `heard(kind, t_ns, payload)` receives each input before the
    driver handles it, and all data that the driver sends."""

    def __init__(self, host_now_ns: Now) -> None:
        self._host_now_ns = host_now_ns
        self._handlers: dict[str, Handler] = {}
        self._held_ns: int | None = None
        self.on_input: Callable[[str, int, bytes | str | CanFrame | None], None] | None = None

    def on(self, kind: str, handler: Handler) -> None:
        """Register the handler of a kind of input."""
        self._handlers[kind] = handler

    def now_ns(self) -> int:
        """Driver's time: the instant of the input in hand, else the host's clock."""
        return self._host_now_ns() if self._held_ns is None else self._held_ns

    def take(
        self, kind: str, payload: bytes | str | CanFrame | None = None, t_ns: int | None = None
    ) -> None:
        """Handle an input that came at `t_ns`, by default now. KeyError for an unknown kind."""
        if t_ns is None:
            t_ns = self._host_now_ns()
        handler = self._handlers[kind]
        if self.on_input is not None:
            self.on_input(kind, t_ns, payload)
        self._held_ns = t_ns
        try:
            handler(payload, t_ns)
        finally:
            self._held_ns = None

    def sent(self, data: bytes) -> None:
        """Report data sent to the device to the listener."""
        if self.on_input is not None:
            self.on_input("sent", self.now_ns(), data)
