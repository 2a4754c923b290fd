"""Connection of one viewer: WebSocket, subscriptions and waiting messages."""

from __future__ import annotations

import logging
import struct
from collections import Counter
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

from websockets import Subprotocol
from websockets.frames import OP_BINARY, OP_CONT, OP_TEXT, Frame
from websockets.http11 import Request
from websockets.protocol import OPEN
from websockets.server import ServerProtocol

from fusiond.outputs.foxglove.channels import CHANNELS, Channel
from fusiond.outputs.json_requests import NotUnderstoodError, parsed
from fusiond.outputs.tcp import Client

if TYPE_CHECKING:
    from fusiond.outputs.foxglove.server import FoxgloveServer

PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
MOST_SUBSCRIPTIONS = 4 * len(CHANNELS)
"""Most subscriptions; Foxglove has one for each displayed channel, whatever the number of panels.
"""
MOST_REQUEST_BYTES = 8192
"""Four subscriptions to every channel have 2.5 kB."""
_SLICE_BYTES = 128
"""Handed to the parser at once: 21 of the smallest frames, between two looks at the allowance."""
_ON_THEIR_WAY_BYTES = 8192
"""Bytes that the kernel accepts at once (SO_SNDBUF of a connection)."""
_DATA = struct.Struct("<BIQ")
_OPCODE_DATA = 1
_BY_ID = {channel.id: channel for channel in CHANNELS}
# It logs a line for each connection, and a traceback for each that is no WebSocket.
_LOG = logging.getLogger("fusiond.websockets")
_LOG.setLevel(logging.CRITICAL)


class Data(NamedTuple):
    """Message as sent to every viewer."""

    t_ns: int
    payload: bytes


def text_frame(text: str) -> bytes:
    return bytes(Frame(OP_TEXT, text.encode()).serialize(mask=False))


def loopback(origin: str) -> bool:
    """True if a page's origin is this computer."""
    try:
        name = urlsplit(origin).hostname or ""
        return name == "localhost" or ip_address(name).is_loopback
    except ValueError:
        return False


class Viewer:
    """Connected viewer; `channels` counts its subscriptions to each channel."""

    def __init__(self, server: FoxgloveServer, client: Client) -> None:
        self._server, self._client = server, client
        self._socket = ServerProtocol(
            subprotocols=[Subprotocol(name) for name in PROTOCOLS],
            max_size=MOST_REQUEST_BYTES,
            logger=_LOG,
        )
        self._message = bytearray()
        self._head_bytes = 0
        self._subscriptions: dict[int, Channel] = {}
        self._waiting: dict[int, Data] = {}
        self.channels: Counter[int] = Counter()
        client.on_room = self._send_waiting

    # ------------------------------------------------------------------ to the viewer

    def put(self, channel: Channel, data: Data) -> None:
        """Queue a message for every subscription to its channel."""
        for number, subscribed in self._subscriptions.items():
            if subscribed is channel:
                self._wait(number, data)
        self._send_waiting()

    def _wait(self, number: int, data: Data) -> None:
        self._server.counters["skipped"] += number in self._waiting
        self._waiting[number] = data

    def _send_waiting(self) -> None:
        """Send waiting messages while little is in flight, in frames for this viewer alone."""
        while (
            self._socket.state is OPEN
            and self._waiting
            and self._client.waiting_bytes < _ON_THEIR_WAY_BYTES
        ):
            number = next(iter(self._waiting))
            t_ns, payload = self._waiting.pop(number)
            self._socket.send_binary(_DATA.pack(_OPCODE_DATA, number, t_ns) + payload)
            self._pass_on()

    def _report(self, text: str) -> None:
        if self._socket.state is OPEN:  # an earlier frame of the same piece may have closed it
            self._socket.send_text(text.encode())

    def _pass_on(self) -> None:
        """Send what the WebSocket has encoded; close after its last frame."""
        parts = self._socket.data_to_send()
        data = b"".join(parts)
        if data:
            self._client.send(data)
        if b"" in parts or self._socket.close_expected():  # the mark of the end of data
            self._client.finish()

    # ------------------------------------------------------------------ from the viewer

    def receive(self, data: bytes) -> None:
        if self._client.request_due:
            # The limits of websockets, on a line and on the number of lines, allow a megabyte.
            self._head_bytes += len(data)
            if self._head_bytes > MOST_REQUEST_BYTES:
                self._client.drop("malformed")
                return
        for begin in range(0, len(data), _SLICE_BYTES):
            self._socket.receive_data(data[begin : begin + _SLICE_BYTES])
            for event in self._socket.events_received():
                if not self._client.charge():
                    return
                if isinstance(event, Request):
                    self._shake_hands(event)
                elif isinstance(event, Frame):
                    self._on_event(event)
            self._pass_on()
            if self._client.closed:
                return

    def end(self) -> None:
        self._socket.parser.close()  # breaks the cycle of parser and protocol
        self._waiting.clear()
        self.channels.clear()

    def _shake_hands(self, request: Request) -> None:
        self._client.request_due = False
        origin = request.headers.get("Origin")
        if origin is not None and not (loopback(origin) or origin in self._server.origins):
            self._server.refuse_origin(origin)
            self._socket.send_response(self._socket.reject(403, "origin not allowed\n"))
            return
        response = self._socket.accept(request)
        self._socket.send_response(response)
        if response.status_code == 101:
            self._pass_on()
            self._client.send(self._server.greeting)

    def _on_event(self, frame: Frame) -> None:
        if frame.opcode not in (OP_TEXT, OP_BINARY, OP_CONT):
            return
        self._message += frame.data
        if not frame.fin:
            return
        message = bytes(self._message)
        self._message.clear()
        try:
            self._carry_out(parsed(message))
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            self._server.counters["malformed"] += 1
            why = str(error) if isinstance(error, NotUnderstoodError) else "no such request"
            self._report(f'{{"op":"status","level":1,"message":"not understood: {why}"}}')

    def _carry_out(self, asked: Any) -> None:
        """Execute a request. Raises `ValueError`, `TypeError` or `KeyError` for an invalid one."""
        if asked["op"] == "subscribe":
            wanted = [
                (int(each["id"]), _BY_ID[each["channelId"]]) for each in asked["subscriptions"]
            ]
            for number, channel in wanted:
                self._subscribe(number, channel)
            self._send_waiting()
        elif asked["op"] == "unsubscribe":
            for number in asked["subscriptionIds"]:
                self._unsubscribe(number)
        else:
            raise ValueError("op")

    def _subscribe(self, number: int, channel: Channel) -> None:
        if not 0 <= number < 2**32:
            raise ValueError("subscription")
        self._unsubscribe(number)
        if len(self._subscriptions) >= MOST_SUBSCRIPTIONS:
            self._server.counters["subscriptions_refused"] += 1
            raise NotUnderstoodError(f"more than {MOST_SUBSCRIPTIONS} subscriptions")
        self._subscriptions[number] = channel
        self.channels[channel.id] += 1
        last = self._server.last(channel)
        if last is not None:
            self._wait(number, last)

    def _unsubscribe(self, number: int) -> None:
        channel = self._subscriptions.pop(number, None)
        self._waiting.pop(number, None)
        if channel is not None:
            self.channels[channel.id] -= 1
            if not self.channels[channel.id]:
                del self.channels[channel.id]
