"""Cost of an epoch of raw GNSS data: 40 satellites with two frequencies each.

From the decoded epoch, whose signals the decoder has packed, to the filter that has used it:
signals chosen, carriers followed from the epoch before, which is their anchor, satellites and
corrections computed, 80 rows (ranges, carriers) linearised, gated one by one, folded in and tested
by their residuals, the solution corrected; then what `health` and the verdicts keep. The same epoch
is repeated after the same previous one, so the choice of signals and ephemerides stays valid, as
for up to 10 s in the daemon.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count

import numpy as np

from drivers.raw.messages import RawGnssEpoch, System
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.update_with_exclusion import KEPT
from fusiond.gnss.orbit import is_beidou_geo
from fusiond.models.blocks import CARRIER_CLOCK
from fusiond.models.catalogue import make_model
from fusiond.navigator.intake import Intake
from fusiond.navigator.raw_gnss import RawGnss
from fusiond.simulation.gnss.raw import GnssRaw, GnssRawOptions
from fusiond.simulation.scenarios import SCENARIOS

SATELLITES = 40
SIGNALS: tuple[tuple[System, str], ...] = (("C", "2I"), ("C", "6I"), ("G", "1C"), ("G", "2L"))
EPOCHS = 100


def raw_epoch(_: int) -> Callable[[], int]:
    """Work of `EPOCHS` epochs, each processed as in the daemon."""
    truth = SCENARIOS["drive"].truth(10.0)
    receiver = GnssRaw(truth, GnssRawOptions(signals=SIGNALS), np.random.default_rng(1))
    section = RawAiding(systems=("G", "C"))
    intake = Intake({"gnss": section})
    raw = intake.receivers["gnss"]
    crowd = Crowd(receiver, 10, raw)
    before, epoch = (crowd.of(receiver.epoch(at)) for at in (10, 11))
    start = truth.at(np.array([epoch.tow_s - receiver.start[1]]))
    imu = Imu()
    model = make_model("ins21", imu_noise(imu), *intake.extra_blocks())
    estimator = KalmanEstimator(model, imu.gap_s)
    place = start.position[0]
    nav = np.array([*place, *start.v_ned[0], 1.0, 0.0, 0.0, 0.0])
    sigma = model.initial.copy()
    sigma[:9] = [0.01] * 2 + [0.05] + [0.1] * 3 + [3.0] * 3
    estimator.initialise(0, 0, nav, np.zeros(model.size), np.diag(sigma**2))

    instants = count(1)
    first = raw.measurement(before, 0)
    estimator.update(first.at(nav))  # the carriers' anchor
    # Replaces a propagation: vehicle and clock have moved since the last epoch.
    for slot in (6, 7, 8, *model.slots_of(CARRIER_CLOCK)):
        estimator.covariance[slot, slot] += 10.0**2

    def work() -> int:
        for _ in range(EPOCHS):
            raw.recent[:] = [first]
            measurement = raw.measurement(epoch, next(instants))
            outcome = estimator.update(measurement.at(nav))
            assert outcome.name == "fused"
            assert outcome.rows == (KEPT,) * (2 * SATELLITES)
            measurement.judged(outcome.rows, outcome.whitened)
            measurement.series(outcome.whitened, outcome.rows)
        return EPOCHS

    work()
    return work


class Crowd:
    """Epochs of a receiver with 40 satellites each, whose ephemerides `raw` has.

    Half of them are doubles under numbers that the simulated constellations leave free, BeiDou's of
    the same kind of orbit.
    """

    def __init__(self, receiver: GnssRaw, at: int, raw: RawGnss, source: str = "gnss") -> None:
        self._source = source
        for model in receiver.ionosphere:
            raw.learn(model)
        geostationary, others = iter(range(1, 6)), iter(range(6, 23))
        gps = iter(range(33, 64))
        self._doubles: dict[tuple[System, int], int] = {}
        for s in receiver.epoch(at).signals:
            if (s.system, s.prn) in self._doubles:
                continue
            free = gps if s.system == "G" else others
            if is_beidou_geo(s.system, s.prn):
                free = geostationary
            self._doubles[s.system, s.prn] = next(free)
        for e in receiver.broadcast(float(receiver.t_s[at]), set(self._doubles)):
            raw.learn(e)
            raw.learn(replace(e, prn=self._doubles[e.system, e.prn]))
        self._few = set(list(self._doubles)[: SATELLITES - len(self._doubles)])

    def of(self, epoch: RawGnssEpoch) -> RawGnssEpoch:
        """Epoch with the doubled satellites added."""
        copied = [
            replace(s, prn=self._doubles[s.system, s.prn])
            for s in epoch.signals
            if (s.system, s.prn) in self._few
        ]
        return replace(epoch, source=self._source, signals=(*epoch.signals, *copied))
