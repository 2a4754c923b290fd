"""Packets of a client that go out as they are made, beside a socket that is full."""

from __future__ import annotations

import threading
from typing import Any
from unittest.mock import Mock

import aiomqtt

from fusiond.outputs.direct_writes import write_directly


async def _client(full: bool) -> tuple[Any, Mock]:
    client = aiomqtt.Client("127.0.0.1")
    paho, waits = client._client, Mock()
    paho.on_socket_register_write = waits
    paho.loop_write, paho.want_write = Mock(), Mock(return_value=full)  # type: ignore[method-assign]
    write_directly(client)
    return paho, waits


async def test_a_packet_is_written_at_once() -> None:
    paho, waits = await _client(full=False)
    paho.on_socket_register_write(paho, None, None)
    assert paho.loop_write.call_count == 1
    assert waits.call_count == 0


async def test_the_loop_writes_what_the_socket_does_not_take() -> None:
    paho, waits = await _client(full=True)
    paho.on_socket_register_write(paho, None, None)
    assert paho.loop_write.call_count == 1
    assert waits.call_count == 1


async def test_a_write_that_fails_is_left_to_the_loop() -> None:
    paho, waits = await _client(full=False)
    paho.loop_write.side_effect = OSError
    paho.on_socket_register_write(paho, None, None)
    assert waits.call_count == 1


async def test_another_thread_writes_nothing() -> None:
    paho, waits = await _client(full=False)
    thread = threading.Thread(target=paho.on_socket_register_write, args=(paho, None, None))
    thread.start()
    thread.join()
    assert paho.loop_write.call_count == 0
    assert waits.call_count == 1
