"""Endings of a broker's connection that aiomqtt does not handle: a swallowed cancellation, a frozen
broker, an abandoned attempt."""

from __future__ import annotations

import asyncio
import contextlib
import socket

import aiomqtt

FAREWELL_S = 2.0
"""Longest a shutdown waits for the broker."""


async def end(tasks: list[asyncio.Task[None]]) -> list[Exception]:
    """Cancel tasks, wait for them, and return their errors."""
    for task in tasks:
        task.cancel()
    results = await asyncio.gather(*tasks, return_exceptions=True)
    return [r for r in results if isinstance(r, Exception)]


def honour_cancellation() -> None:
    """Raise a swallowed cancellation: `asyncio.wait_for` of Python 3.11, used by aiomqtt, drops one
    that coincides with the result (python/cpython issue 86296)."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


def hang_up(client: aiomqtt.Client) -> None:
    """Shut down the socket without DISCONNECT, so that the broker publishes the will.

    aiomqtt offers only a graceful disconnect, which a frozen broker never confirms. After the
    shutdown its reader sees the end of file and closes the rest. `_client` is paho's public client.
    """
    if client._connected.cancelled():  # aiomqtt's callback would read the cancelled attempt
        client._client.on_disconnect = None
    sock = client._client.socket()
    if isinstance(sock, socket.socket):
        with contextlib.suppress(OSError):
            sock.shutdown(socket.SHUT_RDWR)


async def abandon(client: aiomqtt.Client) -> None:
    """Disconnect and wait until aiomqtt has noticed, so that its context ends at once."""

    async def ended() -> None:
        async for _ in client.messages:
            pass

    hang_up(client)
    with contextlib.suppress(aiomqtt.MqttError, TimeoutError):
        await asyncio.wait_for(ended(), FAREWELL_S)
