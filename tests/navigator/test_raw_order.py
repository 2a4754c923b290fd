"""Raw epochs in any order of arrival: one solution, bit for bit."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from fusiond.configuration.schema import Config
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.gnss.raw import GnssRaw, GnssRawOptions
from tests.navigator.vehicle import CONFIG, START_NS, STARTED_S, drive, outcomes_of, state_bytes

CHUNK = 10
SOURCE = "simulation"


@lru_cache(maxsize=1)
def receiver() -> GnssRaw:
    options = GnssRawOptions(rate_hz=2.0)
    return GnssRaw(drive().truth, options, np.random.default_rng(5))


def navigated(delays_s: list[float]) -> Navigator:
    """Epoch k arrives `delays_s[k % n]` after it was true; all ephemerides are known at once."""
    sim, d = receiver(), drive()
    navigator = Navigator(Config.model_validate({**CONFIG, "aiding": {SOURCE: {"kind": "raw"}}}))
    epochs = [(float(sim.t_s[k]), sim.epoch(k)) for k in range(len(sim))]
    epochs = [(t, e) for t, e in epochs if t > STARTED_S]
    satellites = {(s.system, s.prn) for _, e in epochs for s in e.signals}
    for message in (*sim.broadcast(0.0, satellites), *sim.ionosphere):
        navigator.raw[SOURCE].learn(message)
    arrivals = sorted((t + delays_s[k % len(delays_s)], k) for k, (t, _) in enumerate(epochs))
    for first in range(0, len(d.times), CHUNK):
        rows = slice(first, first + CHUNK)
        navigator.add_imu(d.times[rows], d.samples[rows])
        now_s = (int(d.times[rows][-1]) - START_NS) * 1e-9
        last = rows.stop >= len(d.times)
        while arrivals and (arrivals[0][0] <= now_s or last):
            t_s, epoch = epochs[arrivals.pop(0)[1]]
            assert navigator.add(epoch, START_NS + round(t_s * 1e9)) == "accepted"
        navigator.advance()
    return navigator


def state(navigator: Navigator) -> tuple[Any, ...]:
    return *state_bytes(navigator), outcomes_of(navigator), navigator.raw[SOURCE].sky().used


def test_the_epochs_are_used() -> None:
    outcomes = navigated([0.0]).timeline.counters.outcomes[SOURCE]
    assert outcomes["fused"] > 60


@pytest.mark.parametrize("delays_s", [[0.5], [2.0], [0.5, 1.9, 0.0, 1.2]])
def test_the_delay_of_raw_epochs_leaves_no_trace(delays_s: list[float]) -> None:
    """Late by 0.5 to 2 s, at 10 m/s: the filter was 5 to 20 m away when they came in."""
    assert state(navigated(delays_s)) == state(navigated([0.0]))
