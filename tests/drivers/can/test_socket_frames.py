"""Frames off sockets, against python-can's own reading of them."""

from __future__ import annotations

import struct

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from drivers.can.socket_frames import Content, datagram_decoder, of_can_frame

MESSAGES = (
    can.Message(arbitration_id=0x7FF, is_extended_id=False, data=bytes(8)),
    can.Message(arbitration_id=0x1FFF_FFFF, data=b"\x01\x02"),
    can.Message(arbitration_id=5, is_extended_id=False),
    can.Message(arbitration_id=5, is_remote_frame=True, dlc=3),
    can.Message(arbitration_id=4, is_error_frame=True, is_extended_id=False, data=bytes(8)),
    can.Message(arbitration_id=6, is_fd=True, bitrate_switch=True, data=bytes(64)),
)
FIELDS = msgpack.unpackb(pack_message(MESSAGES[0]))


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: f"{m.arbitration_id:x}")
def test_a_datagram_is_what_python_can_reads_of_it(message: can.Message) -> None:
    datagram = pack_message(message)
    theirs = unpack_message(datagram, check=True)
    assert datagram_decoder()(datagram) == Content(
        theirs.arbitration_id,
        theirs.is_extended_id,
        bytes(theirs.data),
        theirs.is_remote_frame,
        theirs.is_error_frame,
    )


@pytest.mark.parametrize(
    "wrong",
    [
        {"arbitration_id": 0x800},
        {"arbitration_id": -1},
        {"dlc": 7},
        {"dlc": 9, "data": bytes(9)},
        {"bitrate_switch": True},
        {"error_state_indicator": True},
        {"arbitration_id": 0x2000_0000, "is_extended_id": True},
        {"is_remote_frame": True, "is_error_frame": True},
        {"speed": 5},
    ],
    ids=str,
)
def test_what_python_can_refuses_is_refused(wrong: dict[str, object]) -> None:
    datagram = msgpack.packb({**FIELDS, **wrong})
    with pytest.raises((TypeError, ValueError)):
        unpack_message(datagram, check=True)
    with pytest.raises((TypeError, ValueError)):
        datagram_decoder()(datagram)


@pytest.mark.parametrize("junk", [b"", b"\xff" * 40, b"\x81", b"not a frame", b"\x90", b"\xc0"])
def test_no_frame_is_refused(junk: bytes) -> None:
    with pytest.raises((AttributeError, TypeError, ValueError)):
        datagram_decoder()(junk)


@pytest.mark.parametrize(
    ("can_id", "frame"),
    [
        (0x123, Content(0x123, False, b"ab")),
        (0x8000_0123, Content(0x123, True, b"ab")),
        (0x4000_0123, Content(0x123, False, b"ab", remote=True)),
        (0x2000_0004, Content(0x4, False, b"ab", error=True)),
        (0xC000_0004, Content(0x4, True, b"ab", remote=True)),
    ],
)
def test_a_frame_of_a_raw_socket(can_id: int, frame: Content) -> None:
    assert of_can_frame(struct.pack("=IB3x8s", can_id, 2, b"ab")) == frame
