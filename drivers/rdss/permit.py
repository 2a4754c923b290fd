"""Permission to transmit: the card's spacing, suppression, radio silence.

This module never lifts suppression (by the system) or silence (by the operator); it only notes that
they were lifted.
"""

from __future__ import annotations

from drivers.rdss.messages import Feedback, Outcome
from drivers.rdss.state_tables import (
    BITS_A_BYTE,
    DEFAULT_SERVICE_S,
    FEEDBACK_NS,
    LEAST_MARGIN_NS,
    MOST_MARGIN_NS,
    SECOND,
    WAIT_MARGIN_NS,
)


class TransmitPermit:
    """Permission: `silent`, and `suppressed_until_ns`, the latest end of a suppression, or None."""

    def __init__(self, hold_s: float) -> None:
        self.silent = False
        self.suppressed_until_ns: int | None = None
        self._hold_ns = int(hold_s * SECOND)
        self._inbound: int | None = None
        self._inbound_free: int | None = None
        self._inbound_changed = False

    @property
    def granted(self) -> bool:
        return not self.silent and self.suppressed_until_ns is None

    def grant(self) -> None:
        """Note the end of a suppression: by its authority, after the hold time, or with another
        card."""
        self.silent, self.suppressed_until_ns = False, None

    def suppress(self, t_ns: int) -> bool:
        """Note a suppression by the terminal; True if new."""
        news = self.suppressed_until_ns is None
        self.suppressed_until_ns = t_ns + self._hold_ns
        self._inbound_changed = False
        return news

    def silence(self) -> bool:
        """Note the terminal's report of radio silence; True if silence is new."""
        news = not self.silent
        self.silent = True
        self._inbound_changed = False
        return news

    def accepted(self) -> None:
        """Note an accepted request: the inbound state last read is that of a free terminal."""
        self._inbound_free = self._inbound

    def lifted_by_feedback(self, feedback: Feedback, t_ns: int, written_ns: int | None) -> bool:
        """True if this feedback shows that transmission is allowed again.

        Flag 8 while suppressed is read as "lifted" (one vendor); if it means radio silence, the
        terminal refuses the next request with it and we fall silent. The feedback of a request
        written just before the suppression does not count.
        """
        if self.granted:
            return False
        if written_ns is not None and t_ns - written_ns <= FEEDBACK_NS:
            return False
        if feedback.outcome is Outcome.SILENCE_OR_LIFTED:
            return not self.silent
        return feedback.inhibited is False

    def lifted_by_self_test(self, inbound_state: int | None) -> bool:
        """True if ZJXX shows that transmission is allowed again.

        The bits of its inbound state differ by vendor. With every vendor, a return to the value
        that it had while requests were accepted means that transmission is allowed."""
        self._inbound = inbound_state
        if self.granted or self._inbound_free is None:
            return False
        if inbound_state != self._inbound_free:
            self._inbound_changed = True
            return False
        return self._inbound_changed


class TransmissionSpacing:
    """Spacing of transmissions, requests and messages alike: the card's service interval after the
    last byte of the previous one.

    `service_s` is the card's interval (None: not read yet). `requested_ns` and `written_ns` are the
    instants at which the last request for a fix, and the last transmission of any kind, were
    written. `asap` waives the configured interval of fixes once, never the card's. A small margin
    is added; it grows when the terminal refuses a transmission as too early.
    """

    def __init__(self, interval_s: float | None) -> None:
        self.service_s: int | None = None
        self.requested_ns: int | None = None
        self.written_ns: int | None = None
        self.asap = False
        self.margin_ns = LEAST_MARGIN_NS
        self._interval_ns = int((interval_s or 0.0) * SECOND)
        self._wire_ns = 0
        self._not_before_ns = 0

    @property
    def spacing_ns(self) -> int:
        """Least interval of transmissions."""
        return (self.service_s or DEFAULT_SERVICE_S) * SECOND + self.margin_ns + self._wire_ns

    @property
    def free_ns(self) -> int:
        """Instant of the next permitted transmission."""
        if self.written_ns is None:
            return self._not_before_ns
        return max(self._not_before_ns, self.written_ns + self.spacing_ns)

    @property
    def due_ns(self) -> int:
        """Instant of the next permitted request for a fix."""
        if self.requested_ns is None or self.asap:
            return self.free_ns
        return max(self.free_ns, self.requested_ns + self._interval_ns)

    def written(self, t_ns: int, size: int, baud: int, *, fix: bool) -> None:
        """Note that a transmission of a number of bytes was written."""
        self.written_ns = t_ns
        self._wire_ns = size * BITS_A_BYTE * SECOND // baud
        if fix:
            self.requested_ns, self.asap = t_ns, False

    def not_before(self, t_ns: int) -> None:
        """Forbid transmission before this instant."""
        self._not_before_ns = max(self._not_before_ns, t_ns)

    def too_early(self, t_ns: int, stated_s: float | None) -> None:
        """Wait and increase the margin after a refusal for the spacing.

        The margin stays if seconds are left to wait: then another program has used the card.
        """
        if stated_s is None or stated_s <= 1.0:
            self.margin_ns = min(2 * self.margin_ns, MOST_MARGIN_NS)
        self.wait(t_ns, stated_s)

    def wait(self, t_ns: int, stated_s: float | None) -> None:
        """Wait one second more than stated. A missing or implausible wait (above twice the service
        interval) is taken as the service interval (PROTOCOLS 1.2)."""
        service = self.service_s or DEFAULT_SERVICE_S
        wait_s = stated_s if stated_s is not None and stated_s <= 2 * service else service
        self.not_before(t_ns + int(wait_s * SECOND) + WAIT_MARGIN_NS)
