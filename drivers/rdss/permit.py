"""Whether the terminal may transmit: suppression by the system, radio silence by the operator.

Neither is ever lifted from here; what lifts it is noticed here.
"""

from __future__ import annotations

from drivers.rdss.cycle import FEEDBACK_NS, SECOND
from drivers.rdss.messages import Feedback, Outcome


class TransmitPermit:
    """`silent`, and `suppressed_until_ns`: None, or the end of the hold if nobody lifts it."""

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
        """Lifted by whoever may, the hold is over, or another card is in the terminal."""
        self.silent, self.suppressed_until_ns = False, None

    def suppress(self, t_ns: int) -> bool:
        """The terminal says that it is suppressed; True if that is news."""
        news = self.suppressed_until_ns is None
        self.suppressed_until_ns = t_ns + self._hold_ns
        self._inbound_changed = False
        return news

    def silence(self) -> bool:
        """The terminal says that radio silence is set; True if that is news."""
        news = not self.silent
        self.silent = True
        self._inbound_changed = False
        return news

    def accepted(self) -> None:
        """A request was accepted: the inbound state last read is that of a free terminal."""
        self._inbound_free = self._inbound

    def lifted_by_feedback(self, feedback: Feedback, t_ns: int, requested_ns: int | None) -> bool:
        """Does this feedback say that transmission is allowed again?

        Flag 8 while suppressed is read as "lifted" (one vendor); if it means radio silence, the
        terminal refuses the next request with it and we fall silent. The feedback of a request
        written just before the suppression does not count.
        """
        if self.granted:
            return False
        if requested_ns is not None and t_ns - requested_ns <= FEEDBACK_NS:
            return False
        if feedback.outcome is Outcome.SILENCE_OR_LIFTED:
            return not self.silent
        return feedback.inhibited is False

    def lifted_by_self_test(self, inbound_state: int | None) -> bool:
        """Does ZJXX say so? The bits of its inbound state differ by vendor, but back to the value
        it had while requests were accepted, after another one, means the same everywhere."""
        self._inbound = inbound_state
        if self.granted or self._inbound_free is None:
            return False
        if inbound_state != self._inbound_free:
            self._inbound_changed = True
            return False
        return self._inbound_changed
