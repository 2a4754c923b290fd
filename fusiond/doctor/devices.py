"""Findings on ports and buses: missing, forbidden, taken, down or silent."""

from __future__ import annotations

import glob
import grp
import os
import stat
from pathlib import Path
from typing import Any

from drivers.base import Driver
from drivers.network_port import on_network
from fusiond.doctor.findings import finding

SERIAL_PATTERNS = (
    "/dev/serial/by-id/*",
    "/dev/ttyUSB*",
    "/dev/ttyACM*",
    "/dev/ttyAMA*",
    "/dev/ttyTHS*",
)
HINDRANCES = ("no_card", "no_beam", "low_battery", "suppressed", "silence")
"""Counters of an RDSS terminal that prevent positioning; findings have the same names."""
_CAN_TYPE = "280"
"""ARPHRD_CAN of linux/if_arp.h, as printed by /sys/class/net/*/type."""


def device_name(options: Any) -> str:
    """The port, or interface and channel, that a driver's options name."""
    port = getattr(options, "port", None)
    if port is not None:
        return str(port)
    return f"{getattr(options, 'interface', '?')} {getattr(options, 'channel', '')}".strip()


def open_findings(name: str, driver: Driver, options: Any, seconds: float) -> list[str]:
    """Findings on a driver that is not `running`, or reports a problem."""
    state, detail = driver.status.state, driver.status.detail
    port = getattr(options, "port", None)
    if state == "failed":
        return [finding("driver_failed", detail=detail, name=name)]
    if state == "absent" or (state == "starting" and not driver.counters["opened"] and port):
        if port is not None:
            return [absent_port(name, str(port), detail)]
        return [absent_interface(name, options, detail)]
    if state == "running":
        if hasattr(driver, "request_now"):  # a terminal's detail also says what it is about to do
            return [finding(code, detail=detail) for code in HINDRANCES if driver.counters[code]]
        return [detail] if detail else []
    if port is None:
        if options.interface != "socketcan":
            return [finding("bus_silent_elsewhere", detail=detail, name=name)]
        return [finding("bus_silent", detail=detail, channel=options.channel, name=name)]
    if on_network(str(port)):
        cause = getattr(driver, "cause", "")
        if cause:
            return [cause]
        return [finding("server_silent", detail=detail, port=port)]
    if not driver.counters["bytes_in"]:
        return [finding("port_silent", seconds=seconds)]
    cause = getattr(driver, "cause", "")
    if cause:
        return [cause]
    baud = getattr(options, "baud", None)
    if baud == "auto":
        return [finding("terminal_silent", detail=f" ({detail})" if detail else "")]
    return [finding("port_baud", baud=baud, name=name)]


def absent_port(name: str, path: str, detail: str) -> str:
    """Finding on a port that cannot be opened: missing, forbidden, or in use."""
    if on_network(path):
        return finding("server_missing", detail=detail, name=name)
    try:
        mode = os.stat(path)
    except OSError:
        there = similar_ports()
        ports = f"there are {', '.join(there)}" if there else "this computer has no serial port"
        return finding("port_missing", port=path, name=name, others=ports)
    if not stat.S_ISCHR(mode.st_mode):
        return finding("port_not_serial", port=path, name=name)
    if not os.access(path, os.R_OK | os.W_OK):
        of_port = {"mode": stat.filemode(mode.st_mode), "group": _group(mode.st_gid)}
        return finding("port_forbidden", port=path, **of_port)
    if "lock" in detail or "busy" in detail:
        return finding("port_busy", port=path)
    return finding("port_unusable", port=path, detail=detail)


def absent_interface(name: str, options: Any, detail: str) -> str:
    """Finding on a CAN interface that is down or does not exist."""
    channel = options.channel
    if options.interface != "socketcan":
        return finding("bus_interface", detail=detail, name=name)
    if "is down" in detail:
        return finding("bus_down", channel=channel)
    if "no interface" not in detail:
        return finding("bus_unusable", channel=channel, detail=detail)
    there = can_interfaces()
    others = f"there are {', '.join(there)}" if there else "this computer has no CAN interface"
    return finding("bus_missing", channel=channel, name=name, others=others)


def similar_ports() -> list[str]:
    """Serial ports of this computer, persistent names first."""
    return [path for pattern in SERIAL_PATTERNS for path in sorted(glob.glob(pattern))]


def can_interfaces(root: Path = Path("/sys/class/net")) -> list[str]:
    """CAN interfaces of this computer."""
    found = []
    for kind in sorted(root.glob("*/type")):
        try:
            if kind.read_text().strip() == _CAN_TYPE:
                found.append(kind.parent.name)
        except OSError:
            continue
    return found


def _group(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)
