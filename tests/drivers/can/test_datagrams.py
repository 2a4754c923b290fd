"""Frames of `udp_multicast` are read as python-can reads them, and so is what is none."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message, unpack_message
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.datagrams import BadDatagramError, Fields, fields_of


@st.composite
def _messages(draw: st.DrawFn) -> can.Message:
    extended, remote = draw(st.booleans()), draw(st.booleans())
    size = draw(st.sampled_from((*range(9), 12, 64)))
    return can.Message(
        arbitration_id=draw(st.integers(0, (1 << 29 if extended else 1 << 11) - 1)),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=not remote and draw(st.booleans()),
        is_fd=size > 8 and not remote,
        data=None if remote else draw(st.binary(min_size=size, max_size=size)),
        dlc=min(size, 8) if remote else size,
        timestamp=draw(st.floats(0.0, 2e9)),
    )


@given(_messages())
def test_a_message_comes_out_as_python_can_has_it(message: can.Message) -> None:
    datagram = pack_message(message)
    theirs = unpack_message(datagram)
    assert fields_of(datagram) == Fields(
        theirs.arbitration_id,
        theirs.is_extended_id,
        bytes(theirs.data),
        theirs.is_remote_frame,
        theirs.is_error_frame,
    )


@given(st.binary(max_size=200))
def test_any_bytes_are_a_frame_or_refused(datagram: bytes) -> None:
    with suppress(BadDatagramError):
        fields_of(datagram)


@pytest.mark.parametrize(
    "wrong",
    [
        {"arbitration_id": 1 << 11},
        {"arbitration_id": -1},
        {"arbitration_id": 1.5},
        {"arbitration_id": True},
        {"is_extended_id": 1},
        {"is_remote_frame": True, "is_error_frame": True},
        {"data": "text"},
        {"data": bytes(65)},
        {"data": None},
    ],
)
def test_what_no_bus_carries_is_refused(wrong: dict[str, Any]) -> None:
    sound = msgpack.unpackb(pack_message(can.Message(arbitration_id=5, is_extended_id=False)))
    assert fields_of(msgpack.packb(sound)) == Fields(5, False, b"", False, False)
    with pytest.raises(BadDatagramError):
        fields_of(msgpack.packb(sound | wrong))
