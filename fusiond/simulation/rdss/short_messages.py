"""Simulated short messages between cards: delay, loss, damage, and another vehicle of a convoy.

The network carries messages of its terminals to the card that they name. A message to an unknown
card is counted and lost, as in the real network.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from drivers.rdss.messages import FieldError, Text, TextRequest
from drivers.rdss.position_report_coding import REPORT, PositionReport, encode_report
from drivers.rdss.text_coding import EncodedText, encode_shortest
from drivers.rdss.vehicle_message_envelope import (
    RECEIPT,
    TEXT,
    Receipt,
    decode_text_body,
    encode_envelope,
    encode_receipt_body,
    envelope_from_text,
    envelope_to_text,
)
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.rdss.terminal import RdssTerminal


@dataclass
class MessageNetwork:
    """Network of terminals. Probabilities apply to each message; `delay_s` is from burst to serial
    line.

    Counters: `envelope_to_text`, `lost`, `damaged` (handed over with a CRC that failed), `nobody`.
    """

    rng: np.random.Generator
    loss_probability: float = 0.0
    damage_probability: float = 0.0
    delay_s: tuple[float, float] = (0.5, 2.0)
    counters: Counter[str] = field(default_factory=Counter)
    _terminals: dict[int, RdssTerminal] = field(default_factory=dict)

    def join(self, terminal: RdssTerminal) -> None:
        """Connect a terminal, whose messages are carried to and from others."""
        self._terminals[terminal.options.user] = terminal
        terminal.carry = self.carry

    def carry(self, sender: int, message: TextRequest, t_s: float) -> None:
        """Carry a message that left the sender's antenna at `t_s`."""
        receiver = self._terminals.get(message.receiver)
        if receiver is None:
            self.counters["nobody"] += 1
            return
        if self.rng.random() < self.loss_probability:
            self.counters["lost"] += 1
            return
        damaged = bool(self.rng.random() < self.damage_probability)
        self.counters["damaged" if damaged else "carried"] += 1
        text = Text(
            sender,
            message.payload,
            message.encoding,
            message.receiver,
            crc_ok=not damaged,
            odd=message.odd,
        )
        receiver.hand_over(text, t_s + float(self.rng.uniform(*self.delay_s)))


class ConvoyVehicle:
    """Second vehicle of a convoy, `behind_s` later on the same path: it reports its position, sends
    orders at times, and confirms texts that request it."""

    CARD = 242407
    REPORT_S, ORDER_S = 10.0, 45.0
    ORDERS = ("Convoy: keep 50 km/h", "Report fuel", "12345", "停车")

    def __init__(self, truth: Truth, ahead: RdssTerminal, behind_s: float = 8.0) -> None:
        self._truth = truth
        self._ahead = ahead
        self._behind_s = behind_s
        self._next_report_s, self._next_order_s = 5.0, 20.0
        self._orders = 0
        ahead.carry = self._receive

    def tick(self, t_s: float) -> None:
        """Deliver due messages."""
        if t_s >= self._next_report_s:
            self._next_report_s = t_s + self.REPORT_S
            self._say(
                envelope_to_text(
                    encode_envelope(REPORT, encode_report(self._report(t_s))), "binary"
                ),
                t_s,
            )
        if t_s >= self._next_order_s:
            self._next_order_s = t_s + self.ORDER_S
            self._say(encode_shortest(self.ORDERS[self._orders % len(self.ORDERS)]), t_s)
            self._orders += 1

    def _report(self, t_s: float) -> PositionReport:
        state = self._truth.at(np.array([max(0.0, t_s - self._behind_s)]), (0.0, 0.0, 0.0))
        lat, lon, height = (float(x) for x in state.position[0])
        north, east = (float(x) for x in state.v_ned[0, :2])
        return PositionReport(
            self._ahead.utc_start_ns * 1e-9 + t_s,
            math.degrees(lat),
            math.degrees(lon),
            "navigating",
            (2.0, 2.0, 4.0),
            height,
            math.hypot(north, east),
            math.degrees(math.atan2(east, north)) % 360.0,
        )

    def _receive(self, sender: int, message: TextRequest, t_s: float) -> None:
        if message.receiver != self.CARD:
            return
        try:
            envelope = envelope_from_text(
                EncodedText(message.payload, message.encoding, message.odd)
            )
        except FieldError:
            return
        if envelope is not None and envelope.kind == TEXT:
            number, _ = decode_text_body(envelope.body)
            body = encode_receipt_body(Receipt(number, envelope.crc))
            self._say(envelope_to_text(encode_envelope(RECEIPT, body), "binary"), t_s + 2.0)

    def _say(self, wording: EncodedText, t_s: float) -> None:
        text = Text(
            self.CARD, wording.payload, wording.encoding, self._ahead.options.user, odd=wording.odd
        )
        self._ahead.hand_over(text, t_s + 1.0)
