"""Commands on `cmd/<name>`: what may be asked of the daemon over MQTT, and how it is checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

MAX_PAYLOAD_BYTES = 4096
"""The longest command is some 200 bytes; what is larger is refused unread."""


class Command(BaseModel):
    """Base of every command. `id` is the sender's own and comes back in the reply."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    id: Annotated[str, Field(min_length=1, max_length=64)]


class SetPosition(Command):
    """Where the vehicle is: WGS 84, height above the ellipsoid; one sigma per horizontal axis.

    It is fused like any fix, and gated like one; with `force` the filter is reset and aligns anew
    from it.
    """

    lat_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    lon_deg: Annotated[float, Field(ge=-180.0, le=180.0)]
    height_m: Annotated[float, Field(ge=-1000.0, le=100_000.0)]
    sd_m: Annotated[float, Field(gt=0.0, le=100_000.0)]
    force: bool = False


class RequestFix(Command):
    """Ask the RDSS terminal for a fix as soon as its service frequency allows."""


class ResetFilter(Command):
    """Forget the navigation state and align again."""


COMMANDS: dict[str, type[Command]] = {
    "set_position": SetPosition,
    "request_fix": RequestFix,
    "reset_filter": ResetFilter,
}

Handler = Callable[[Command], str]
"""Carries a command out at once and says what was done, or raises `CommandRefusedError`."""


class CommandRefusedError(Exception):
    """The command is well formed but cannot be carried out; the text goes into the reply."""


class BadCommandError(ValueError):
    """The payload is no such command; `id` is the request's if it could be read."""

    def __init__(self, text: str, id: str | None = None) -> None:
        super().__init__(text)
        self.id = id


class _Id(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True)
    id: Annotated[str, Field(max_length=64)]


def parse(name: str, payload: bytes) -> Command:
    """The command `name` of a JSON payload. Raises `BadCommandError` for anything else."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise BadCommandError(f"{len(payload)} bytes, at most {MAX_PAYLOAD_BYTES} are read")
    try:
        return COMMANDS[name].model_validate_json(payload)
    except ValidationError as error:
        text = "; ".join(
            f"{'.'.join(map(str, e['loc'])) or 'payload'}: {e['msg']}" for e in error.errors()[:5]
        )
    try:
        request_id = _Id.model_validate_json(payload).id
    except ValidationError:
        request_id = None
    raise BadCommandError(text, request_id)
