"""The papers' models in the running daemon: `fusiond demo --paper 000` to `004`."""

from __future__ import annotations

from fusiond.demo.scenario import DemoSetup, Unplugged
from fusiond.simulation.papers import PAPERS, configured


def paper_setup(number: str) -> DemoSetup:
    """Demo setup of one of `PAPERS`."""
    paper = PAPERS[number]
    config, scenario = configured(number)
    estimator = config.estimator
    about = {"paper": number, "filter": estimator.filter, "model": estimator.model}
    unplugged = Unplugged("imu", 0.0, paper.imu_comes_s) if paper.imu_comes_s else None
    return DemoSetup(
        config, scenario, paper.devices, unplugged, paper.raw, f"{paper.title}: aligning", about
    )
