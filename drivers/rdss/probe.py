"""Search for a terminal's baud rate and family."""

from __future__ import annotations

from collections.abc import Callable

from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.messages import Family, IdentityRequest, Message
from drivers.rdss.state_tables import Action, Notice, Send, SetBaud

ENCODE: dict[Family, Callable[[Message], bytes]] = {
    "4.0": binary_4_0.encode,
    "2.1": text_2_1.encode,
}


class Probe:
    """Probe of baud rates, each with a request for the card in every family: harmless reads only.

    `in_vain` is true after a round without a reply; probing continues.
    """

    def __init__(self, bauds: tuple[int, ...], families: tuple[Family, ...]) -> None:
        self._bauds = bauds
        self._families = families
        self._at = 0
        self._asked = 0

    @property
    def baud(self) -> int:
        """The rate in use or being tried."""
        return self._bauds[self._at]

    @property
    def in_vain(self) -> bool:
        return self._asked > len(self._bauds)

    def restart(self) -> None:
        """Restart with the rate that was last in use."""
        self._asked = 0

    def next(self) -> list[Action]:
        """Next request: each family at this rate, then the next rate."""
        actions: list[Action] = []
        if self._asked:
            self._at = (self._at + 1) % len(self._bauds)
        if len(self._bauds) > 1:
            actions.append(SetBaud(self.baud))
        if self._asked == len(self._bauds):
            tried = ", ".join(map(str, self._bauds))
            actions.append(Notice("rdss_no_answer", f"no RDSS terminal answers at {tried} baud"))
        self._asked += 1
        actions += [Send(ENCODE[family](IdentityRequest()), "read") for family in self._families]
        return actions
