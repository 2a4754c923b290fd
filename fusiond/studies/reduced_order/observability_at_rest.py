r"""Observability of paper 002's 23 states at rest, the paper's argument for omitting six of them.

F and H are constant: the vehicle rests at the start of the flight under that instant's satellites,
and the radar sees its first point. Rank is that of the rows over the flight's 4000 s
(`fusiond.studies.observability`), the same as that of H, H F, ... H F^22.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fusiond.aiding.base import State
from fusiond.models.model import Model
from fusiond.navigation.strapdown import STEP_SIZE
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Path, Profile
from fusiond.studies.observability import Epoch, observability
from fusiond.studies.reduced_order import flight


def state_names(of: Model) -> list[str]:
    """Names (n,) in the order of the slots."""
    return [f"{block.name}.{state}" for block in of.blocks for state in block.states]


def rest_observability(seconds: float = flight.DURATION_S) -> dict[str, Any]:
    """Rank and unobservable directions, by GNSS alone (`gnss`) and with the radar (`gnss_sar`)."""
    of = flight.model("ins23")
    still = Profile([0.0], [0.0])
    path = Path(still, Profile([0.0], [0.5 * math.pi]), still)
    truth = Truth(path, flight.START, flight.IMU.rate_hz, 1.0)
    nav = flight.true_nav(truth)
    buffer = flight.imu_buffer(np.hstack([truth.gyro, truth.accel]))
    transitions = flight.Transitions(of, flight.IMU.gap_s)
    phi, _ = transitions.over_a_second(buffer, nav[0], 0)
    scene = flight.scenes(flight.CHOICE_S)[0]
    state = State(nav[1], np.zeros(of.size), np.zeros(STEP_SIZE), of)
    _, h, r = flight.rows(flight.measurements(scene, np.zeros(scene.rows)), state)
    names, sd = state_names(of), flight.initial_sd(of)
    out: dict[str, Any] = {}
    for case, rows in (("gnss", slice(0, -2)), ("gnss_sar", slice(None))):
        seen = observability((Epoch(phi, h[rows], r[rows]) for _ in range(round(seconds))), sd)
        out[case] = {
            "states": len(names),
            "rank": seen.rank,
            "hidden": [d.states(names) for d in seen.directions[seen.rank :]],
            "not_estimated": seen.not_estimated(names),
        }
    return out
