"""Two daemons' processes, two simulated terminals: messages that are wrong are told and counted.

What is too long, or of a card whose level forbids it, is refused with the number; what comes cut,
foreign, damaged, or for another card is handed on with what is wrong of it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import aiomqtt

from drivers.rdss.mail import TextEncoding
from drivers.rdss.messages import Text
from drivers.rdss.vehicle_message_envelope import (
    TEXT,
    encode_envelope,
    encode_text_body,
    envelope_to_text,
)
from tests.broker import Broker, Listener, listening
from tests.hil.processes import DaemonProcess
from tests.live.radio import CARDS, Radio, config, said

FAULTS = {"crc", "cut", "damaged", "other_card", "version"}
AHEAD, BEHIND, STRANGER = CARDS["ahead"], CARDS["behind"], 300001


async def ask(client: aiomqtt.Client, name: str, number: str, text: str) -> None:
    other = BEHIND if name == "ahead" else AHEAD
    command = {"id": number, "card": other, "text": text}
    await client.publish(f"fusiond/{name}/cmd/send_message", json.dumps(command), qos=1)


def over(listener: Listener, name: str, number: str) -> dict[str, Any] | None:
    """The end of a message of one's own."""
    own = (m for m in said(listener, name, "message") if m["id"] == number and m["over"])
    return next(own, None)


def reply(listener: Listener, name: str, number: str) -> dict[str, Any] | None:
    return next((r for r in said(listener, name, "reply") if r["id"] == number), None)


def received(listener: Listener, name: str) -> list[dict[str, Any]]:
    return [m for m in said(listener, name, "message") if m["direction"] == "received"]


def counted(listener: Listener) -> set[str]:
    """Faults that the terminal has counted, as `health` has them."""
    health = json.loads((listener.payloads("fusiond/ahead/health") or ["{}"])[-1])
    return {fault for fault in FAULTS if f"message_{fault}" in json.dumps(health)}


async def test_what_is_wrong_with_a_message_is_told_by_both_ends(tmp_path: Path) -> None:
    radio = Radio(tmp_path, "4.0", 0.0, 0.0, 0.0, levels={"ahead": 0, "behind": 1})
    with Broker(tmp_path) as broker:
        async with (
            radio.on() as network,
            listening(broker) as (listener, client),
            DaemonProcess(config(tmp_path, "ahead", "4.0", broker.port)) as ahead,
            DaemonProcess(config(tmp_path, "behind", "4.0", broker.port)) as behind,
        ):
            for daemon in (ahead, behind):
                await daemon.start()
                await daemon.ready()

            async def refused(name: str, number: str, text: str) -> str:
                await ask(client, name, number, text)
                await listener.until(lambda li: reply(li, name, number) is not None)
                found = reply(listener, name, number)
                assert found is not None
                assert not found["ok"]
                return str(found["text"])

            # The card is known by then: neither is queued.
            assert "level, 0, allows no message" in await refused("ahead", "a1", "Report fuel")
            said_of = await refused("behind", "b1", "fourteen chars")
            assert said_of == "120 bits, and a card of level 1 sends 110"
            for number, text in (("b2", "a short text"), ("b3", "停车检查油量")):
                await ask(client, "behind", number, text)
            await listener.until(lambda li: over(li, "behind", "b3") is not None)
            ends = [over(listener, "behind", number) for number in ("b2", "b3")]
            assert [end and end["state"] for end in ends] == ["sent", "sent"]
            await listener.until(lambda li: len(received(li, "ahead")) == 2)
            texts = [m["text"] for m in received(listener, "ahead")]
            assert texts == ["a short text", "停车检查油量"]

            whole = envelope_to_text(
                encode_envelope(TEXT, encode_text_body(7, b"go north")), "binary"
            )
            for payload, encoding, card, crc_ok in wrong(whole.payload):
                text = Text(STRANGER, payload, encoding, card, crc_ok=crc_ok)
                radio.terminals["ahead"].hand_over(text, radio.now_s)
            await listener.until(lambda li: len(received(li, "ahead")) == 8)
            await listener.until(lambda li: counted(li) >= FAULTS)
    faults = [m["fault"] for m in received(listener, "ahead")[2:]]
    assert {*faults} == {None, *FAULTS}
    foreign = next(m for m in received(listener, "ahead")[2:] if not m["fault"])
    assert (foreign["text"], foreign["card"]) == (None, STRANGER)  # no text in any encoding
    codes = [json.loads(p)["code"] for p in listener.payloads("fusiond/ahead/event")]
    for fault in FAULTS:
        assert f"message_{fault}" in codes
    assert network.counters["carried"] == 2  # and nothing was answered to a stranger


def wrong(whole: bytes) -> list[tuple[bytes, TextEncoding, int, bool]]:
    """Payloads with their encoding, the card that they are for, and whether their CRC was right."""
    return [
        (b"\xa4\x01\x02\x03", "mixed", AHEAD, True),
        (b"\xa4hello", "mixed", STRANGER, True),
        (b"\xa4hello", "mixed", AHEAD, False),
        (whole[:-3], "mixed", AHEAD, True),
        (whole[:-1] + b"\0", "mixed", AHEAD, True),
        (b"\xa4" + encode_envelope(7, b"\x02"), "mixed", AHEAD, True),
    ]
