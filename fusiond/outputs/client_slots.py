"""Choice of the client that a full server disconnects for a new one.

First a client that is overdue with its request or with reading its reply. Else, if one host has
more connections than the new client's host would then have, the last of that host: so one host may
use all places until another host needs one. All addresses of a 64-bit IPv6 network count as one
host, because one host may have them all (RFC 4291, 2.5.4).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from ipaddress import IPv6Address, ip_address
from typing import Any, Protocol, TypeVar

_HOST_BITS = 64


class Placed(Protocol):
    """Connection that occupies a place."""

    host: str

    def owes(self, now_ns: int) -> bool:
        """True if the client has missed a deadline."""


T = TypeVar("T", bound=Placed)


def host_of(address: Any) -> str:
    """Host of a peer's address as returned by `accept`."""
    name = str(address[0]) if address else ""
    try:
        found = ip_address(name.partition("%")[0])
    except ValueError:
        return name
    if not isinstance(found, IPv6Address):
        return name
    if found.ipv4_mapped is not None:
        return str(found.ipv4_mapped)
    return str(IPv6Address(int(found) >> _HOST_BITS << _HOST_BITS))


def gives_way(taken: Collection[T], host: str, now_ns: int) -> T | None:
    """Client to disconnect for one of `host`; None if there is none. `taken` is in order of
    connection."""
    for placed in taken:
        if placed.owes(now_ns):
            return placed
    counts = Counter(placed.host for placed in taken)
    crowd = max(counts, key=lambda name: counts[name], default=host)
    if counts[crowd] <= counts[host] + 1:
        return None
    return [placed for placed in taken if placed.host == crowd][-1]
