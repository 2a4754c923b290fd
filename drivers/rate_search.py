"""Search for the baud rate of a line whose bytes do not verify: no I/O, no clock.

After a loss of its battery or a reset a receiver sends at another rate than the configured one. All
rates, the configured one among them, are tried in turn for 2 s each (two epochs of a second), as
long as bytes arrive and none of them verifies.
"""

from __future__ import annotations

BAUDS = (115_200, 9_600, 38_400, 460_800, 921_600, 230_400, 57_600, 19_200, 4_800)
"""In the order of how often receivers are found at them."""
LISTEN_NS = 2_200_000_000
"""At each rate: receivers speak once a second, so two epochs and the end of a third."""
ENOUGH_BYTES = 64
"""Of a sentence or two: less is a disturbance on a line where nobody speaks."""


class RateSearch:
    """Search on one line with the configured rate `baud`."""

    def __init__(self, baud: int) -> None:
        self.configured = self.baud = baud
        self._untried: list[int] = []
        self._since_ns: int | None = None
        self._bytes_in = 0

    def understood(self) -> None:
        """Keep this rate, since a message has verified."""
        self._since_ns, self._untried = None, []

    def next(self, t_ns: int, bytes_in: int) -> int | None:
        """Next rate to try after `bytes_in` bytes in all; None to keep this one."""
        if self._since_ns is not None and (
            t_ns - self._since_ns < LISTEN_NS or bytes_in - self._bytes_in < ENOUGH_BYTES
        ):
            return None
        self._since_ns, self._bytes_in = t_ns, bytes_in
        if not self._untried:
            rates = dict.fromkeys((self.configured, *BAUDS))
            self._untried = [rate for rate in rates if rate != self.baud]
        self.baud = self._untried.pop(0)
        return self.baud
