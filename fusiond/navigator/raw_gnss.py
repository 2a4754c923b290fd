r"""Tight coupling: a receiver's raw epochs become aids of corrected ranges and rates.

What a receiver broadcasts on (ephemerides, ionosphere) is kept; each epoch is corrected for the
place where the vehicle is thought to be (100 m off moves a correction by 1 cm), and the solution of
the epoch alone says that place before there is a filter, and starts its alignment.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.raw.messages import SYSTEMS, Ephemeris, Klobuchar, RawGnssEpoch
from fusiond.aiding.base import Aid
from fusiond.aiding.position import PositionAid
from fusiond.aiding.pseudorange import NO_CLOCK, RANGE_BIAS, PseudorangeAid
from fusiond.aiding.velocity import VelocityAid
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.settings import clock_noise
from fusiond.estimators.base import Outcome
from fusiond.estimators.screening import KEPT, RESIDUAL
from fusiond.gnss.ecef import ned_axes, to_ecef, to_geodetic
from fusiond.gnss.ranges import RangeModel, RangeOptions, Rows
from fusiond.gnss.selection import best_four
from fusiond.gnss.single_point import Dops, SinglePoint, dops, single_point
from fusiond.gnss.store import EphemerisStore
from fusiond.models.model import Block, clock_blocks, position_bias

Array = NDArray[np.float64]

REASONS = {KEPT: "used", RESIDUAL: "residual"}
"""What screening calls a row in `health`; everything else is `gated`."""


@dataclass(frozen=True, slots=True)
class Sky:
    """The last epoch: satellites used, refused ones by reason, DOPs, RMS of the normalised
    innovations of the ranges that were used."""

    used: tuple[str, ...] = ()
    refused: dict[str, str] = field(default_factory=dict)
    dops: Dops | None = None
    innovation_rms: float | None = None


def raw_blocks(section: RawAiding) -> list[Block]:
    """The states that raw epochs need: a clock offset a system, drift, and errors that ranges
    share."""
    blocks = clock_blocks(section.systems, clock_noise(section))
    if section.bias_sd_m > 0.0:
        tau_s = section.bias_correlation_s
        level, down = RANGE_BIAS
        blocks.append(position_bias(level, section.bias_sd_m, tau_s))
        blocks.append(position_bias(down, section.bias_down_sd_m, tau_s, "d"))
    return blocks


class RawGnss:
    """One receiver. `refused` counts satellites by reason, `<system>_<reason>`."""

    def __init__(self, source: str, section: RawAiding) -> None:
        self.source = source
        self._section = section
        self._store = EphemerisStore()
        options = RangeOptions(
            section.systems, math.radians(section.elevation_mask_deg), section.cno_mask_db_hz
        )
        self._model = RangeModel(self._store, options)
        clocks = [section.systems.index(s) if s in section.systems else NO_CLOCK for s in SYSTEMS]
        self._clock = np.array(clocks, dtype=np.int64)
        self._guess: Array | None = None
        self._rows: Rows | None = None
        self._judged: tuple[PseudorangeAid, Outcome] | None = None
        self._counted_ns = -1
        self.refused: Counter[str] = Counter()

    def learn(self, message: Ephemeris | Klobuchar) -> None:
        """Keep what a satellite has said."""
        self._store.add(message)

    def start_aids(self, epoch: RawGnssEpoch, t_ns: int) -> list[Aid]:
        """Position and velocity of the epoch alone, for the alignment; none without a solution."""
        found = single_point(self._model, epoch, self._guess)
        if isinstance(found, str) or not found.consistent:
            self.refused[found if isinstance(found, str) else "inconsistent"] += 1
            return []
        self._guess = found.position
        return self._fix(found, t_ns)

    def aid(self, epoch: RawGnssEpoch, t_ns: int, place: Array | None) -> PseudorangeAid | str:
        """The epoch's ranges for a vehicle at about `place` (lat, lon, height: rad, m), or why
        none serves: `no_position` before the first solution, `no_satellites`."""
        if place is not None:
            self._guess = np.array(to_ecef(float(place[0]), float(place[1]), float(place[2])))
        if self._guess is None:
            return "no_position"
        rows = self._model.rows(epoch, self._guess)
        for satellite, reason in rows.refused:
            self.refused[f"{satellite[0]}_{reason}"] += 1
        if self._section.best_four and (best := best_four(rows.line_of_sight)) is not None:
            chosen = {rows.satellites[k] for k in best[0]}
            rows = rows.without([s for s in rows.satellites if s not in chosen])
        self._rows = rows
        if not rows.satellites:
            return "no_satellites"
        scale = self._section.sigma_scale**2
        return PseudorangeAid(
            self.source,
            t_ns,
            self._section.gate_probability,
            rows.satellites,
            rows.position,
            rows.velocity,
            rows.pseudorange_m,
            rows.rate_m_s,
            (rows.variance + rows.ionosphere_sigma_m**2) * scale,
            rows.rate_variance * scale,
            self._clock[rows.system],
            self._section.lever_arm_m,
            epoch.clock_reset,
        )

    def judged(self, aid: PseudorangeAid, outcome: Outcome) -> None:
        """The filter has looked at an epoch; one that a rewind brings again counts once."""
        self._judged = aid, outcome
        if aid.t_ns <= self._counted_ns:
            return
        self._counted_ns = aid.t_ns
        refused = [(k, code) for k, code in enumerate(outcome.rows) if code != KEPT]
        labels = aid.labels if refused else []
        for k, code in refused:
            satellite, what = labels[k]
            self.refused[f"{satellite[0]}_{what}_{REASONS.get(code, 'gated')}"] += 1

    def sky(self) -> Sky:
        """What the last epoch came to."""
        if self._judged is None or self._rows is None or self._guess is None:
            return Sky(refused=dict(self._rows.refused) if self._rows is not None else {})
        aid, outcome = self._judged
        used, refused, squares = [], dict(self._rows.refused), []
        whitened = outcome.whitened or (0.0,) * len(outcome.rows)  # an epoch that failed as a whole
        for (satellite, what), code, innovation in zip(
            aid.labels, outcome.rows, whitened, strict=False
        ):
            if what == "range":
                if code == KEPT:
                    used.append(satellite)
                    squares.append(innovation**2)
                else:
                    refused[satellite] = REASONS.get(code, "gated")
        here = [k for k, name in enumerate(aid.satellites) if name in used]
        sight = aid.position[here] - self._guess
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        return Sky(
            tuple(used),
            refused,
            dops(sight, aid.clock[here], self._guess) if used else None,
            math.sqrt(float(np.mean(squares))) if squares else None,
        )

    def _fix(self, found: SinglePoint, t_ns: int) -> list[Aid]:
        x, y, z = (float(v) for v in found.position)
        lat, lon, height = to_geodetic(x, y, z)
        axes = ned_axes(lat, lon)
        covariance = axes.T @ found.covariance @ axes
        n, e, d = np.sqrt(np.diag(covariance)).tolist()
        section = self._section
        lever, gate = section.lever_arm_m, section.gate_probability
        aids: list[Aid] = [PositionAid(self.source, t_ns, gate, lat, lon, height, (n, e, d), lever)]
        if found.velocity is not None:
            v_n, v_e, v_d = (axes.T @ found.velocity).tolist()
            sd = section.start_velocity_sd_m_s
            aids.append(
                VelocityAid(
                    f"{self.source}_velocity", t_ns, gate, (v_n, v_e, v_d), (sd, sd, sd), lever
                )
            )
        return aids
