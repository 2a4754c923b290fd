"""Direct writes of an MQTT client: a packet is sent as it is made, if the socket has room.

aiomqtt wakes the loop for each packet by a byte through a pipe, and a task waits for it: three
turns of the loop, half the cost of a message. Here the loop is used only if the socket is full.
"""

from __future__ import annotations

import contextlib
import threading
from typing import Any

import aiomqtt


def write_directly(client: aiomqtt.Client) -> None:
    """Write packets that are made in this thread at once; aiomqtt keeps paho's as `_client`."""
    paho, thread = client._client, threading.get_ident()
    wait_until_writable = paho.on_socket_register_write

    def write(of: Any, userdata: Any, sock: Any) -> None:
        if threading.get_ident() == thread:  # CONNECT is made in another, which must not write
            with contextlib.suppress(Exception):  # aiomqtt meets it again, and ends the connection
                paho.loop_write()
                if not paho.want_write():
                    return
        if wait_until_writable is not None:
            wait_until_writable(of, userdata, sock)

    paho.on_socket_register_write = write
