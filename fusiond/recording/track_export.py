"""Export of a log's track: GPX 1.1, KML 2.2, GeoJSON (RFC 7946).

From `/location`'s own source, `/nav`: points that are navigated, ten a second or what
`mqtt.nav_rate_hz` was, thinned to `interval_s`. Heights are above the ellipsoid; GPX and KML expect
the sea's, which differs by the geoid (up to 100 m): the files say so.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TextIO
from xml.sax.saxutils import escape, quoteattr

from fusiond.recording.reader import Log

_NAVIGATED = ("navigating", "coasting")
_ANTIMERIDIAN = "180.000000000"
"""Longitude that GPX 1.1 excludes (longitudeType: below 180)."""
_HEIGHTS = "heights above the ellipsoid WGS 84"


class Point(NamedTuple):
    """A point of the track; `t_utc` ISO, degrees, m above the ellipsoid where that is known."""

    t_utc: str
    t_ms: int
    lat_deg: float
    lon_deg: float
    height_m: float | None
    mode: str
    sigma_m: float | None


def track(recording: Log, interval_s: float) -> Iterator[Point]:
    """The navigated points, at least `interval_s` apart."""
    last_ms: int | None = None
    for message in recording.messages("/nav"):
        nav = message.json()
        t_ms = nav["t_ms"]
        if nav["mode"] not in _NAVIGATED or nav["lat_deg"] is None or t_ms is None:
            continue
        if last_ms is not None and 0 <= t_ms - last_ms < interval_s * 1e3:
            continue
        last_ms = t_ms
        sigmas = nav["sd_n_m"], nav["sd_e_m"]
        sigma = None if None in sigmas else round(max(sigmas), 3)
        yield Point(
            nav["t_utc"],
            t_ms,
            nav["lat_deg"],
            nav["lon_deg"],
            nav["height_m"],
            nav["mode"],
            sigma,
        )


def export(recording: Log, out: Path, kind: str, interval_s: float) -> int:
    """Write the track as `gpx`, `kml` or `geojson` and return the number of points. OSError
    passes."""
    points = list(track(recording, interval_s))
    with out.open("w", encoding="utf-8") as file:
        WRITERS[kind](file, recording.about.metadata["vehicle"], points)
    return len(points)


def _gpx(file: TextIO, vehicle: str, points: list[Point]) -> None:
    file.write(
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<gpx version="1.1" creator="fusiond" xmlns="http://www.topografix.com/GPX/1/1">\n'
        f"<trk><name>{escape(vehicle)}</name><desc>{_HEIGHTS}</desc><trkseg>\n"
    )
    for p in points:
        lon = f"{p.lon_deg:.9f}"
        if lon == _ANTIMERIDIAN:
            lon = f"-{lon}"
        elevation = "" if p.height_m is None else f"<ele>{p.height_m:.3f}</ele>"
        file.write(
            f"<trkpt lat={quoteattr(f'{p.lat_deg:.9f}')} lon={quoteattr(lon)}>"
            f"{elevation}<time>{p.t_utc}</time><cmt>{p.mode}</cmt></trkpt>\n"
        )
    file.write("</trkseg></trk>\n</gpx>\n")


def _kml(file: TextIO, vehicle: str, points: list[Point]) -> None:
    """Write a track with its times (the extension gx:Track of KML 2.2)."""
    file.write(
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2" '
        'xmlns:gx="http://www.google.com/kml/ext/2.2">\n'
        f"<Document><name>{escape(vehicle)}</name><description>{_HEIGHTS}</description>\n"
        f"<Placemark><name>{escape(vehicle)}</name><gx:Track><altitudeMode>clampToGround</altitudeMode>\n"
    )
    file.writelines(f"<when>{p.t_utc}</when>\n" for p in points)
    for p in points:  # on the ground, whatever stands for the height
        height = 0.0 if p.height_m is None else p.height_m
        file.write(f"<gx:coord>{p.lon_deg:.9f} {p.lat_deg:.9f} {height:.3f}</gx:coord>\n")
    file.write("</gx:Track></Placemark></Document>\n</kml>\n")


def _geojson(file: TextIO, vehicle: str, points: list[Point]) -> None:
    """Write one LineString for each stretch of one mode, so that a map can colour them, with
    times."""
    features: list[dict[str, object]] = []
    stretch: list[Point] = []
    for p in points:
        if stretch and p.mode != stretch[-1].mode:
            features.append(_stretch(stretch))
            stretch = stretch[-1:]  # the stretches meet
        stretch.append(p)
    if stretch:
        features.append(_stretch(stretch))
    properties = {"vehicle": vehicle, "heights": _HEIGHTS}
    json.dump({"type": "FeatureCollection", "properties": properties, "features": features}, file)


def _stretch(points: list[Point]) -> dict[str, object]:
    line = [[p.lon_deg, p.lat_deg, *([] if p.height_m is None else [p.height_m])] for p in points]
    if len(line) == 1:
        line *= 2  # a line has two positions at least (RFC 7946, 3.1.4)
    return {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": line},
        "properties": {
            "mode": points[-1].mode,
            "begin_utc": points[0].t_utc,
            "end_utc": points[-1].t_utc,
            "t_ms": [p.t_ms for p in points],
            "sigma_m": [p.sigma_m for p in points],
        },
    }


WRITERS: dict[str, Callable[[TextIO, str, list[Point]], None]] = {
    "gpx": _gpx,
    "kml": _kml,
    "geojson": _geojson,
}
