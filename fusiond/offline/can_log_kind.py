"""Kind of a CAN log by its content, for files with a misleading name or suffix.

Sources: file(1); can-utils, candump.c; Vector, ASC and BLF format descriptions; PEAK, TRC file
format; ASAM MDF 4.
"""

from __future__ import annotations

import re

from fusiond.files.log_bytes import utf_16

FORMATS = (".log", ".asc", ".blf", ".trc", ".mf4")
LOOKED_AT = 4096
"""Bytes of the beginning that are searched."""
_MAGIC = {b"LOGG": ".blf", b"MDF  ": ".mf4"}
_TEXT = (
    (".trc", re.compile(r"^\s*;(\$FILEVERSION=|\s*\$?STARTTIME=|-{20})", re.MULTILINE)),
    (".asc", re.compile(r"^\s*(date\s+\w+\s|base\s+(hex|dec)\b)", re.MULTILINE | re.IGNORECASE)),
    (".log", re.compile(r"^\s*\(\d[\d.: -]*\)\s+\S+\s+[0-9A-Fa-f]{3,8}", re.MULTILINE)),
)
_OTHERS = (
    ("***BUSMASTER", "a log of BUSMASTER"),
    ("Time Stamp,ID,Extended", "a table of SavvyCAN"),
    ("\n\r\r\n", "a capture of a network (pcapng)"),
    ("PK\x03\x04", "a zip archive"),
    ("\xfd7zXZ", "an xz file"),
    ("BZh", "a bzip2 file"),
    ("\x28\xb5\x2f\xfd", "a zstd file"),
    ("7z\xbc\xaf", "a 7z archive"),
)
_PACKED = ("PK", "\xfd7z", "BZh", "\x28\xb5", "7z")
_REMEDY = "save it as one of candump -L, ASC, BLF, TRC or MF4"


def kind_of(head: bytes) -> str:
    """Suffix of a log's format, by its first bytes; "" if unknown."""
    for magic, suffix in _MAGIC.items():
        if head.startswith(magic):
            return suffix
    text = _text(head)
    return next((suffix for suffix, begins in _TEXT if begins.search(text)), "")


def foreign_kind(head: bytes) -> str:
    """Sentence on a log in another program's format, which is not read; "" if unknown."""
    text = _text(head)
    name = next((name for begins, name in _OTHERS if text.startswith(begins)), "")
    remedy = "unpack it, or pack it with gzip" if text.startswith(_PACKED) else _REMEDY
    return f"this is {name}: {remedy}" if name else ""


def _text(head: bytes) -> str:
    return head.decode(utf_16(head) or "latin-1", "replace").removeprefix("ï»¿")
