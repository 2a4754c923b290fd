"""Kind of a CAN log by its content, for files with a misleading name or suffix.

Sources: file(1); can-utils, candump.c; Vector, ASC and BLF format descriptions; PEAK, TRC file
format; ASAM MDF 4.
"""

from __future__ import annotations

import codecs
import re

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
)
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
    return f"this is {name}: {_REMEDY}" if name else ""


def _text(head: bytes) -> str:
    marked = head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return head.decode("utf-16" if marked else "latin-1", "replace").removeprefix("ï»¿")
