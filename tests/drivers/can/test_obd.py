"""The vehicle's speed by its diagnostics: the frames of the standards, and the driver on a bus."""

from __future__ import annotations

import math
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.can.obd import STEP_M_S, ObdSpeedDecoder, ObdSpeedDriver, ObdSpeedOptions, request
from drivers.measurements import Measurement, WheelSpeed
from tests.drivers.can.served import SECOND, Served, fed, sent
from tests.patience import until


def decoder(**options: Any) -> ObdSpeedDecoder:
    return ObdSpeedDecoder("obd", ObdSpeedOptions(**options))


def frame(can_id: int, text: str) -> tuple[int, bytes]:
    return can_id, bytes.fromhex(text)


def speeds(found: list[Measurement]) -> list[tuple[float, bool]]:
    return [(round(m.speed_m_s, 4), m.signed) for m in found if isinstance(m, WheelSpeed)]


def test_the_requests_of_the_standard() -> None:
    short, long = request(11), request(29)
    assert (short.can_id, short.extended) == (0x7DF, False)
    assert (long.can_id, long.extended) == (0x18DB33F1, True)
    assert short.data == long.data == bytes.fromhex("02 01 0D 55 55 55 55 55")


@pytest.mark.parametrize(
    ("text", "km_h"),
    [
        ("03 41 0D 32 00 00 00 00", 50),
        ("03 41 0D FF AA AA AA AA", 255),
        ("06 41 0C 1A F8 0D 40 00", 64),  # engine speed and speed in one answer
        ("07 41 05 7B 0D 1E 0C 00", 30),
    ],
)
def test_answers(text: str, km_h: int) -> None:
    (m,) = fed(decoder(rounding="nearest"), [frame(0x7E8, text)], 9)
    assert isinstance(m, WheelSpeed)
    assert (m.source, m.t_seen_ns, m.signed, m.sd_m_s) == ("obd", 9, False, None)
    assert m.speed_m_s == pytest.approx(km_h / 3.6)
    assert m.rounding_sd_m_s == pytest.approx(STEP_M_S / math.sqrt(12.0))


@pytest.mark.parametrize(
    ("rounding", "above", "sd"),
    [
        ("nearest", 0.0, math.sqrt(1.0 / 12.0)),
        ("down", 0.5, math.sqrt(1.0 / 12.0)),
        ("unknown", 0.25, math.sqrt(1.0 / 12.0 + 1.0 / 16.0)),
    ],
)
def test_whole_kilometres_an_hour(rounding: Any, above: float, sd: float) -> None:
    some, none = fed(
        decoder(rounding=rounding), [frame(0x7E8, "03410D32"), frame(0x7E8, "03410D00")]
    )
    assert isinstance(some, WheelSpeed)
    assert isinstance(none, WheelSpeed)
    assert some.speed_m_s == pytest.approx((50.0 + above) * STEP_M_S)
    assert some.rounding_sd_m_s == pytest.approx(sd * STEP_M_S)
    # 0 is no standstill but a speed below one step, forward or backward.
    assert (none.speed_m_s, none.signed) == (0.0, True)
    assert none.rounding_sd_m_s == pytest.approx(STEP_M_S / math.sqrt(3.0))


def test_what_is_no_speed_is_counted_by_name() -> None:
    d = decoder()
    frames = [
        ("03 7F 01 12 00 00 00 00", "refused"),
        ("03 7F 22 31 00 00 00 00", "other_answers"),
        ("03 41 05 7B 00 00 00 00", "other_answers"),
        ("03 62 7D 00 00 00 00 00", "other_answers"),
        ("06 41 00 BE 1F A8 13 00", "other_answers"),
        ("10 09 41 0D 32 0C 1A F8", "several_frames"),
        ("21 05 7B 00 00 00 00 00", "several_frames"),
        ("30 00 00 00 00 00 00 00", "undecodable"),
        ("03 41 0D", "undecodable"),
        ("02 41 0D 00 00 00 00 00", "undecodable"),
        ("01 41 00 00 00 00 00 00", "undecodable"),
        ("", "undecodable"),
    ]
    for text, counter in frames:
        before = d.counters[counter]
        assert fed(d, [frame(0x7E8, text)]) == []
        assert d.counters[counter] == before + 1, text
    assert fed(d, [frame(0x7DF, "02010D"), frame(0x123, "03410D32")]) == []
    assert d.counters["other_frames"] == 2


def test_the_first_unit_that_answers_counts_until_it_falls_silent() -> None:
    d = decoder(rounding="nearest")
    engine, gearbox = frame(0x7E8, "03410D24"), frame(0x7E9, "03410D25")
    refused = frame(0x7E9, "037F0112")
    assert len(fed(d, [refused, engine, gearbox])) == 1
    assert d.counters["other_unit"] == 1
    d.reset()
    assert speeds(fed(d, [gearbox, engine])) == [(round(37 / 3.6, 4), False)]
    assert speeds(fed(decoder(unit=0xE9, rounding="nearest"), [engine, gearbox])) == [
        (round(37 / 3.6, 4), False)
    ]


def test_identifiers_of_29_bits() -> None:
    d = decoder(identifiers=29, rounding="nearest")
    assert fed(d, [frame(0x7E8, "03410D24")]) == []
    assert speeds(fed(d, [frame(0x18DAF110, "03410D24")], extended=True)) == [(10.0, False)]
    assert d.filters == [{"can_id": 0x18DAF100, "can_mask": 0x1FFFFF00, "extended": True}]


@given(st.lists(st.tuples(st.sampled_from((0x7E8, 0x7E9, 0x7EF, 0x7F0)), st.binary(max_size=64))))
def test_garbage_never_raises_and_is_accounted_for(frames: list[tuple[int, bytes]]) -> None:
    d = decoder()
    for m in fed(d, frames):
        assert isinstance(m, WheelSpeed)
        assert 0.0 <= m.speed_m_s <= 256.0 * STEP_M_S
    assert sum(d.counters.values()) == len(frames)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"identifiers": 12}, "11 or 29"),
        ({"ask_hz": 50.0}, "less than or equal to 20"),
        ({"unit": 0x7E8}, "less than or equal to 255"),
        ({"rounding": "up"}, "'nearest', 'down' or 'unknown'"),
        ({"dbc": "x"}, "Extra inputs are not permitted"),
    ],
)
def test_configuration_mistakes(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        ObdSpeedOptions(**options)


async def test_listening_to_another_tester() -> None:
    obd = Served(ObdSpeedDriver, "obd", {"timeout_s": 0.2})
    async with obd.run() as bus:
        sent(bus, [frame(0x7E8, "03410D24"), frame(0x7E8, "03410C00")])
        await until(lambda: len(obd.measurements) == 1)
        assert obd.driver.status.state == "running"
        obd.now_ns += SECOND
        await until(lambda: "nothing heard of answers to a tester" in obd.driver.status.detail)
        assert bus.recv(0.0) is None  # it has not said a word
    assert obd.driver.counters["asked"] == 0


async def test_asking_and_a_bus_that_takes_no_request(monkeypatch: pytest.MonkeyPatch) -> None:
    obd = Served(ObdSpeedDriver, "obd-asks", {"ask_hz": 20.0, "rounding": "nearest"})
    async with obd.run() as bus:
        requests: list[can.Message] = []

        def heard() -> bool:
            message = bus.recv(0.0)
            requests.extend([message] if message is not None else [])
            return message is not None

        for km_h in (36, 72):
            await until(heard)
            asked = requests[-1]
            assert (asked.arbitration_id, bytes(asked.data)[:3]) == (0x7DF, b"\x02\x01\x0d")
            count = len(obd.measurements)
            sent(bus, [(0x7E8, bytes([3, 0x41, 0x0D, km_h]))])
            await until(lambda n=count: len(obd.measurements) > n)
        assert speeds([m for m in obd.measurements if isinstance(m, WheelSpeed)])[:2] == [
            (10.0, False),
            (20.0, False),
        ]

        def full(*_: object, **__: object) -> None:
            raise can.CanOperationError("Transmit buffer full")

        monkeypatch.setattr(type(bus), "send", full)
        await until(lambda: obd.driver.counters["not_sent"] > 0)
        monkeypatch.undo()
        asked_before = obd.driver.counters["asked"]
        await until(lambda: obd.driver.counters["asked"] > asked_before)
    assert obd.codes == []
