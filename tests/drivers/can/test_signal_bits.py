"""Bits out of frames, judged by cantools, which decodes a whole message at every frame."""

from __future__ import annotations

import math

import cantools
import pytest
from cantools.database.can import Message
from cantools.database.can.signal import Signal
from cantools.database.conversion import BaseConversion
from cantools.database.errors import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.signal_bits import AbsentSignalError, Layout

MULTIPLEXED = """VERSION ""
BU_: X
BO_ 256 M: 8 X
 SG_ PAGE M : 0|4@1+ (1,0) [0|0] "" X
 SG_ ALWAYS : 4|4@1+ (1,0) [0|0] "" X
 SG_ INNER m1M : 15|8@0+ (1,0) [0|0] "" X
 SG_ FIRST m0 : 16|12@1- (1,0) [0|0] "" X
 SG_ SECOND m1 : 31|16@0- (1,0) [0|0] "" X
 SG_ DEEP m3 : 40|16@1- (1,0) [0|0] "" X
 SG_MUL_VAL_ 256 INNER PAGE 1-1;
 SG_MUL_VAL_ 256 FIRST PAGE 0-0, 5-7;
 SG_MUL_VAL_ 256 SECOND PAGE 1-1;
 SG_MUL_VAL_ 256 DEEP INNER 3-3;
"""


@st.composite
def signals(draw: st.DrawFn) -> tuple[Signal, int]:
    """A signal that lies within a message, and that message's length."""
    length = draw(st.integers(1, 12))
    floating = draw(st.booleans()) and length >= 2
    size = draw(st.sampled_from([n for n in (16, 32, 64) if n <= 8 * length])) if floating else 0
    size = size or draw(st.integers(1, min(64, 8 * length)))
    first = draw(st.integers(0, 8 * length - size))
    big = draw(st.booleans())
    signal = Signal(
        "S",
        start=8 * (first // 8) + 7 - first % 8 if big else first,
        length=size,
        byte_order="big_endian" if big else "little_endian",
        is_signed=draw(st.booleans()),
        conversion=BaseConversion.factory(is_float=floating),
    )
    return signal, length


@given(signals(), st.data())
def test_any_signal_as_cantools_has_it(drawn: tuple[Signal, int], data: st.DataObject) -> None:
    signal, length = drawn
    frame = data.draw(st.binary(min_size=length, max_size=length + 2))
    message = Message(1, "M", length, [signal])
    wanted = message.decode(frame, decode_choices=False, scaling=False)["S"]
    (found,) = Layout(message, ["S"]).raw(frame)
    assert found == wanted or (math.isnan(found) and math.isnan(wanted))


@given(st.binary(min_size=8, max_size=8))
def test_multiplexed_signals_are_there_when_their_multiplexers_say_so(frame: bytes) -> None:
    database = cantools.database.load_string(MULTIPLEXED, database_format="dbc", strict=False)
    message = database.get_message_by_name("M")
    assert isinstance(message, Message)
    _judge(message, frame)
    for page in (0, 1, 5, 9):  # drawn seldom together with what they select
        _judge(message, bytes([page, 3, *frame[2:]]))


def _judge(message: Message, frame: bytes) -> None:
    try:
        wanted = message.decode(frame, decode_choices=False, scaling=False)
    except DecodeError:  # of a page that selects nothing; the signals of every page are still there
        wanted = {"PAGE": frame[0] & 15, "ALWAYS": frame[0] >> 4}
        if frame[0] & 15 == 1:
            wanted |= {"INNER": frame[1], "SECOND": int.from_bytes(frame[3:5], "big", signed=True)}
    for signal in message.signals:
        layout = Layout(message, [signal.name])
        if signal.name in wanted:
            assert layout.raw(frame) == [wanted[signal.name]]
        else:
            with pytest.raises(AbsentSignalError):
                layout.raw(frame)


@pytest.mark.parametrize(("start", "big"), [(5, False), (3, True), (8, False)])
def test_a_signal_beyond_the_end_is_never_there(start: int, big: bool) -> None:
    order = "big_endian" if big else "little_endian"
    signal = Signal("S", start=start, length=5, byte_order=order)
    message = Message(1, "M", 1, [signal], strict=False)
    with pytest.raises(AbsentSignalError):
        Layout(message, ["S"]).raw(b"\xff\xff")
