"""Frames out of the datagrams of python-can's `udp_multicast`: a message's fields in msgpack.

python-can's own `recv` asks the kernel twice, makes a `Message` and checks it: six times the cost,
3 % of a core for an IMU of 600 frames/s.

Source: python-can 4.6, can/interfaces/udp_multicast/utils.py; `can.Message` for what is possible.
"""

from __future__ import annotations

from typing import Any, NamedTuple

LONGEST = 4096
"""Bytes, as python-can has it."""
_MOST_DATA = 64
_MOST_ID = {False: 1 << 11, True: 1 << 29}


class BadDatagramError(ValueError):
    """It is no frame."""


class Fields(NamedTuple):
    """Of a frame, as `drivers.can.bus.CanFrame` has them."""

    can_id: int
    extended: bool
    data: bytes
    remote: bool
    error: bool


def fields_of(datagram: bytes) -> Fields:
    """Fields of a frame. Raises `BadDatagramError`."""
    import msgpack  # noqa: PLC0415 - the driver has looked for it

    try:
        said: Any = msgpack.unpackb(datagram)
        can_id, data = said["arbitration_id"], said["data"]
        extended, remote = said["is_extended_id"], said["is_remote_frame"]
        error = said["is_error_frame"]
    except (ValueError, TypeError, KeyError, msgpack.UnpackException) as fault:
        raise BadDatagramError(str(fault)) from fault
    flags = type(extended) is type(remote) is type(error) is bool
    if not flags or type(can_id) is not int or type(data) is not bytes:
        raise BadDatagramError("a field of another type")
    if not 0 <= can_id < _MOST_ID[extended] or len(data) > _MOST_DATA or (remote and error):
        raise BadDatagramError("no frame of any bus")
    return Fields(can_id, extended, b"" if remote else data, remote, error)
