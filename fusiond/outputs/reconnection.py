"""Reconnection to the broker, and detection of a second client with our name.

A broker ends the older of two connections with one client identifier (MQTT 3.1.1, 3.1.4-2); in
3.1.1 it gives no reason. Connections that end again and again, moments after they began, reveal a
rival with our name that reconnects as we do. We then wait longer; otherwise the two would
disconnect each other several times a second.
"""

from __future__ import annotations

from drivers.base import Backoff

# A rival that reconnects as we do returns within the longest ordinary wait, 5 s. So a connection
# that ends within twice that time was taken over.
TAKEN_WITHIN_S = 10.0
# One end may be a restart of the broker, two a trial of its configuration.
TAKEN_COUNT = 3
# With a rival each wait is a minute at most; the rival is gone if a connection outlives two such
# waits.
LONGEST_CONTESTED_S = 60.0
PEACE_S = 2.0 * LONGEST_CONTESTED_S


class Reconnecting:
    """Wait between connections; `taken` while another client seems to have our name."""

    def __init__(self) -> None:
        self.taken = False
        self._ordinary = Backoff()
        self._contested = Backoff(first_s=5.0, longest_s=LONGEST_CONTESTED_S)
        self._in_a_row = 0

    def failed(self) -> None:
        """Note a failed attempt, which is no evidence of a rival: the broker is away."""
        self._in_a_row = 0

    def ended(self, lasted_s: float, by_broker: bool) -> bool:
        """Note the end of a connection; True if it is the first evidence of a rival client."""
        if lasted_s > PEACE_S:
            self.taken = False
            self._contested.reset()
        if not by_broker or lasted_s > TAKEN_WITHIN_S:
            self._in_a_row = 0
            self._ordinary.reset()
            return False
        self._in_a_row += 1
        if self._in_a_row < TAKEN_COUNT or self.taken:
            return False
        self.taken = True
        return True

    def wait_s(self) -> float:
        """Wait before the next attempt, s."""
        return (self._contested if self.taken else self._ordinary).next()
