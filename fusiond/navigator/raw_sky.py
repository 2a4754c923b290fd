"""Sky of a receiver's last raw epoch: satellites in use, refused ones with reasons, directions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from drivers.raw.messages import RawGnssEpoch
from fusiond.aiding.pseudorange import PseudorangeMeasurement
from fusiond.estimators.update_with_exclusion import KEPT, RESIDUAL
from fusiond.gnss.ranges import Rows
from fusiond.gnss.single_point import Dops, dops

REASONS = {KEPT: "used", RESIDUAL: "residual"}
"""Names of screened rows in `health`; everything else is `gated`."""


class Seen(NamedTuple):
    """Direction of a satellite (rad; None if refused before it was computed) and its strongest
    signal (dB-Hz; None if the receiver states none)."""

    azimuth_rad: float | None
    elevation_rad: float | None
    cno_db_hz: float | None


@immutable()
class Sky:
    """The last epoch: satellites used, refused ones by reason, DOPs, RMS of the normalised
    innovations of the ranges used; directions of all."""

    used: tuple[str, ...] = ()
    refused: dict[str, str] = field(default_factory=dict)
    dops: Dops | None = None
    innovation_rms: float | None = None
    seen: dict[str, Seen] = field(default_factory=dict)


def sky_of(
    epoch: RawGnssEpoch,
    rows: Rows,
    measurement: PseudorangeMeasurement,
    place: NDArray[np.float64],
    codes: Sequence[int],
    whitened: Sequence[float],
) -> Sky:
    """Sky of an epoch for a vehicle near `place` (ECEF, m), with the filter's outcome of each
    row."""
    used, refused, squares = [], dict(rows.refused), []
    whitened = whitened or (0.0,) * len(codes)  # an epoch that failed as a whole
    for (satellite, what), code, innovation in zip(
        measurement.labels, codes, whitened, strict=False
    ):
        if what == "range":
            if code == KEPT:
                used.append(satellite)
                squares.append(innovation**2)
            else:
                refused[satellite] = REASONS.get(code, "gated")
    here = [k for k, name in enumerate(measurement.satellites) if name in used]
    sight = measurement.position[here] - place
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    return Sky(
        tuple(used),
        refused,
        dops(sight, measurement.clock[here], place) if used else None,
        math.sqrt(float(np.mean(squares))) if squares else None,
        _seen(epoch, rows),
    )


def _seen(epoch: RawGnssEpoch, rows: Rows) -> dict[str, Seen]:
    """Every satellite of an epoch; rows have the direction of the usable ones."""
    angles = zip(rows.azimuth_rad.tolist(), rows.elevation_rad.tolist(), strict=True)
    directions = dict(zip(rows.satellites, angles, strict=True))
    strongest: dict[str, float | None] = {}
    for signal in epoch.signals:
        levels = (strongest.get(signal.satellite), signal.cno_db_hz)
        strongest[signal.satellite] = max((x for x in levels if x is not None), default=None)
    return {
        name: Seen(*directions.get(name, (None, None)), cno_db_hz=cno)
        for name, cno in strongest.items()
    }
