"""Logs of a CAN bus as recorders write them, and what is read of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import can
import pytest

from fusiond.offline.can_log_reader import Refusals, messages
from tests.offline.recorded_bus import BEGIN_S, bus

FRAMES = list(bus(2))


def read(path: Path) -> tuple[list[can.Message], Refusals, list[str]]:
    """Messages, refusals, and what was told of zones."""
    refused = Refusals()
    told: list[str] = []
    found = list(messages(path, refused, lambda code, text: told.append(text)))
    return found, refused, told


def same(found: list[can.Message], expected: list[can.Message], within_s: float = 1e-5) -> None:
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        assert (a.arbitration_id, bytes(a.data)) == (b.arbitration_id, bytes(b.data))
        assert a.is_extended_id == b.is_extended_id
        assert a.timestamp == pytest.approx(b.timestamp, abs=within_s)


def written(path: Path, frames: list[can.Message]) -> Path:
    with can.Logger(path) as logger:
        for message in frames:
            logger(message)
    return path


def asc(path: Path, *, header: str = "", change: Callable[[str], str] = str) -> Path:
    """The frames as CANoe writes them, by a clock in UTC."""
    lines = [
        f"   {m.timestamp - BEGIN_S:.6f} 1  {m.arbitration_id:X}             Rx   d "
        f"{m.dlc} {m.data.hex(' ').upper()}"
        for m in FRAMES
    ]
    date = header or "date Thu Oct 9 08:53:20.000 2025\nbase hex  timestamps absolute\n"
    path.write_bytes(
        (date + "internal events logged\n").encode() + change("\n".join(lines)).encode()
    )
    return path


def terminal(stamp: Callable[[float], str], tail: str = "") -> list[str]:
    last = [BEGIN_S]

    def said(m: can.Message) -> str:
        text = stamp(m.timestamp - last[0] if stamp is delta else m.timestamp)
        last[0] = m.timestamp
        return f" {text}  can0  {m.arbitration_id:03X}   [{m.dlc}]  {m.data.hex(' ').upper()}{tail}"

    return [said(m) for m in FRAMES]


def absolute(t_s: float) -> str:
    return f"({t_s:.6f})"


def delta(t_s: float) -> str:
    return f"({t_s:010.6f})"
