"""Direct writes of an MQTT client: a packet goes out as it is made, while the socket takes it.

aiomqtt has the loop wake for each packet to write it, by a byte through a pipe of its own, and a
task waits for that: three turns of the loop, half of what a message costs. Here the loop is asked
for the rest only where the socket is full.
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
