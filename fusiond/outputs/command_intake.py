"""Commands from the broker: rate limit, permission and reply.

A token bucket limits the rate: it holds `BURST` tokens, gains `RATE_HZ` a second, and a command
takes one. A command without a token is not parsed. The first such command is answered, the next
ones are not, until the bucket is full again. Commands run in the event loop of the tick; so an
excess command costs an addition and a comparison only.

A command is executed once, although MQTT's QoS 1 may deliver it twice, and bridges or scripts may
repeat it: a name and id that were executed are refused. So are retained commands, which a broker
delivers, marked, at each subscription. It delivers a retained command unmarked to a client that is
already subscribed; that one is executed, and refused when it comes again.
"""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import Awaitable, Callable, Coroutine

from fusiond.outputs.commands import (
    COMMANDS,
    BadCommandError,
    CommandRefusedError,
    Handler,
    parse,
    request_id,
)
from fusiond.outputs.messages.base import stamp
from fusiond.outputs.messages.reply import ReplyMessage

# Enough for a person who clicks, and for a script that sends a screenful at once.
RATE_HZ = 5.0
BURST = 20.0
REMEMBERED = 1000
"""Remembered command ids: those of 200 s at the highest rate; 100 kB."""
# Characters of an unknown command's name in the reply; the longest known name has 13.
_NAME_SHOWN = 40
Answer = ReplyMessage | Coroutine[None, None, ReplyMessage]
"""Reply to a command: immediate, or once its result is on disk."""


class CommandIntake:
    """Executor of commands; `allowed` are those that the configuration lists.

    `counters`: `mqtt_commands`, `mqtt_commands_limited`, `mqtt_commands_refused`, and of these
    `mqtt_commands_repeated` and `mqtt_commands_retained`. `on_event` receives
    `mqtt_command_failed`, `now` is monotonic, s.
    """

    def __init__(
        self,
        allowed: tuple[str, ...],
        handler: Handler,
        counters: Counter[str],
        on_event: Callable[[str, str], None],
        utc_now: Callable[[], int | None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._allowed = allowed
        self._handler = handler
        self._counters = counters
        self._on_event = on_event
        self._utc_now = utc_now
        self._now = now
        self._tokens, self._filled_s = BURST, now()
        self._limiting = False
        self._done: OrderedDict[tuple[str, str], None] = OrderedDict()

    def answer(self, name: str, payload: bytes, retained: bool) -> Answer | None:
        """Execute the command and return the reply; None for an excess command that gets none."""
        now_s = self._now()
        self._tokens = min(BURST, self._tokens + RATE_HZ * (now_s - self._filled_s))
        self._filled_s = now_s
        if self._tokens >= 1.0:
            self._limiting = self._limiting and self._tokens < BURST
            self._tokens -= 1.0
            return self._answer(name, payload, retained)
        self._counters["mqtt_commands_limited"] += 1
        if self._limiting:
            return None
        self._limiting = True
        text = f"too many commands: {RATE_HZ:.0f} a second are executed, others get no reply"
        return self._reply(name, None, False, text)

    def _answer(self, name: str, payload: bytes, retained: bool) -> Answer:
        sent_id: str | None = None
        ok = False
        try:
            if name not in COMMANDS:
                raise BadCommandError(f"no such command; there are {', '.join(COMMANDS)}")
            if retained:
                self._counters["mqtt_commands_retained"] += 1
                raise BadCommandError("commands must not be retained", request_id(payload))
            command = parse(name, payload)
            sent_id = command.id
            if name not in self._allowed:
                raise CommandRefusedError("not listed in mqtt.commands of the configuration")
            if (name, sent_id) in self._done:
                self._counters["mqtt_commands_repeated"] += 1
                text = (
                    "already executed under this id: nothing done; use a new id for a new command"
                )
                raise CommandRefusedError(text)
            said = self._handler(command)
            ok = True
            self._remember(name, sent_id)
            if not isinstance(said, str):
                self._counters["mqtt_commands"] += 1
                return self._later(name, sent_id, said)
            text = said
        except BadCommandError as error:
            sent_id, text = error.id, str(error)
        except CommandRefusedError as error:
            text = str(error)
        except Exception as error:  # a bug of ours must not end the connection
            text = f"failed: {error!r}"
            self._on_event("mqtt_command_failed", f"{name}: {error!r}")
        self._counters["mqtt_commands" if ok else "mqtt_commands_refused"] += 1
        return self._reply(name, sent_id, ok, text)

    async def _later(self, name: str, sent_id: str, said: Awaitable[str]) -> ReplyMessage:
        try:
            return self._reply(name, sent_id, True, await said)
        except Exception as error:  # a bug of ours must not end the connection
            self._on_event("mqtt_command_failed", f"{name}: {error!r}")
            return self._reply(name, sent_id, False, f"failed: {error!r}")

    def _remember(self, name: str, sent_id: str) -> None:
        self._done[name, sent_id] = None
        if len(self._done) > REMEMBERED:
            self._done.popitem(last=False)

    def _reply(self, name: str, sent_id: str | None, ok: bool, text: str) -> ReplyMessage:
        t_utc, t_ms = stamp(self._utc_now())
        return ReplyMessage(
            t_utc=t_utc, t_ms=t_ms, id=sent_id, command=name[:_NAME_SHOWN], ok=ok, text=text
        )
