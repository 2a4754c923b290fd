"""The papers' models in the running daemon: `fusiond demo --paper 000` to `004`."""

from __future__ import annotations

from fusiond.demo.play import Play, Pulled
from fusiond.simulation.papers import PAPERS, configured


def paper_play(number: str) -> Play:
    """The demo of a paper, of `PAPERS`."""
    paper = PAPERS[number]
    config, scenario = configured(number)
    estimator = config.estimator
    about = {"paper": number, "filter": estimator.filter, "model": estimator.model}
    pulled = Pulled("imu", 0.0, paper.imu_comes_s) if paper.imu_comes_s else None
    return Play(
        config, scenario, paper.devices, pulled, paper.raw, f"{paper.title}: aligning", about
    )
