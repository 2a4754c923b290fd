"""Records: bytes and back, whatever they hold."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.bus import CanFrame
from fusiond.recording.records import (
    DamagedRecordError,
    Kind,
    Record,
    Tick,
    input_of,
    input_record,
    pack,
    tick_of,
    tick_payload,
    unpack,
)

NS = st.integers(-(2**63), 2**63 - 1)
READINGS = st.lists(st.tuples(st.integers(0, 1), NS, NS), max_size=5)
RECORDS = st.builds(
    Record, st.sampled_from(Kind), st.integers(0, 255), NS, st.binary(max_size=200), READINGS
)
FRAMES = st.builds(
    CanFrame,
    st.integers(0, 2**29 - 1),
    st.booleans(),
    st.binary(max_size=64),
    NS,
    st.none() | NS,
    st.booleans(),
    st.booleans(),
)


@given(st.lists(RECORDS, max_size=8))
def test_records_survive_packing_and_unpacking(records: list[Record]) -> None:
    assert list(unpack(b"".join(map(pack, records)))) == records


@given(FRAMES)
def test_a_frame_keeps_every_bit(frame: CanFrame) -> None:
    record = input_record(3, "frame", frame.t_seen_ns, frame)
    (again,) = unpack(pack(record))
    assert input_of(again) == ("frame", frame)


@pytest.mark.parametrize(
    ("kind", "payload"),
    [
        ("read", b"\x00$GN"),
        ("open", None),
        ("close", "unplugged: ü"),
        ("controller", "bus_off"),
        ("silence", None),
        ("sent", b"$CC"),
    ],
)
def test_an_input_comes_back_as_it_was(kind: str, payload: bytes | str | None) -> None:
    (again,) = unpack(pack(input_record(0, kind, 5, payload)))
    assert input_of(again) == (kind, payload)


@given(st.binary(max_size=100))
def test_other_bytes_are_records_or_refused(data: bytes) -> None:
    try:
        found = list(unpack(data))
    except DamagedRecordError:
        return
    assert b"".join(map(pack, found)) == data


def test_a_tick_keeps_what_it_says() -> None:
    tick = Tick(123_456, 7, -5, b"12345678")
    record = Record(Kind.TICK, 255, 9, tick_payload(tick))
    assert tick_of(record) == tick
    with pytest.raises(DamagedRecordError):
        tick_of(record._replace(payload=b"short"))
    with pytest.raises(DamagedRecordError):
        input_of(record)
