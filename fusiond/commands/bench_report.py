"""Printed report of `fusiond bench`."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from fusiond.commands.tables import print_table

_PRODUCT = "numpy product, 21 x 21"
_KALMAN = "the same with `kalman`"
# What is timed, and what its ratio is to; `fusiond.bench.bench` says more of each.
_ROWS = {
    "block_step_ratio": ("IMU sample, in a block of 4000", _PRODUCT),
    "single_step_ratio": ("IMU sample, alone", _PRODUCT),
    "rewind_2s_ratio": ("fix that is 2 s old", _PRODUCT),
    "raw_epoch_40_ratio": ("raw epoch of 40 satellites", _PRODUCT),
    "multiscale_step_ratio": ("second of `multiscale`", _KALMAN),
    "federated_step_ratio": ("second of `federated`, 3 local filters", _KALMAN),
    "unscented_step_ratio": ("second of `unscented`", _KALMAN),
    "unscented_propagation_step_ratio": ("second of it, propagation too", _KALMAN),
    "process_epoch_ratio": ("IMU row of `process`", _PRODUCT),
    "late_tick_ratio": ("tick with a fix that is 10 s late", _PRODUCT),
    "late_raw_tick_ratio": ("tick with an RDSS fix 1.5 s late, raw GNSS", _PRODUCT),
    "reduced_order_step_ratio": ("step of 17 states", "step of 23 states"),
    "process_start_s": ("`process` before its first row", "a second"),
}


def print_bench(figures: dict[str, Any], console: Console | None = None) -> None:
    """Print the figures to `console` or standard output."""
    console = console or Console()
    versions = ", ".join(
        f"{name} {figures[name]}" for name in ("fusiond", "python", "numpy", "numba")
    )
    for line in (
        f"{figures['cpu']}; {versions}",
        f"{_PRODUCT}: {figures['numpy_product_us']} us; median of {figures['repetitions']}",
    ):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    rows = [[name, what, f"{figures[name]:.4g}", to] for name, (what, to) in _ROWS.items()]
    print_table(console, ["figure", "processor time of", "ratio", "to"], rows)
    for prefix, of in (("", "arrival to solution"), ("wired_", "bytes on a line to `nav`")):
        functions = figures[f"{prefix}fix_functions"]
        modules = figures[f"{prefix}fix_modules"]
        way = f"way of an ordinary fix, {of}: {functions} Python functions in {modules} modules"
        console.print(way, highlight=False, markup=False, soft_wrap=True)
