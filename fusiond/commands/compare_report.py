"""Printed report of `fusiond compare`: a rich table on a terminal, plain text in a pipe."""

from __future__ import annotations

from rich.console import Console

from fusiond.commands.tables import print_table
from fusiond.offline.compare import Report

_ROWS = (
    *((name, "m") for name in ("horizontal", "north", "east", "down")),
    *((name, "m_s") for name in ("v_horizontal", "v_n", "v_e", "v_d")),
    *((name, "deg") for name in ("roll", "pitch", "yaw")),
)
_UNITS = {"m": "m", "m_s": "m/s", "deg": "deg"}


def print_report(report: Report, console: Console | None = None) -> None:
    """Print the report to `console` or standard output."""
    console = console or Console()
    heading = (
        f"{report['epochs']} epochs, {report['t_first_s']:.3f} to {report['t_last_s']:.3f} s; "
        f"{report['epochs_not_covered']} not covered by the solution"
    )
    errors = [
        [
            name,
            *(f"{report[f'{name}_{what}_{unit}']:.4f}" for what in ("rms", "p95", "max")),
            _UNITS[unit],
        ]
        for name, unit in _ROWS
        if report[f"{name}_rms_{unit}"] is not None
    ]
    shares = [
        [f"inside {k} sigma horizontally", f"{100 * share:.1f} %", f"{100 * expected:.1f} %"]
        for k in (1, 2, 3)
        if (share := report[f"horizontal_inside_{k}_sigma"]) is not None
        and (expected := report[f"expected_inside_{k}_sigma"]) is not None
    ]
    if report["position_nees"] is not None:
        shares += [
            ["mean NEES, horizontal", f"{report['horizontal_nees']:.2f}", "2"],
            ["mean NEES, position", f"{report['position_nees']:.2f}", "3"],
        ]
    console.print(heading, highlight=False, soft_wrap=True)
    print_table(console, ["error", "RMS", "95 %", "max", ""], errors)
    if shares:
        print_table(console, ["consistency", "found", "Gaussian"], shares)
