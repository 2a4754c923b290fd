"""Judges of an exported track: GPX 1.1 by the rules of its schema, and gpsbabel where it is
installed, which reads GPX and KML and says what it understood.

Source of the rules: https://www.topografix.com/GPX/1/1/gpx.xsd (types gpxType, trkType, trksegType,
wptType, latitudeType, longitudeType).
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

GPX = "{http://www.topografix.com/GPX/1/1}"
ORDER = {
    "gpx": ("metadata", "wpt", "rte", "trk", "extensions"),
    "metadata": (
        *("name", "desc", "author", "copyright", "link", "time", "keywords", "bounds"),
        "extensions",
    ),
    "trk": ("name", "cmt", "desc", "src", "link", "number", "type", "extensions", "trkseg"),
    "trkseg": ("trkpt", "extensions"),
    "trkpt": (
        *("ele", "time", "magvar", "geoidheight", "name", "cmt", "desc", "src", "link", "sym"),
        *("type", "fix", "sat", "hdop", "vdop", "pdop", "ageofdgpsdata", "dgpsid", "extensions"),
    ),
}
"""xsd:sequence: the elements that may be in another, in this order."""
SEVERAL = frozenset({"wpt", "rte", "trk", "trkseg", "trkpt", "link"})
_DECIMAL = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)\Z")
_DATE_TIME = re.compile(r"\d{4}-\d\d-\d\dT([01]\d|2[0-3]):[0-5]\d:[0-5]\d(\.\d+)?Z\Z")


class TrackPoint(NamedTuple):
    lat_deg: float
    lon_deg: float
    height_m: float
    t_utc: str


def gpx_points(path: Path) -> list[TrackPoint]:
    """The points of a GPX 1.1 file that keeps the rules of the schema; AssertionError names the one
    that is broken."""
    root = ElementTree.parse(path).getroot()
    assert root.tag == f"{GPX}gpx"
    assert root.get("version") == "1.1"
    assert root.get("creator")
    _keeps_order(root)
    points = []
    for point in root.iter(f"{GPX}trkpt"):
        lat, lon = point.get("lat", ""), point.get("lon", "")
        height, t_utc = point.findtext(f"{GPX}ele"), point.findtext(f"{GPX}time", "")
        assert all(_DECIMAL.match(text) for text in (lat, lon, height or "0")), (lat, lon, height)
        assert -90.0 <= float(lat) <= 90.0
        assert -180.0 <= float(lon) < 180.0
        assert _DATE_TIME.match(t_utc), t_utc
        points.append(TrackPoint(float(lat), float(lon), float(height or "nan"), t_utc))
    return points


def _keeps_order(element: Element) -> None:
    name = element.tag.removeprefix(GPX)
    if name not in ORDER:
        assert not len(element), name
        return
    names = [child.tag.removeprefix(GPX) for child in element]
    places = [ORDER[name].index(found) for found in names]
    assert places == sorted(places), names
    once = [found for found in names if found not in SEVERAL]
    assert len(once) == len(set(once)), names
    for child in element:
        _keeps_order(child)


def gpsbabel_points(path: Path, kind: str, folder: Path) -> list[TrackPoint] | None:
    """What gpsbabel understands of a `gpx` or `kml` file; None where it is not installed.
    CalledProcessError for a file that it does not read."""
    program = shutil.which("gpsbabel")
    if program is None:
        return None
    out = folder / f"understood_{path.name}.gpx"
    command = (program, "-t", "-i", kind, "-f", path, "-o", "gpx,gpxver=1.1", "-F", out)
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    return gpx_points(out)
