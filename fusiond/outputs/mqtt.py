"""MQTT publisher: a supervised connection and bounded queues.

`publish` stores a message and returns: it never waits and never raises. One task sends the latest
values (QoS 0), another sends status and events (QoS 1, each confirmed before the next); both belong
to one connection and end with it. To detect a frozen broker, a QoS 1 message is sent at least every
quarter of `keepalive_s`, and its confirmation must come within half of it.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter, deque
from collections.abc import Callable, Coroutine

import aiomqtt
from pydantic import BaseModel

from drivers.base import DriverStatus
from fusiond.configuration.schema import Mqtt
from fusiond.outputs import broker_access, incoming_publications, oversized_packets
from fusiond.outputs.command_intake import CommandIntake
from fusiond.outputs.commands import MAX_PAYLOAD_BYTES, Handler
from fusiond.outputs.direct_writes import write_directly
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.messages.recent_events import MOST_KEPT, events_message
from fusiond.outputs.messages.reply import ReplyMessage
from fusiond.outputs.mqtt_endings import FAREWELL_S, abandon, end, hang_up, honour_cancellation
from fusiond.outputs.mqtt_version import MqttVersion
from fusiond.outputs.reconnection import Reconnecting
from fusiond.outputs.topics import EVENTS, REPLY, STATUS, Topic, base_topic

_TIMEOUT_S = 1.0
"""Age of an unconfirmed message that stops the QoS 0 flow, whose messages would be lost unseen."""
_INCOMING = 16
"""Commands that may wait; aiomqtt discards more."""
_OVERDUE = "timed out"
"""Text of aiomqtt's error for a missing confirmation: the disconnection is our own."""
# aiomqtt logs a line for every message that it discards: too many in a flood of commands.
_LOG = logging.getLogger("fusiond.aiomqtt")
_LOG.setLevel(logging.ERROR)


class MqttPublisher:
    """Publisher of a vehicle's topics, and receiver of its commands.

    `on_event(code, text)` receives `mqtt_connected`, `mqtt_lost`, `mqtt_absent` (once an outage),
    `mqtt_flooded`, `client_name_taken`, `mqtt_command_failed` and `mqtt_password_exposed`.
    `on_command` executes a configured command; without it, or without configured commands, nothing
    is subscribed. `utc_now` (ns, None if unknown) dates the replies.

    `counters`: `mqtt_published`; `mqtt_dropped` (replaced by a newer one, pushed out of the full
    event queue, or lost with a connection); `mqtt_reconnects`; `mqtt_taken_over`, connections lost
    to another client of our name; `mqtt_flooded`, messages for us that were dropped unread; those
    of `CommandIntake`. `status` is for `health`.

    Raises `ConfigError` for a password file or TLS files that cannot be used.
    """

    name = "mqtt"
    sets_clocks = False

    def __init__(
        self,
        options: Mqtt,
        vehicle: str,
        *,
        on_event: Callable[[str, str], None],
        on_command: Handler | None = None,
        utc_now: Callable[[], int | None] = lambda: None,
    ) -> None:
        self._options = options
        self.nav_rate_hz = options.nav_rate_hz
        self._base = base_topic(vehicle)
        self._addresses: dict[Topic, str] = {}
        self._online = f"{self._base}/online"
        # The name is the same at each start: if we reconnect before the broker has noticed the end
        # of the old connection, it closes the old one and publishes its will before our new
        # `online`.
        self._client_id = options.client_id or f"fusiond-{vehicle}"
        self._password = broker_access.password(options)
        self._tls = broker_access.tls_context(options)
        self._on_event = on_event
        self._confirm_s = max(1.0, options.keepalive_s / 2)
        self._heartbeat_s = options.keepalive_s / 4
        self._latest: dict[Topic, BaseModel] = {}
        self._queue: deque[tuple[Topic, BaseModel]] = deque(maxlen=options.queue)
        # Latest messages of the topics that are retained and confirmed, and those still to be sent.
        self._retained: dict[Topic, BaseModel] = {}
        self._due: dict[Topic, None] = {}
        self._events: deque[EventMessage] = deque(maxlen=MOST_KEPT)
        self._listeners: dict[str, Callable[[bytes], None]] = {}
        self._latest_ready = asyncio.Event()
        self._confirmed_ready = asyncio.Event()
        self._flowing = asyncio.Event()
        self.counters: Counter[str] = Counter()
        self._commands: CommandIntake | None = None
        if on_command is not None and options.commands:
            self._commands = CommandIntake(
                options.commands, on_command, self.counters, on_event, utc_now
            )
        self._replying: set[asyncio.Task[None]] = set()
        self.on_confirmed: Callable[[BaseModel], None] = lambda message: None
        """Callback with each queued message that the broker has confirmed."""
        self._reconnecting = Reconnecting()
        self._version = MqttVersion(MAX_PAYLOAD_BYTES + oversized_packets.LONGEST_TOPIC)
        self._quiet = incoming_publications.quiet()
        self.status = DriverStatus()

    def begin_with_3_1_1(self) -> None:
        """Try MQTT 3.1.1 first: for a broker that is known not to reply to version 5."""
        self._version.is_5 = False

    # ------------------------------------------------------------------ for the tick

    def listen(self, address: str, listener: Callable[[bytes], None]) -> None:
        """Subscribe `listener` to others' publications at `address`; call before `run`."""
        self._listeners[address] = listener

    def publish(self, topic: Topic, message: BaseModel) -> None:
        """Store a message for sending. With QoS 0 only the latest is sent; a retained one is
        confirmed, and sent again after each connection; all others are queued."""
        if topic.qos == 0:
            self._replace(topic, message)
        elif topic.retained:
            self._retain(topic, message)
        else:
            self._enqueue(topic, message)
        if isinstance(message, EventMessage):
            self._keep_event(message)

    def _replace(self, topic: Topic, message: BaseModel) -> None:
        self.counters["mqtt_dropped"] += topic in self._latest
        self._latest[topic] = message
        self._latest_ready.set()

    def _retain(self, topic: Topic, message: BaseModel) -> None:
        self.counters["mqtt_dropped"] += topic in self._due
        self._retained[topic] = message
        self._due[topic] = None
        self._confirmed_ready.set()

    def _enqueue(self, topic: Topic, message: BaseModel) -> None:
        self.counters["mqtt_dropped"] += len(self._queue) == self._queue.maxlen
        self._queue.append((topic, message))
        self._confirmed_ready.set()

    def _keep_event(self, message: EventMessage) -> None:
        """Retain the last events for later subscribers; further events may join before they are
        sent."""
        self._events.append(message)
        self._retained[EVENTS] = events_message(tuple(self._events))
        self._due[EVENTS] = None

    # ------------------------------------------------------------------ the connection

    async def run(self) -> None:
        """Keep a connection until cancelled; then publish `offline` and disconnect."""
        if broker_access.readable_by_all(self._options.password_file):
            path = self._options.password_file
            self._on_event("mqtt_password_exposed", f"{path} is readable by all: chmod 600 {path}")
        connected_before = False
        loop = asyncio.get_running_loop()
        while True:
            client = self._client()
            try:
                async with client:
                    honour_cancellation()
                    self._version.connected()
                    client.timeout = self._confirm_s
                    since_s = loop.time()
                    self.counters["mqtt_reconnects"] += connected_before
                    connected_before = True
                    where = f"{self._options.host}:{self._options.port}"
                    self.status = DriverStatus("running", where)
                    self._on_event("mqtt_connected", where)
                    reason = await self._serve(client)
                self._on_event("mqtt_lost", reason)
                self.status = DriverStatus("absent", reason)
                self._look_for_a_rival(loop.time() - since_s, _OVERDUE not in reason)
            except aiomqtt.MqttError as error:
                if self._version.failed(error):
                    continue
                self._reconnecting.failed()
                why = broker_access.advice(error, self._options.host, self._options.port)
                if self.status.state != "absent":
                    self._on_event("mqtt_absent", why)
                self.status = DriverStatus("absent", why)
            finally:
                hang_up(client)
            honour_cancellation()
            await asyncio.sleep(self._reconnecting.wait_s())

    def _look_for_a_rival(self, lasted_s: float, by_broker: bool) -> None:
        newly = self._reconnecting.ended(lasted_s, by_broker)
        if not self._reconnecting.taken:
            return
        text = f"another client has the name {self._client_id!r} at the broker"
        self.status = DriverStatus("absent", text)
        self.counters["mqtt_taken_over"] += by_broker
        if newly:
            what = "give each daemon a 'vehicle' or a mqtt.client_id of its own"
            self._on_event("client_name_taken", f"{text}: {what}; trying again seldom")

    def _client(self) -> aiomqtt.Client:
        options = self._options
        client = self._version.client(
            options.host,
            options.port,
            username=options.username,
            password=self._password,
            identifier=self._client_id,
            will=aiomqtt.Will(self._online, b"offline", qos=1, retain=True),
            keepalive=options.keepalive_s,
            timeout=self._confirm_s,
            max_queued_incoming_messages=_INCOMING,
            logger=_LOG,
            tls_context=self._tls,
            socket_options=oversized_packets.SOCKET_OPTIONS,
        )
        oversized_packets.limit(client, MAX_PAYLOAD_BYTES)
        write_directly(client)
        return client

    async def _serve(self, client: aiomqtt.Client) -> str:
        """Send and receive until the connection fails; return the reason."""
        self._flowing.set()
        # No TaskGroup: that of Python 3.11 leaves its parent marked as cancelled.
        tasks = [
            asyncio.create_task(self._listen(client)),
            asyncio.create_task(self._receive(client)),
            asyncio.create_task(self._send_confirmed(client)),
            asyncio.create_task(self._send_latest(client)),
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:
            await end(tasks)
            try:
                await asyncio.wait_for(self._say_farewell(client), FAREWELL_S)
            except (aiomqtt.MqttError, TimeoutError):
                await abandon(client)
            raise
        errors = await end(tasks)
        await abandon(client)
        for error in errors:
            if not isinstance(error, aiomqtt.MqttError):
                raise error
        return str(errors[0])

    async def _say_farewell(self, client: aiomqtt.Client) -> None:
        self._due = dict.fromkeys(self._retained)
        await self._send_waiting(client)
        await self._publish(client, self._online, b"offline", qos=1, retain=True)

    # ------------------------------------------------------------------ sending

    def _address(self, topic: Topic) -> str:
        """Address at the broker."""
        found = self._addresses.get(topic)
        if found is None:
            found = self._addresses[topic] = topic.address(self._base)
        return found

    async def _publish(
        self, client: aiomqtt.Client, address: str, payload: bytes, qos: int, retain: bool
    ) -> None:
        await client.publish(address, payload, qos=qos, retain=retain)
        self.counters["mqtt_published"] += 1
        honour_cancellation()

    async def _send_latest(self, client: aiomqtt.Client) -> None:
        while True:
            await self._latest_ready.wait()
            await self._flowing.wait()
            self._latest_ready.clear()
            while self._latest and self._flowing.is_set():
                topic = next(iter(self._latest))
                payload = _encoded(self._latest.pop(topic))
                try:
                    address = self._address(topic)
                    await self._publish(client, address, payload, topic.qos, topic.retained)
                except aiomqtt.MqttError:
                    self.counters["mqtt_dropped"] += 1
                    raise
            if self._latest:
                self._latest_ready.set()

    async def _send_confirmed(self, client: aiomqtt.Client) -> None:
        await self._confirm(client, self._online, b"online", retain=True)
        self._due = dict.fromkeys(self._retained)
        while True:
            await self._send_waiting(client)
            self._confirmed_ready.clear()
            try:
                async with asyncio.timeout(self._heartbeat_s):
                    await self._confirmed_ready.wait()
            except TimeoutError:
                if STATUS in self._retained:
                    self._due[STATUS] = None
                else:
                    await self._confirm(client, self._online, b"online", retain=True)

    async def _send_waiting(self, client: aiomqtt.Client) -> None:
        """Send the due retained messages and all queued ones; a queued one that fails stays
        queued."""
        while self._due or self._queue:
            if self._due:
                topic = next(iter(self._due))
                del self._due[topic]
                payload = _encoded(self._retained[topic])
                await self._confirm(client, self._address(topic), payload, topic.retained)
            if self._queue:
                first = self._queue[0]
                topic, queued = first
                address = self._address(topic)
                await self._confirm(client, address, _encoded(queued), topic.retained)
                if self._queue and self._queue[0] is first:
                    self._queue.popleft()
                    self.on_confirmed(queued)

    async def _confirm(
        self, client: aiomqtt.Client, address: str, payload: bytes, retain: bool
    ) -> None:
        """Publish with QoS 1; QoS 0 messages stop while the confirmation is overdue."""
        loop = asyncio.get_running_loop()
        overdue = loop.call_later(_TIMEOUT_S, self._flowing.clear)
        try:
            await self._publish(client, address, payload, qos=1, retain=retain)
        finally:
            overdue.cancel()
        self._flowing.set()

    # ------------------------------------------------------------------ commands

    async def _listen(self, client: aiomqtt.Client) -> None:
        """Keep the subscriptions; pause them for a while after a flood."""
        addresses = [*self._listeners]
        if self._commands is not None:
            addresses.append(f"{self._base}/cmd/+")
        coming = incoming_publications.Incoming(client, self.counters, self._quiet)
        while True:
            for address in addresses:
                await self._version.subscribe(client, address)
                honour_cancellation()
            quiet_s = await coming.flood()
            await client.unsubscribe(addresses)
            honour_cancellation()
            most = f"{incoming_publications.MESSAGES.per_s:.0f} a second"
            text = f"more messages for the daemon than {most}: not listening for {quiet_s:.0f} s"
            self._on_event("mqtt_flooded", text)
            await asyncio.sleep(quiet_s)
            coming.over()

    async def _receive(self, client: aiomqtt.Client) -> None:
        """Answer commands; raises `MqttError` when the connection ends."""
        prefix = f"{self._base}/cmd/"
        async for message in client.messages:
            payload = message.payload
            if not isinstance(payload, bytes):
                continue
            listener = self._listeners.get(message.topic.value)
            if listener is not None:
                listener(payload)
            elif self._commands is not None:
                name = message.topic.value.removeprefix(prefix)
                reply = self._commands.answer(name, payload, message.retain)
                if isinstance(reply, ReplyMessage):
                    self._enqueue(REPLY, reply)
                elif reply is not None:
                    self._reply_later(reply)

    def _reply_later(self, reply: Coroutine[None, None, ReplyMessage]) -> None:
        """Queue a reply once its result is known, whichever connection exists then."""

        async def wait() -> None:
            self._enqueue(REPLY, await reply)

        task = asyncio.create_task(wait())
        self._replying.add(task)
        task.add_done_callback(self._replying.discard)


def _encoded(message: BaseModel) -> bytes:
    return message.model_dump_json().encode()
