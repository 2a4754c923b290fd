"""Printed report of an error-state model: states with units, noise and initial sigma."""

from __future__ import annotations

import math
from typing import Any

from rich.console import Console

from fusiond.commands.tables import print_table
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG, DEG_PER_HOUR, MILLI_G
from fusiond.navigator.assembly import model_of
from fusiond.navigator.intake import Intake

# SI unit of a state: the unit that data sheets print, and how many SI units one of it is.
_FIELD_UNITS = {
    "rad": ("deg", DEG),
    "rad/s": ("deg/h", DEG_PER_HOUR),
    "m/s^2": ("mg", MILLI_G),
    "1": ("ppm", 1e-6),
}
_ROOT_HOUR = 60.0


def model_report(name: str, config: Config | None) -> dict[str, Any]:
    """The model with a configuration's IMU and measurements, or with the defaults; SI units.

    `states`: one record a state: `name`, `unit`, `initial_sigma` (None: set by the alignment),
    `white_noise` (unit/sqrt(s)), and `markov_sigma` with `correlation_s` where it decays.
    """
    config = config or Config()
    extra = Intake(config.aiding).extra_blocks()
    estimator = config.estimator.model_copy(update={"model": name})
    model = model_of(config.model_copy(update={"estimator": estimator}), *extra)
    states = []
    for block in model.blocks:
        for state in block.states:
            markov = math.isfinite(block.tau_s)
            states.append(
                {
                    "name": f"{block.name}.{state}",
                    "unit": block.unit,
                    "initial_sigma": block.initial or None,
                    "white_noise": math.sqrt(block.white),
                    "markov_sigma": block.steady if markov else None,
                    "correlation_s": block.tau_s if markov else None,
                    "rate": block.rate or None,
                }
            )
    return {"model": name, "size": len(states), "hold_height": model.hold_height, "states": states}


def print_model(report: dict[str, Any], console: Console | None = None) -> None:
    """Print a model in the units of data sheets, to `console` or standard output."""
    console = console or Console()
    held = ", height held" if report["hold_height"] else ""
    console.print(f"{report['model']}: {report['size']} states{held}", highlight=False)
    rows = []
    for state in report["states"]:
        unit, factor = _FIELD_UNITS.get(state["unit"], (state["unit"], 1.0))
        initial = state["initial_sigma"]
        noise = "-"
        if state["white_noise"]:
            noise = f"{state['white_noise'] * _ROOT_HOUR / factor:.4g} {unit}/sqrt(h)"
        markov = "-"
        if state["markov_sigma"] is not None:
            markov = f"{state['markov_sigma'] / factor:.4g} {unit}, {state['correlation_s']:.4g} s"
        elif state["rate"]:
            markov = f"integral of {state['rate']}"
        start = "alignment" if initial is None else f"{initial / factor:.4g} {unit}"
        rows.append([state["name"], unit, start, noise, markov])
    print_table(console, ["state", "unit", "initial sigma", "white noise", "Markov part"], rows)
