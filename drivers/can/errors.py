"""Error frames of a CAN controller: Linux `include/uapi/linux/can/error.h`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

ControllerState = Literal["active", "warning", "passive", "bus_off"]

ERROR_CLASSES = {
    0x001: "tx_timeout",
    0x002: "lost_arbitration",
    0x004: "controller",
    0x008: "protocol",
    0x010: "transceiver",
    0x020: "no_acknowledge",
    0x040: "bus_off",
    0x080: "bus_error",
    0x100: "restarted",
    0x200: "error_counters",
}
"""CAN_ERR_* classes of the identifier of an error frame; counted as `error_<name>`."""
_CONTROLLER, _BUS_OFF, _RESTARTED = 0x004, 0x040, 0x100
_OVERFLOW, _WARNING, _PASSIVE, _ACTIVE = 0x03, 0x0C, 0x30, 0x40  # CAN_ERR_CRTL_*, data[1]


def error_names(error_classes: int, data: bytes) -> Iterator[str]:
    """Names of the classes of an error frame, and `overflow` if the controller lost frames."""
    for bit, name in ERROR_CLASSES.items():
        if error_classes & bit:
            yield name
    if error_classes & _CONTROLLER and len(data) > 1 and data[1] & _OVERFLOW:
        yield "overflow"


def controller_state(error_classes: int, data: bytes) -> ControllerState | None:
    """State of the controller by an error frame; None for other errors."""
    if error_classes & _BUS_OFF:
        return "bus_off"
    if error_classes & _RESTARTED:
        return "active"
    if error_classes & _CONTROLLER and len(data) > 1:
        if data[1] & _PASSIVE:
            return "passive"
        if data[1] & _WARNING:
            return "warning"
        if data[1] & _ACTIVE:
            return "active"
    return None
