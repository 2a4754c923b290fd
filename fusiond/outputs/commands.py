"""Commands on `cmd/<name>` over MQTT, and their checks."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

MAX_PAYLOAD_BYTES = 4096
"""The longest command has some 200 bytes; larger ones are refused unread."""


class Command(BaseModel):
    """Base of every command. The sender chooses `id`; the reply repeats it."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    id: Annotated[str, Field(min_length=1, max_length=64)]


class SetPosition(Command):
    """Position of the vehicle: WGS 84, height above the ellipsoid; one sigma per horizontal axis.

    It is gated and fused like any fix; with `force` the filter restarts its alignment from it.
    """

    lat_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    lon_deg: Annotated[float, Field(ge=-180.0, le=180.0)]
    height_m: Annotated[float, Field(ge=-1000.0, le=100_000.0)]
    sd_m: Annotated[float, Field(gt=0.0, le=100_000.0)]
    force: bool = False


class RequestFix(Command):
    """Request an RDSS fix as soon as the service frequency allows."""


class SendMessage(Command):
    """Send a text to another card by the RDSS terminal.

    With `receipt` the receiving fusiond confirms it, and it is sent again until confirmed: see
    `docs/rdss-messages.md`. `source` names the terminal, if there are several.
    """

    card: Annotated[int, Field(ge=1, le=9_999_999)]
    text: Annotated[str, Field(min_length=1, max_length=210)]
    receipt: bool = False
    source: Annotated[str, Field(min_length=1, max_length=64)] | None = None


class ResetFilter(Command):
    """Forget the navigation state and align again."""


class StartRecording(Command):
    """Record from now on, into `recording.directory`."""


class StopRecording(Command):
    """Finish the log that is being written."""


class Inject(Command):
    """Falsify a source's measurements for a time, to test the reaction; never on the road.

    `drop`: nothing comes. `delay`: everything comes `size` s later. `jump`, `drift`, `noise`: an
    error of `size`, of `size` a second, or of one sigma `size`, in the measurement's unit: m of a
    position (towards `direction_deg`, clockwise from north) or height, m/s of a speed, deg of a
    heading, attitude (yaw) or bearing (azimuth); of an IMU deg/s (`gyro`) or m/s^2 (`accel`) of the
    sensor's `axis`. `freeze`: the values of the first measurement come again and again.
    """

    source: Annotated[str, Field(min_length=1, max_length=64)]
    fault: Literal["drop", "delay", "jump", "freeze", "drift", "noise"]
    duration_s: Annotated[float, Field(gt=0.0, le=3600.0)]
    size: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    direction_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 0.0
    part: Literal["gyro", "accel"] = "gyro"
    axis: Literal["x", "y", "z"] = "z"

    @model_validator(mode="after")
    def _sized(self) -> Inject:
        if self.fault in ("delay", "jump", "drift", "noise") and self.size == 0.0:
            raise ValueError(f"{self.fault} needs a size")
        if self.fault in ("delay", "noise") and self.size < 0.0:
            raise ValueError(f"the size of {self.fault} is positive")
        return self


class SetGates(Command):
    """Gates of a reloaded configuration; internal, not a command of MQTT."""

    gates: dict[str, Annotated[float, Field(gt=0.0, lt=1.0)]]
    """`gate_probability` by section of `aiding`."""


COMMANDS: dict[str, type[Command]] = {
    "set_position": SetPosition,
    "request_fix": RequestFix,
    "send_message": SendMessage,
    "reset_filter": ResetFilter,
    "start_recording": StartRecording,
    "stop_recording": StopRecording,
    "inject": Inject,
}
"""Commands from outside."""
CARRIED_OUT: dict[str, type[Command]] = {**COMMANDS, "set_gates": SetGates}
"""Commands that a recording holds, and a replay carries out again."""
NAMES = {command: name for name, command in CARRIED_OUT.items()}

Handler = Callable[[Command], str | Awaitable[str]]
"""Function that carries out a command.

It returns a description of the result, or raises `CommandRefusedError`; a reply that waits for a
disk comes later."""


class CommandRefusedError(Exception):
    """Error of a valid command that cannot be executed; its text goes into the reply."""


class BadCommandError(ValueError):
    """Error of a payload that is no valid command; `id` is the sender's, if readable."""

    def __init__(self, text: str, id: str | None = None) -> None:
        super().__init__(text)
        self.id = id


class _Id(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True)
    id: Annotated[str, Field(max_length=64)]


def parse(name: str, payload: bytes) -> Command:
    """Parse a JSON payload as the command `name`. Raises `BadCommandError` for anything else."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        # The end of an oversized packet is missing (outputs.oversized_packets).
        text = f"{len(payload)} bytes or more, at most {MAX_PAYLOAD_BYTES} are read"
        raise BadCommandError(text)
    try:
        return COMMANDS[name].model_validate_json(payload)
    except ValidationError as error:
        text = "; ".join(
            f"{'.'.join(map(str, e['loc'])) or 'payload'}: {e['msg']}" for e in error.errors()[:5]
        )
    raise BadCommandError(text, request_id(payload))


def request_id(payload: bytes) -> str | None:
    """Sender's `id` in any payload, if readable."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        return None
    try:
        return _Id.model_validate_json(payload).id
    except ValidationError:
        return None
