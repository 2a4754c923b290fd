"""What is no request is refused in one way, and ends nobody but its sender."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets import Subprotocol
from websockets.asyncio.client import connect

from fusiond.outputs.foxglove.viewer import PROTOCOLS
from fusiond.outputs.json_requests import DEEPEST, NotUnderstoodError, parsed
from tests.outputs.guest_servers import foxglove, gpsd, url
from tests.outputs.serving import connected

HOSTILE = (
    "[" * 4000,
    "[" * 4000 + "]" * 4000,
    '{"a":' * 900 + "1" + "}" * 900,
    "[" * (DEEPEST + 1) + "]" * (DEEPEST + 1),
    '"\\ud800"',
    '{"\\udfff": 1}',
    '{"op": ["\\udc00"]}',
    "NaN",
    '{"id": Infinity}',
    '{"id": 1e999}',
    "9" * 5000,
    "",
    "{",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_invalid_json_has_one_refusal(text: str) -> None:
    for given_ in (text, text.encode()):
        with pytest.raises(NotUnderstoodError) as refused:
            parsed(given_)
        assert str(refused.value).isascii()
    with pytest.raises(NotUnderstoodError):
        parsed(b"\xff\xfe\x00")


def test_valid_requests_are_parsed() -> None:
    assert parsed('{"op":"a","b":[1,{"c":"\\ud83d\\ude00 \u00e9"}]}')["b"][1]["c"] == "😀 é"
    assert parsed("[" * (DEEPEST - 1) + "]" * (DEEPEST - 1)) is not None


@given(st.text(max_size=60) | st.binary(max_size=60))
@settings(max_examples=200, deadline=None)
def test_any_bytes_give_a_serialisable_value_or_a_refusal(text: str | bytes) -> None:
    try:
        value = parsed(text)
    except NotUnderstoodError:
        return
    json.dumps(value, ensure_ascii=False, allow_nan=False).encode()


async def test_gpsd_and_foxglove_refuse_alike() -> None:
    protocol = [Subprotocol(PROTOCOLS[0])]
    async with gpsd() as server, connected(server.server.port.address) as client:
        await client.line()
        for count, text in enumerate(HOSTILE[:7], start=1):
            client.writer.write(b"?WATCH=" + text.encode() + b"\n;")
            if "{" in text and count == 3:
                client.writer.write(b"}" * 900)
            assert json.loads(await client.line())["class"] == "ERROR"
        assert server.counters["clients_faulty"] == 0
    async with foxglove() as fox, connect(url(fox), subprotocols=protocol) as viewer:
        for _ in range(2):
            await viewer.recv()
        for text in HOSTILE:
            await viewer.send(text)
            assert json.loads(await viewer.recv())["op"] == "status"
        assert fox.counters["malformed"] == len(HOSTILE)
        assert fox.counters["clients_faulty"] == 0
