"""Frames as sockets give them: `can_frame` of Linux, datagrams of python-can's `udp_multicast`.

`struct can_frame` and `struct canfd_frame` are those of Linux `include/uapi/linux/can.h`. A
datagram holds one frame as a map of msgpack. An ordinary data frame is taken as it is, at a sixth
of the cost of python-can's `Message`; anything else is python-can's to judge.
"""

from __future__ import annotations

import importlib
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

CANFD_BYTES, DATAGRAM_BYTES = 72, 4096
"""Largest frame of a raw CAN socket, and largest datagram, as in python-can."""
EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 0x8000_0000, 0x4000_0000, 0x2000_0000
_FRAME = struct.Struct("=IB3x")
_CLASSIC_BYTES = 8
_NAMES = {
    *("timestamp", "arbitration_id", "is_extended_id", "is_remote_frame", "is_error_frame"),
    *("channel", "dlc", "data", "is_fd", "bitrate_switch", "error_state_indicator"),
}


class Content(NamedTuple):
    """Frame without its instants: identifier, whether it is extended, data, and whether it is a
    remote or an error frame."""

    can_id: int
    extended: bool
    data: bytes
    remote: bool = False
    error: bool = False


Decode = Callable[[bytes], Content]


def of_can_frame(raw: bytes) -> Content:
    """Decode a `can_frame` or a `canfd_frame`."""
    can_id, length = _FRAME.unpack_from(raw)
    data = raw[_FRAME.size : _FRAME.size + length]
    if not can_id & (EXTENDED_FLAG | REMOTE_FLAG | ERROR_FLAG):
        return Content(can_id & 0x7FF, False, data)
    extended, error = bool(can_id & EXTENDED_FLAG), bool(can_id & ERROR_FLAG)
    number = can_id & (0x1FFF_FFFF if extended or error else 0x7FF)
    return Content(number, extended, data, bool(can_id & REMOTE_FLAG), error)


def datagram_decoder() -> Decode:
    """Make the decoder of datagrams; it raises what python-can raises for no frame."""
    unpack: Callable[[bytes], Any] = importlib.import_module("msgpack").unpackb
    judge = importlib.import_module("can.interfaces.udp_multicast.utils").unpack_message

    def of_datagram(datagram: bytes) -> Content:
        try:
            entry = unpack(datagram)
            can_id, extended = entry["arbitration_id"], entry["is_extended_id"]
            data = entry["data"]
            ordinary = (
                entry.keys() == _NAMES
                and type(can_id) is int
                and type(extended) is bool
                and type(data) is bytes
                and 0 <= can_id < (0x2000_0000 if extended else 0x800)
                and entry["dlc"] == len(data) <= _CLASSIC_BYTES
                and entry["is_remote_frame"] is False
                and entry["is_error_frame"] is False
                and entry["bitrate_switch"] is False
                and entry["error_state_indicator"] is False
            )
        except Exception:  # whatever msgpack raises, or a structure of another kind
            ordinary = False
        if ordinary:
            return Content(can_id, extended, data)
        message = judge(datagram, replace={"timestamp": 0.0}, check=True)
        return Content(
            message.arbitration_id,
            message.is_extended_id,
            bytes(message.data),
            message.is_remote_frame,
            message.is_error_frame,
        )

    return of_datagram
