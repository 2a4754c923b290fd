"""What an alignment has to go by: rest seen by the IMU, and what the aids offered."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid
from fusiond.aiding.offers import HeadingOffer, HeightOffer, PositionOffer, VelocityOffer
from fusiond.navigation.standstill import FEWEST_SAMPLES, Window
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.alignment.start import Place, as_geodetic, velocity_of
from fusiond.navigator.saved_state import SavedState

Array = NDArray[np.float64]

# Fixes that a course may be taken from: the last eight seconds of a receiver of 5 Hz, twice the
# longest interval that a change of velocity is taken over.
MOST_FIXES = 40


@dataclass(slots=True)
class Standing:
    """Sums over the quiet windows since the vehicle came to rest."""

    start_ns: int
    end_ns: int
    seconds: float = 0.0
    rate_sum: Array = field(default_factory=lambda: np.zeros(3))
    force_sum: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def mean_rate(self) -> Array:
        return self.rate_sum / self.seconds

    @property
    def mean_force(self) -> Array:
        return self.force_sum / self.seconds


class Collected:
    """Windows and offers since the alignment began."""

    def __init__(self, options: AlignmentOptions, saved: SavedState | None) -> None:
        self._options, self._saved = options, saved
        self.standing: Standing | None = None
        """The last standstill, also when the vehicle has moved off since."""
        self.ever_moved = False
        self.heading: HeadingOffer | None = None
        self.fixes: list[tuple[VelocityOffer, PositionOffer]] = []
        """Of the last measurements that offered both, velocity and position."""
        self._at_rest = False
        self._pending: Window | None = None
        self._speed = 0.0
        self._position: PositionOffer | None = None

    def window(self, latest: Window) -> None:
        """A window of the standstill detector has ended.

        It counts as rest only once the next one is quiet too: the last before the start may hold
        the first of the acceleration. One with too few samples (the first after a start or a gap)
        tells neither rest nor motion.
        """
        if latest.samples < FEWEST_SAMPLES:
            self._at_rest = False
            self._pending = None
            return
        if not latest.quiet or self._speed > self._options.rest_speed_m_s:
            self._at_rest = False
            self.ever_moved = True
            self._pending = None
            return
        w, self._pending = self._pending, latest
        if w is None:
            return
        if not self._at_rest or self.standing is None:
            start = w.end_ns - round(self._options.window_s * 1e9)
            self.standing = Standing(start, w.end_ns)
            self._at_rest = True
        s = self.standing
        s.end_ns = w.end_ns
        s.seconds += self._options.window_s
        s.rate_sum += w.mean_rate * self._options.window_s
        s.force_sum += w.mean_force * self._options.window_s

    def aids(self, aids: Sequence[Aid]) -> None:
        """A measurement has arrived, as the aids it stands for."""
        offers = [offer for aid in aids for offer in aid.offers()]
        height = next((o for o in offers if isinstance(o, HeightOffer)), None)
        position: PositionOffer | None = None
        velocity: VelocityOffer | None = None
        for offer in offers:
            match offer:
                case PositionOffer(height_m=None, sd=(n, e, _)) if height is not None:
                    sd = n, e, height.sd_m
                    position = offer._replace(height_m=height.height_m, sd=sd)
                case PositionOffer():
                    position = offer
                case VelocityOffer():
                    velocity = offer
                case HeadingOffer():
                    self.heading = offer
        if position is not None and (
            self._position is None or position.t_ns >= self._position.t_ns
        ):
            self._position = position
        if velocity is not None:
            self._speed = math.hypot(*velocity.v_ned[:2])
            if position is not None:
                self.fixes = [*self.fixes, (velocity, position)][-MOST_FIXES:]

    def levelled(self) -> Standing | None:
        """The standstill that the vehicle is in, once it is long enough to level by."""
        s = self.standing
        if s is None or not self._at_rest or s.seconds < self._options.levelling_s:
            return None
        return s

    def place(self) -> Place | None:
        """Position (rad, rad, m) to start at, the fix it came from, and its sigma."""
        saved = self._saved
        if self._position is not None:
            fix, where, sd = place_of(self._position)
            if self._position.height_m is None:
                known = self._options.position or (saved.position if saved else None)
                where[2] = known[2] if known else 0.0
            return fix, where, sd
        if self._options.position is not None:
            return None, np.array(self._options.position), self._options.position_sd_m
        if saved is not None:
            return None, np.array(saved.position), saved.sd_position_m
        return None


def place_of(p: PositionOffer, velocity: VelocityOffer | None = None) -> Place:
    """A fix's place; with a velocity, moved to the velocity's instant."""
    where = np.array([p.lat_rad, p.lon_rad, p.height_m or 0.0])
    if velocity is not None:
        moved = velocity_of(velocity)[0] * ((velocity.t_ns - p.t_ns) * 1e-9)
        where += as_geodetic(moved, p.lat_rad)
    return p, where, max(p.sd[:2])
