"""Attitude and velocity sigmas of paper 002's flight, for JSON, tables and pictures.

Axes are east, north, up as in the paper; attitude is in arc seconds, velocity in m/s.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.studies.figure_file import save_figure
from fusiond.studies.reduced_order.flight import ARC_SECOND

Array = NDArray[np.float64]

EAST_NORTH_UP = [1, 0, 2]
AXES = ("E", "N", "U")
AXIS_NAMES = {"E": "east", "N": "north", "U": "up"}
HEADER = ["", *(f'phi {a} "' for a in AXES), *(f"dV {a} m/s" for a in AXES), "us/step"]
KEYS = ("attitude_sigma_arcsec", "velocity_sigma_m_s")
BELIEVED = ("believed_attitude_sigma_arcsec", "believed_velocity_sigma_m_s")

PAPER: dict[str, Any] = {
    "source": "paper 002, tables 1 and 2: 120 E, 30 N, 1000 m, due east, 300 m/s, 4000 s",
    "models": {
        "23": {
            "attitude_sigma_arcsec": [33.11, 36.25, 33.08],
            "velocity_sigma_m_s": [0.023, 0.0163, 0.002],
            "time_per_step_us": 110_000,
        },
        "17": {
            "attitude_sigma_arcsec": [36.52, 65.62, 56.11],
            "velocity_sigma_m_s": [0.0609, 0.0384, 0.008],
            "time_per_step_us": 50_000,
        },
    },
    "time_ratio": 0.45,
    "not_printed": "measurement noise, radar misalignment, white IMU noise, initial sigma",
}


def east_north_up(p: Array) -> tuple[list[float], list[float]]:
    """Attitude (arc seconds) and velocity (m/s), one sigma each, of a covariance (n, n)."""
    sd = np.sqrt(np.diag(p)[:6])
    attitude = sd[:3][EAST_NORTH_UP] / ARC_SECOND
    return attitude.tolist(), sd[3:6][EAST_NORTH_UP].tolist()


def sigmas(p: Array, keys: tuple[str, str] = KEYS) -> dict[str, list[float]]:
    """Attitude and velocity sigmas of a covariance (n, n)."""
    return dict(zip(keys, east_north_up(p), strict=True))


def list_of(values: Sequence[float], digits: int) -> str:
    """Figures of the axes, in a sentence."""
    return "/".join(f"{v:.{digits}f}" for v in values)


def sigma_cells(of: dict[str, Any], keys: tuple[str, str] = KEYS) -> list[str]:
    """Six cells of a row under `HEADER`."""
    attitude, velocity = keys
    return [*(f"{v:.2f}" for v in of[attitude]), *(f"{v:.4f}" for v in of[velocity])]


def paper_rows() -> list[list[str]]:
    """Rows under `HEADER`."""
    return [
        [f"{name} paper", *sigma_cells(of), f"{of['time_per_step_us']:.0f}"]
        for name, of in PAPER["models"].items()
    ]


def curves(of: Iterable[Array]) -> dict[str, list[list[float]]]:
    """Curves of both figures over time, from covariances (n, n), for `picture`."""
    found = [east_north_up(p) for p in of]
    return {key: [figures[k] for figures in found] for k, key in enumerate(KEYS)}


def picture(series: dict[str, Any], path: Path) -> None:
    """Plot sigmas over time: attitude left, velocity right, one row an axis; the filter's own are
    dashed.

    `series`: instants `t_s`, and of each of `models` the `true` and the `believed` `curves` there.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[studies]`)

    figure = Figure(figsize=(11.0, 8.0), layout="constrained")
    axes = figure.subplots(3, 2, sharex=True)
    for column, (key, unit) in enumerate(zip(KEYS, ("arc seconds", "m/s"), strict=True)):
        for row, axis in enumerate(AXES):
            panel = axes[row, column]
            for number, (name, found) in enumerate(series["models"].items()):
                for what, line in (("true", "-"), ("believed", "--")):
                    values = [sigma[row] for sigma in found[what][key]]
                    label = _label(name) if what == "true" else None
                    panel.plot(series["t_s"], values, line, color=f"C{number}", label=label)
            for number, of in enumerate(PAPER["models"].values()):
                panel.axhline(of[key][row], color=f"C{number}", linewidth=0.8, linestyle=":")
            panel.set_yscale("log")
            panel.set_ylabel(f"{AXIS_NAMES[axis]}, {unit}")
            panel.grid(alpha=0.3)
    figure.suptitle("one sigma: true (solid), believed by the filter (dashed), paper (dotted)")
    axes[0, 0].set_title("attitude", loc="left")
    axes[0, 1].set_title("velocity", loc="left")
    axes[0, 1].legend(fontsize="small")
    for panel in axes[2]:
        panel.set_xlabel("s")
    save_figure(figure, path)


def _label(name: str) -> str:
    """Label of a filter: its states, then what is particular."""
    particular = {
        "bare": "biases dropped",
        "four": "four satellites",
        "all": "all in view",
    }
    states = "".join(word for word in name.split("_") if word not in particular)
    more = [particular[word] for word in name.split("_") if word in particular]
    return ", ".join([f"{states} states", *more])
