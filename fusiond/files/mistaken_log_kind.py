"""Recognition of files given in place of a receiver's log, for the error message."""

from __future__ import annotations

_BEGINNINGS: tuple[tuple[bytes, str], ...] = (
    (b"PK\x03\x04", "a zip archive: unpack it"),
    (b"\xfd7zXZ", "an xz file: unpack it, or pack it with gzip"),
    (b"BZh", "a bzip2 file: unpack it, or pack it with gzip"),
    (b"\x28\xb5\x2f\xfd", "a zstd file: unpack it, or pack it with gzip"),
    (b"7z\xbc\xaf", "a 7z archive: unpack it"),
    (b"\xd4\xc3\xb2\xa1", "a capture of a network (pcap): save what the receiver sent"),
    (b"\xa1\xb2\xc3\xd4", "a capture of a network (pcap): save what the receiver sent"),
    (b"\x0a\x0d\x0d\x0a", "a capture of a network (pcapng): save what the receiver sent"),
    (b"\x89MCAP", "a recording (MCAP): fusiond replay takes fusiond's own"),
    (b"SQLite format 3", "a data base (SQLite)"),
)
"""Kinds by first bytes, as in file(1)."""
_WITHIN: tuple[tuple[bytes, str], ...] = (
    (b"RINEX VERSION", "a RINEX file: --aid raw=FILE"),
    (b"<gpx", "a GPX track, which has no accuracy: take the receiver's own log"),
    (b"<kml", "a KML track, which has no accuracy: take the receiver's own log"),
    (b"<html", "a page of the web: the download went wrong"),
    (b"<!doctype", "a page of the web: the download went wrong"),
    (b"lat_deg", "a table: --aid gnss=FILE (or the kind that its columns are of)"),
)
"""Kinds by text in the first kilobyte, without case."""
_LOOKED_AT = 1024


def mistaken_log_kind(data: bytes) -> str:
    """Name of the file's actual kind, with the remedy; "" if unknown."""
    if not data:
        return "the file is empty"
    if not data.strip(b"\0"):
        return "the file has nothing but zeros"
    head = data[:_LOOKED_AT]
    for begins, name in _BEGINNINGS:
        if head.startswith(begins):
            return f"this is {name}"
    small = head.lower()
    for mark, name in _WITHIN:
        if mark.lower() in small:
            return f"this is {name}"
    return ""
