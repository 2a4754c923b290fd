"""Limit on a broker's packets: longer ones are read to their end and discarded.

MQTT allows messages of 256 MB. A client of MQTT 5 states its largest packet
(`outputs.mqtt_version`); a client of 3.1.1 cannot. So the length is checked here before decoding.
Of a longer packet enough bytes are kept to read its topic and to recognise it as too long; the rest
is read and discarded. The connection is kept: a new one would receive the same retained message
again.
"""

from __future__ import annotations

import socket

import aiomqtt

LONGEST_TOPIC = 65_535 + 8
"""Length of the header before the payload: topic, its length, packet identifier."""
PIECE = 4096
"""Bytes of one read; paho makes up to a hundred reads in one turn of the loop."""
HELD_BYTES = 131_072
"""Receive buffer (bytes) requested from the kernel, which doubles it. It holds some thousand small
messages, which are dropped within 0.1 s, and is large enough to read large ones at full speed."""
SOCKET_OPTIONS = (
    # Otherwise a message waits for the acknowledgement of the previous one (Nagle): a gap of 20 ms.
    (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
    (socket.SOL_SOCKET, socket.SO_RCVBUF, HELD_BYTES),
)


def limit(client: aiomqtt.Client, most_payload: int) -> None:
    """Limit the stored payload to `most_payload` bytes and one more.

    paho has no such limit, so this replaces its reads. `_client` is aiomqtt's paho client.
    """
    paho = client._client
    read = paho._sock_recv
    most = most_payload + LONGEST_TOPIC

    def read_and_cut(wanted: int) -> bytes:
        held = paho._in_packet["packet"]
        if len(held) > most:
            del held[most:]
        return read(min(wanted, PIECE))

    paho._sock_recv = read_and_cut  # type: ignore[assignment, method-assign]
