"""Why a device is not there or not heard, and what would do: serial ports, CAN interfaces."""

from __future__ import annotations

import glob
import grp
import os
import stat
from pathlib import Path
from typing import Any

from drivers.base import Driver
from drivers.network_port import on_network

SERIAL_PATTERNS = (
    "/dev/serial/by-id/*",
    "/dev/ttyUSB*",
    "/dev/ttyACM*",
    "/dev/ttyAMA*",
    "/dev/ttyTHS*",
)
HINDRANCES = {
    "no_card": "put in the user card, or have it activated",
    "no_beam": "give the antenna a free sky to the south (geostationary satellites)",
    "low_battery": "charge the terminal or feed it from the vehicle",
    "suppressed": "the centre has switched the transmitter off; only it can lift that",
    "silence": "radio silence is set at the terminal: its operator lifts it",
}
"""Counters of an RDSS terminal that keep it from positioning, and what would do."""
_CAN_TYPE = "280"
"""ARPHRD_CAN of linux/if_arp.h, as /sys/class/net/*/type prints it."""
_CAN_UP = "ip link set {0} up (with `type can bitrate 500000` where it is not set yet)"


def device_name(options: Any) -> str:
    """The port, or interface and channel, that a driver's options name."""
    port = getattr(options, "port", None)
    if port is not None:
        return str(port)
    return f"{getattr(options, 'interface', '?')} {getattr(options, 'channel', '')}".strip()


def open_findings(name: str, driver: Driver, options: Any, seconds: float) -> list[str]:
    """Findings on a driver that is not `running`, or that runs and complains."""
    state, detail = driver.status.state, driver.status.detail
    port = getattr(options, "port", None)
    if state == "failed":
        return [f"{detail}: correct [sources.{name}] or the installation"]
    if state == "absent" or (state == "starting" and not driver.counters["opened"] and port):
        if port is not None:
            return [absent_port(name, str(port), detail)]
        return [absent_interface(name, options, detail)]
    if state == "running":
        if hasattr(driver, "request_now"):  # a terminal's detail also says what it is about to do
            hindered = [name for name in HINDRANCES if driver.counters[name]]
            return [f"{detail}: {HINDRANCES[name]}" for name in hindered]
        return [detail] if detail else []
    if port is None:
        return [
            f"{detail}: check bit rate (ip -d link show {options.channel}), wiring and power; "
            f"`candump {options.channel}` shows what is on the bus, [sources.{name}] what is wanted"
        ]
    if on_network(str(port)):
        cause = getattr(driver, "cause", "")
        if cause:
            return [cause]
        return [f"{detail}: see what {port} says with `nc` or `gpspipe`, and who may connect there"]
    if not driver.counters["bytes_in"]:
        return [f"nothing arrives in {seconds:g} s: check power, and that its TX goes to our RX"]
    cause = getattr(driver, "cause", "")
    if cause:
        return [cause]
    baud = getattr(options, "baud", None)
    if baud == "auto":
        return [
            f"bytes arrive, but no terminal has answered yet{f' ({detail})' if detail else ''}: "
            "listen longer (--seconds 60: every baud rate is tried), and check our TX to its RX"
        ]
    return [
        f"bytes arrive, but nothing intelligible: {baud} baud is probably not the device's rate, "
        f"correct baud in [sources.{name}]"
    ]


def absent_port(name: str, path: str, detail: str) -> str:
    """A port that cannot be opened: it is not there, not allowed, or taken."""
    if on_network(path):
        return f"{detail}: start what serves it, or correct port in [sources.{name}]"
    try:
        mode = os.stat(path)
    except OSError:
        there = similar_ports()
        ports = f"there are {', '.join(there)}" if there else "there is no serial port at all"
        return f"{path} is not there: plug it in, or correct port in [sources.{name}]; {ports}"
    if not stat.S_ISCHR(mode.st_mode):
        return f"{path} is not a serial port: correct port in [sources.{name}]"
    if not os.access(path, os.R_OK | os.W_OK):
        group = _group(mode.st_gid)
        return (
            f"no permission for {path} ({stat.filemode(mode.st_mode)}, group {group}): "
            f"usermod -aG {group} USER, and log in again"
        )
    if "lock" in detail or "busy" in detail:
        return (
            f"{path} is in use by another program: stop it (systemctl stop fusiond ModemManager; "
            f"fuser -v {path} names it)"
        )
    return f"{path} cannot be opened: {detail}"


def absent_interface(name: str, options: Any, detail: str) -> str:
    """A CAN interface that is down or does not exist."""
    channel = options.channel
    if options.interface != "socketcan":
        return f"{detail}: correct interface and channel in [sources.{name}]"
    if "is down" in detail:
        return f"{channel} is down: {_CAN_UP.format(channel)}"
    if "no interface" not in detail:
        return detail
    there = can_interfaces()
    others = f"there are {', '.join(there)}" if there else "this machine has no CAN interface"
    return f"{channel} does not exist: load its driver or correct [sources.{name}]; {others}"


def similar_ports() -> list[str]:
    """Serial ports of this machine, those with a lasting name first."""
    return [path for pattern in SERIAL_PATTERNS for path in sorted(glob.glob(pattern))]


def can_interfaces(root: Path = Path("/sys/class/net")) -> list[str]:
    """CAN interfaces of this machine."""
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
