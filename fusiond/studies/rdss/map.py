"""Study `rdss-map`: sigma north and east of an RDSS fix by geometry, over latitude and longitude.

`fusiond.aiding.rdss_fix_covariance` gives the linearised covariance on a grid; the part of the
ranges and the part of the height stand apart, as in paper 000, eq. 4. At named places the nonlinear
positioning equations are solved with drawn errors as well, so that the linearisation answers for
itself, and three readings of the paper's ranging error are compared with its "30 m".
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from fusiond.aiding.base import Array, NotApplicable
from fusiond.aiding.rdss_fix_covariance import (
    ELEVATION_MASK_RAD,
    GEOSTATIONARY_RADIUS_M,
    MAX_AMPLIFICATION,
    RdssGeometry,
)
from fusiond.navigation.earth import (
    ECCENTRICITY_SQUARED,
    SEMI_MAJOR_M,
    meridian_radius,
    transverse_radius,
)
from fusiond.studies.figure_file import save_figure
from fusiond.studies.monte_carlo import Progress

SATELLITE_M = 8.0
RANGING_M = 13.0
SD_HEIGHT_M = 10.0
"""Paper 000, section 3: after differential correction, one sigma."""
SD_RANGE_M = math.hypot(SATELLITE_M, RANGING_M)
PAPER_FIX_M = 30.0

LATITUDES_DEG = tuple(range(5, 56))
LONGITUDES_GRID_DEG = tuple(70.0 + 2.5 * i for i in range(29))
PLACES: dict[str, tuple[float, float]] = {
    "Sanya": (18.3, 109.5),
    "Guangzhou": (23.1, 113.3),
    "Wuhan": (30.6, 114.3),
    "Yantai": (37.5, 121.4),
    "Beijing": (39.9, 116.4),
    "Urumqi": (43.8, 87.6),
    "Harbin": (45.8, 126.5),
}
"""Latitude and longitude, deg. Yantai is where the authors of paper 000 worked."""
DRAWS = 2000
CONFIDENCE = 0.99
CENTRE_DEG = (39.9, 116.4)
"""Place of the centre: any that sees both satellites, since its own legs are known and drop out."""


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study: map, places, and `runs` nonlinear solutions at each place (default 2000).

    Cells without a fix are None, with the reason under `outcome`. All lengths in m, one sigma.
    """
    geometry = RdssGeometry()
    draws = DRAWS if runs is None else runs
    if draws < 2:
        raise ValueError("runs must be at least 2")
    steps = len(LATITUDES_DEG) + len(PLACES)
    axes = {k: _empty_axis() for k in ("north", "east")}
    correlation: list[list[float | None]] = []
    outcome: list[list[str | None]] = []
    for row, lat in enumerate(LATITUDES_DEG):
        cells = [_cell(geometry, float(lat), lon) for lon in LONGITUDES_GRID_DEG]
        for name, parts in axes.items():
            for part, lines in parts.items():
                lines.append([c.get(f"{name}_{part}") for c in cells])
        correlation.append([c.get("correlation") for c in cells])
        outcome.append([c.get("outcome") for c in cells])
        if progress is not None:
            progress(row + 1, steps)
    rng = np.random.default_rng(seed)
    places: list[dict[str, Any]] = []
    for name, place in PLACES.items():
        places.append(
            {"place": name, "lat_deg": place[0], "lon_deg": place[1]}
            | _cell(geometry, *place)
            | {"readings": _readings(geometry, *place)}
            | {"nonlinear": _nonlinear(geometry, *place, draws, rng)}
        )
        if progress is not None:
            progress(len(LATITUDES_DEG) + len(places), steps)
    return {
        "study": "rdss-map",
        "satellites_deg": list(geometry.longitudes_deg),
        "sd_range_m": SD_RANGE_M,
        "sd_height_m": SD_HEIGHT_M,
        "elevation_mask_deg": math.degrees(ELEVATION_MASK_RAD),
        "max_amplification": MAX_AMPLIFICATION,
        "runs": draws,
        "seed": seed,
        "latitudes_deg": [float(x) for x in LATITUDES_DEG],
        "longitudes_deg": list(LONGITUDES_GRID_DEG),
        **axes,
        "correlation": correlation,
        "outcome": outcome,
        "places": places,
        "paper": {
            "sd_satellite_m": SATELLITE_M,
            "sd_ranging_m": RANGING_M,
            "sd_height_m": SD_HEIGHT_M,
            "fix_m": PAPER_FIX_M,
            "sum_without_geometry_m": SATELLITE_M + RANGING_M + SD_HEIGHT_M,
            "root_sum_square_without_geometry_m": math.hypot(SD_RANGE_M, SD_HEIGHT_M),
        },
    }


def table(
    result: dict[str, Any], longitudes_deg: tuple[float, ...] = (70, 90, 110, 130, 140)
) -> str:
    """Text for the terminal: sigma north / east every 5 deg, their parts, and the places."""
    columns = [result["longitudes_deg"].index(x) for x in longitudes_deg]
    rows = range(0, len(result["latitudes_deg"]), 5)
    head = "lat deg N " + "".join(f"{f'{x:.0f} E':>15}" for x in longitudes_deg)
    lines: list[str] = []
    for part, title in (
        ("total", f"ranges {result['sd_range_m']:.1f} m, height {result['sd_height_m']:.0f} m"),
        ("ranging", "the ranges' part"),
        ("height", "the height's part"),
    ):
        lines += [f"sigma north / east, m: {title}", head]
        for i in rows:
            pairs = [(result["north"][part][i][j], result["east"][part][i][j]) for j in columns]
            text = "".join(f"{'-' if n is None else f'{n:.1f} / {e:.1f}':>15}" for n, e in pairs)
            lines.append(f"{result['latitudes_deg'][i]:>9.0f} {text}")
        lines.append("")
    lines.append(
        f"{'place':<10}{'north':>8}{'east':>8}{'correl.':>9}{'radial':>8}"
        f"{'nonlinear radial':>18}{'NEES/2':>8}"
    )
    for place in result["places"]:
        monte = place["nonlinear"]
        lines.append(
            f"{place['place']:<10}{place['north_total']:>8.1f}{place['east_total']:>8.1f}"
            f"{place['correlation']:>9.2f}{place['radial']:>8.1f}"
            f"{monte['radial_m']:>18.1f}{monte['nees_per_dof']:>8.3f}"
        )
    low, high = result["places"][0]["nonlinear"]["interval"]
    lines.append(f"NEES/2 of a matched covariance lies in [{low:.3f}, {high:.3f}] (99 %)")
    return "\n".join(lines)


def _empty_axis() -> dict[str, list[list[float | None]]]:
    return {"total": [], "ranging": [], "height": []}


def _cell(geometry: RdssGeometry, lat_deg: float, lon_deg: float) -> dict[str, Any]:
    found = geometry.covariance(
        math.radians(lat_deg), math.radians(lon_deg), 0.0, SD_RANGE_M, SD_HEIGHT_M
    )
    if isinstance(found, NotApplicable):
        return {"outcome": found.outcome}
    cell = {
        f"{axis}_{part}": round(math.sqrt(matrix[i, i]), 3)
        for i, axis in enumerate(("north", "east"))
        for part, matrix in found._asdict().items()
    }
    total = found.total
    cell["correlation"] = round(total[0, 1] / math.sqrt(total[0, 0] * total[1, 1]), 4)
    cell["radial"] = round(math.sqrt(np.trace(total)), 3)
    return cell


# ------------------------------------------------------- what the paper's 13 m may be


def _readings(geometry: RdssGeometry, lat_deg: float, lon_deg: float) -> dict[str, Any]:
    """Sigma of the fix for three interpretations of `SD_RANGE_M`, height part included.

    `slant`: each one-way slant range, independent (what the filter uses). `path`: each measured
    path length L1, L2, independent. `common`: the same error in both slant ranges.
    """
    found = geometry.sensitivity(math.radians(lat_deg), math.radians(lon_deg), 0.0)
    if isinstance(found, NotApplicable):
        return {"outcome": found.outcome}
    from_paths = np.array([[0.5, 0.0], [-0.5, 1.0]])  # rho_1 = L1 / 2, rho_2 = L2 - L1 / 2
    shapes = {"slant": np.eye(2), "path": from_paths @ from_paths.T, "common": np.ones((2, 2))}
    height = SD_HEIGHT_M**2 * np.outer(found.height, found.height)
    readings: dict[str, Any] = {}
    for name, shape in shapes.items():
        p = SD_RANGE_M**2 * (found.ranges @ shape @ found.ranges.T) + height
        north, east, radial = (math.sqrt(x) for x in (p[0, 0], p[1, 1], np.trace(p)))
        readings[name] = {"north_m": north, "east_m": east, "radial_m": radial}
    return readings


# ------------------------------------------------------- the nonlinear equations


def path_lengths(
    lat: Array, lon: Array, height: Array, longitudes_deg: tuple[float, float]
) -> Array:
    """Measurements of the centre, (n, 2) m: out through satellite 1, back through 1 and through 2.

    All four legs centre-satellite-terminal-satellite-centre. Place (n,) rad, rad, m.
    """
    angles = np.radians(longitudes_deg)
    satellites = GEOSTATIONARY_RADIUS_M * np.array([np.cos(angles), np.sin(angles), 0.0 * angles])
    centre = _ecef(np.radians(CENTRE_DEG[0]), np.radians(CENTRE_DEG[1]), np.zeros(()))
    known = np.linalg.norm(satellites.T - centre, axis=1)
    slant = np.linalg.norm(_ecef(lat, lon, height)[:, None, :] - satellites.T, axis=2)
    up_1 = known[0] + slant[:, 0]
    return np.stack([up_1 + slant[:, 0] + known[0], up_1 + slant[:, 1] + known[1]], axis=1)


def locate(
    paths: Array, height: Array, start: tuple[float, float], longitudes_deg: tuple[float, float]
) -> tuple[Array, Array]:
    """Latitude and longitude (n,), rad, for path lengths `paths` (n, 2) at `height` (n,).

    Newton's method from `start` (rad); ArithmeticError where it does not come to 1 um.
    """
    lat = np.full(len(paths), start[0])
    lon = np.full(len(paths), start[1])
    step = 1e-6  # rad, about 6 m
    for _ in range(20):
        here = path_lengths(lat, lon, height, longitudes_deg)
        by_lat = (path_lengths(lat + step, lon, height, longitudes_deg) - here) / step
        by_lon = (path_lengths(lat, lon + step, height, longitudes_deg) - here) / step
        move = np.linalg.solve(np.stack([by_lat, by_lon], axis=2), (paths - here)[..., None])
        lat, lon = lat + move[:, 0, 0], lon + move[:, 1, 0]
        if float(np.max(np.abs(move))) < 1e-6 / SEMI_MAJOR_M:
            return lat, lon
    raise ArithmeticError("positioning equations not solved in 20 steps")


def _nonlinear(
    geometry: RdssGeometry, lat_deg: float, lon_deg: float, draws: int, rng: np.random.Generator
) -> dict[str, Any]:
    """Errors of solved fixes against the linearised covariance."""
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    found = geometry.covariance(lat, lon, 0.0, SD_RANGE_M, SD_HEIGHT_M)
    if isinstance(found, NotApplicable):
        return {"outcome": found.outcome}
    errors = fix_errors(geometry, lat, lon, draws, rng)
    nees = float(np.mean(np.sum(errors @ np.linalg.inv(found.total) * errors, axis=1)))
    tail = 0.5 * (1.0 - CONFIDENCE)
    return {
        "north_m": float(np.sqrt(np.mean(errors[:, 0] ** 2))),
        "east_m": float(np.sqrt(np.mean(errors[:, 1] ** 2))),
        "radial_m": float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))),
        "nees_per_dof": nees / 2.0,
        "interval": [float(chi2.ppf(q, 2 * draws)) / (2 * draws) for q in (tail, 1.0 - tail)],
    }


def fix_errors(
    geometry: RdssGeometry, lat_rad: float, lon_rad: float, draws: int, rng: np.random.Generator
) -> Array:
    """North and east errors (draws, 2), m, of solved fixes with drawn range and height errors."""
    slant = rng.normal(0.0, SD_RANGE_M, (draws, 2))
    paths = path_lengths(
        np.full(draws, lat_rad), np.full(draws, lon_rad), np.zeros(draws), geometry.longitudes_deg
    )
    paths += np.stack([2.0 * slant[:, 0], slant[:, 0] + slant[:, 1]], axis=1)
    height = rng.normal(0.0, SD_HEIGHT_M, draws)
    lat, lon = locate(paths, height, (lat_rad, lon_rad), geometry.longitudes_deg)
    return np.stack(
        [
            (lat - lat_rad) * meridian_radius(lat_rad),
            (lon - lon_rad) * transverse_radius(lat_rad) * math.cos(lat_rad),
        ],
        axis=1,
    )


def _ecef(lat: Array, lon: Array, height: Array) -> Array:
    """Earth-fixed place (..., 3), m."""
    transverse = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
    return np.stack(
        [
            (transverse + height) * np.cos(lat) * np.cos(lon),
            (transverse + height) * np.cos(lat) * np.sin(lon),
            (transverse * (1.0 - ECCENTRICITY_SQUARED) + height) * np.sin(lat),
        ],
        axis=-1,
    )


# ------------------------------------------------------- picture


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot three maps: sigma north, sigma east, and displacement by the height's error.

    Needs matplotlib. The suffix of `path` chooses the format.
    """
    import matplotlib.patheffects as effects  # noqa: PLC0415 -- an extra, wanted here only
    from matplotlib.figure import Figure  # noqa: PLC0415

    def grid(axis: str, part: str) -> Array:
        return np.array(result[axis][part], dtype=float)  # None becomes NaN

    lat, lon = result["latitudes_deg"], result["longitudes_deg"]
    height = np.hypot(grid("north", "height"), grid("east", "height"))
    panels: tuple[tuple[str, Array, tuple[float, ...]], ...] = (
        ("$\\sigma$ north, m", grid("north", "total"), (15, 20, 25, 30, 40, 50, 70, 100, 150, 200)),
        ("$\\sigma$ east, m", grid("east", "total"), (17, 17.5, 18, 18.5, 19, 19.5, 20, 20.5)),
        (
            f"part of the height (sigma {result['sd_height_m']:.0f} m), nearly all north, m",
            height,
            (4, 5, 6, 8, 10, 15, 20, 30, 50, 70, 100),
        ),
    )
    figure = Figure(figsize=(17.0, 4.9), layout="constrained")
    for axes, (title, values, levels) in zip(
        figure.subplots(1, 3, sharey=True), panels, strict=True
    ):
        axes.set_facecolor("0.88")
        shades = np.linspace(0.05, 0.8, len(levels) - 1)
        colours = [(1.0 - 0.75 * q, 1.0 - 0.55 * q, 1.0 - 0.25 * q) for q in shades]
        axes.contourf(lon, lat, values, levels=levels, colors=colours)
        lines = axes.contour(lon, lat, values, levels=levels, colors="0.15", linewidths=0.8)
        axes.clabel(lines, fmt="%g", fontsize=9)
        for place in result["places"]:
            axes.plot(place["lon_deg"], place["lat_deg"], "o", color="#b02a1a", markersize=4)
            axes.annotate(
                place["place"],
                (place["lon_deg"], place["lat_deg"]),
                xytext=(4, 3),
                textcoords="offset points",
                fontsize=8,
                color="#7a1a10",
                path_effects=[effects.withStroke(linewidth=2, foreground="white", alpha=0.7)],
            )
        for satellite in result["satellites_deg"]:
            axes.axvline(satellite, color="0.25", linestyle=":", linewidth=1.2)
        axes.set(title=title, xlabel="longitude, deg E", aspect="equal")
        axes.set(xlim=(lon[0], lon[-1]), ylim=(lat[0], lat[-1]))
    figure.axes[0].set_ylabel("latitude, deg N")
    west, east = result["satellites_deg"]
    figure.suptitle(
        f"RDSS fix, satellites at {west:g} and {east:g} deg E (dotted), one sigma: "
        f"slant ranges {result['sd_range_m']:.1f} m each, height {result['sd_height_m']:.0f} m. "
        f"Grey: a satellite below {result['elevation_mask_deg']:.0f} deg."
    )
    save_figure(figure, path)
