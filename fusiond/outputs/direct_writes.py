"""Direct writes of an MQTT client: a packet is sent when made, if the socket has room.

aiomqtt wakes the event loop for each packet by a byte through a pipe, for which a task waits: three
turns of the loop, half the cost of a message. With direct writes only a full socket involves the
loop.
"""

from __future__ import annotations

import contextlib
import threading
from typing import Any

import aiomqtt


def write_directly(client: aiomqtt.Client) -> None:
    """Make the client write at once the packets that this thread makes. `_client` is aiomqtt's paho
    client."""
    paho, thread = client._client, threading.get_ident()
    wait_until_writable = paho.on_socket_register_write

    def write(of: Any, userdata: Any, sock: Any) -> None:
        if threading.get_ident() == thread:  # another thread makes CONNECT, and must not write
            with contextlib.suppress(Exception):  # aiomqtt sees the same error
                paho.loop_write()
                if not paho.want_write():
                    return
        if wait_until_writable is not None:
            wait_until_writable(of, userdata, sock)

    paho.on_socket_register_write = write
