"""Dialects of CAN logs: what loggers and their users make of names, headers and digits."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.can.python_can_import import with_mf4
from tests.offline.can_files import FRAMES, asc, same, written
from tests.offline.test_case_variants import CANDUMP, bus_of

Change = Callable[[bytes], bytes]


def _dotted(log: bytes) -> bytes:
    """Bytes apart by dots, as cansend takes them."""
    return re.sub(rb"#(.*)", lambda m: b"#" + b".".join(re.findall(rb"..", m[1])), log)


@pytest.mark.parametrize(
    "change",
    [
        _dotted,
        lambda log: log.lower(),
        lambda log: log.replace(b"can0", b"slcan0"),
        lambda log: log.replace(b" can0 ", b"\tcan0\t"),
        lambda log: log.replace(b"7E8#", b"000007E8#"),
        lambda log: re.sub(rb"(\.\d{6})\)", rb"\g<1>000)", log),
        lambda log: re.sub(rb"(\.\d{3})\d{3}\)", rb"\1)", log),
        lambda log: log.replace(b"\n", b"\r"),
        lambda log: log.replace(b"\n", b" T\n"),
        lambda log: re.sub(rb"(#[0-9A-F]{16})\n", rb"\1_9\n", log),
        lambda log: log.decode().encode("utf-16-le"),
        lambda log: log.decode().encode("utf-16-be"),
        gzip.compress,
    ],
)
def test_candump(tmp_path: Path, change: Change) -> None:
    found, refused, _ = bus_of(tmp_path, "bus.log", change(CANDUMP))
    same(found, FRAMES, within_s=1e-3)
    assert refused.all() == []


@pytest.mark.parametrize(
    "change",
    [
        lambda log: log.replace(b"internal events logged\n", b""),
        lambda log: log.replace(b"internal events logged\n", b"   0.000000 CANFD Statistic: D\n"),
        lambda log: log.replace(b"internal events logged", b"no internal events logged"),
        lambda log: log.replace(b"internal events logged", b"// version 13.0.0"),
        lambda log: log.replace(b"Thu Oct 9", b"Do Okt 9"),
        lambda log: log.replace(b"08:53:20.000", b"08:53:20 am"),
        lambda log: log.replace(b"Rx   d", b"Tx   d"),
        lambda log: re.sub(rb"(?m)^(   .*)$", rb"\1  Length = 240000 BitCount = 125", log),
        lambda log: re.sub(rb" +", b"\t", log.partition(b"logged\n")[2]).join(
            (log.partition(b"logged\n")[0] + b"logged\n", b"")
        ),
        lambda log: log.replace(b"\n", b"\r\n"),
    ],
)
def test_asc(tmp_path: Path, change: Change) -> None:
    found, refused, _ = bus_of(
        tmp_path, "other.asc", change(asc(tmp_path / "bus.asc").read_bytes())
    )
    same(found, FRAMES)
    assert refused.all() == []


@pytest.mark.parametrize("kind", [".log", ".asc", ".blf", ".trc", ".mf4"])
@pytest.mark.parametrize("name", ["bus.log", "bus.asc", "bus.blf", "bus.trc", "bus.txt", "bus.LOG"])
def test_content_counts_before_the_name(tmp_path: Path, kind: str, name: str) -> None:
    if kind == ".log":
        data = CANDUMP
    elif kind == ".asc":
        data = asc(tmp_path / "made.asc").read_bytes()
    else:
        with_mf4()
        data = written(tmp_path / f"made{kind}", FRAMES).read_bytes()
    found, _, said = bus_of(tmp_path, name, data)
    same(found, FRAMES, within_s=1e-3)
    assert "cannot be read" not in said


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"***BUSMASTER Ver 3.2.2***\n09:30:12:3450 Rx 1 0x7E8 s 8 03 41\n", "of BUSMASTER"),
        (
            b"Time Stamp,ID,Extended,Dir,Bus,LEN,D1\n166064000,0000021A,false,Rx,0,1,FE\n",
            "SavvyCAN",
        ),
        (b"\x0a\x0d\x0d\x0a\x1c\0\0\0", "a capture of a network"),
        (b"t7E880341\r", "candump writes logs with -L"),
        (b"PK\x03\x04" + bytes(60), "this is a zip archive: unpack it"),
        (bz2.compress(CANDUMP), "this is a bzip2 file: unpack it"),
        (lzma.compress(CANDUMP), "this is an xz file: unpack it"),
    ],
)
def test_what_is_another_programs_is_named(tmp_path: Path, data: bytes, words: str) -> None:
    found, _, said = bus_of(tmp_path, "bus.log", data)
    assert found == []
    assert words in said
