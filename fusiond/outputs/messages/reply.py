"""Message `reply`: the result of a command."""

from __future__ import annotations

from fusiond.outputs.messages.base import Message


class ReplyMessage(Message):
    """The answer to a command; `id` is the request's, null if it could not be read."""

    id: str | None
    command: str
    ok: bool
    text: str
