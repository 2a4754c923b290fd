"""Short messages as they come off a terminal: whatever a payload holds, it is handed on once."""

from __future__ import annotations

import binascii
import math
from collections import Counter

from drivers.rdss.inbox import Inbox
from drivers.rdss.mail import MessageReceived, TextEncoding
from drivers.rdss.messages import Identity, Text
from drivers.rdss.position_report_coding import MODES
from drivers.rdss.request_cycle_state import RequestCycleState
from drivers.rdss.state_tables import TerminalOptions
from drivers.rdss.vehicle_message_envelope import MARK
from tests.fuzz.documents import input_of

OWN, OTHER = 242286, 242407
ENCODINGS: tuple[TextEncoding, ...] = ("mixed", "code", "chinese", "mixed")


def rdss_mail(data: bytes) -> None:
    """Each message is counted and handed on with its bytes; a fault has its counter; what a report
    says can be; one that asks is answered once a time, however often it comes."""
    choice, payload = input_of(data[:211])
    if choice & 8:  # an envelope with the right check, so that what it holds is read
        body = bytes((MARK | choice >> 4 & 7,)) + payload[:200]
        payload = b"\xa4" + body + binascii.crc_hqx(body, 0xFFFF).to_bytes(2, "big")
    session = RequestCycleState(TerminalOptions(source="rdss"), Counter())
    session.identity = Identity(OWN, 60, comm_level=4)
    inbox = Inbox(session)
    user = OTHER if choice & 4 else OWN
    text = Text(OTHER, payload, ENCODINGS[choice & 3], user, odd=bool(choice & 128 and payload))
    first, again = (inbox.mail_of(text, t_ns).mail for t_ns in (1, 2))
    assert isinstance(first, MessageReceived)
    assert isinstance(again, MessageReceived)
    assert (first.payload, first.sender, first.repeated) == (payload, OTHER, False)
    assert first.text is None or first.text.isprintable()
    assert session.counters["messages_received"] == 2
    assert not first.fault or session.counters[f"message_{first.fault}"] == 2
    assert again.repeated == (first.kind == "text" and first.number is not None)
    assert len(session.outbox.waiting) == again.repeated
    if first.report is not None:
        assert abs(first.report.lat_deg) <= 90.0
        assert abs(first.report.lon_deg) <= 180.0
        assert first.report.mode in MODES
        assert math.isfinite(first.report.t_s)
        assert all(sd is None or 0.0 < sd < 30_000.0 for sd in first.report.sd_ned_m)
