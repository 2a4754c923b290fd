r"""Sky masks: open country, a street between houses, a tunnel.

Houses of height H along both sides of a street of width W hide, at azimuth A, satellites below

    tan E_wall = H |sin(A - psi)| / (W / 2)

with psi the azimuth of the street: stated, or the vehicle's heading when it enters. With
`satellites` set, exactly that many stay visible (fewer if fewer are up): at the first epoch those
that clear the walls by most, or are hidden by least. A chosen satellite stays visible until it
falls below the open sky's limit, and is then replaced.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Booleans = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Mask:
    """Mask over a part of the trajectory, from `start_s` for `length_s`.

    `wall_height` is H / (W / 2): 3 for houses of 30 m on a street of 20 m. `multipath` is the
    factor on the multipath under the open sky.
    """

    kind: Literal["canyon", "tunnel"]
    start_s: float = 0.0
    length_s: float = math.inf
    satellites: int | None = None
    wall_height: float = 3.0
    street_deg: float | None = None
    multipath: float = 2.0

    def holds(self, t_s: float) -> bool:
        """True if the vehicle is inside at an instant."""
        return self.start_s <= t_s < self.start_s + self.length_s


def canyon(satellites: int | None = None, start_s: float = 0.0, length_s: float = math.inf) -> Mask:
    """Mask of a street canyon; `satellites` 2, 3, 4 are the studies' canyon2, canyon3, canyon4."""
    return Mask("canyon", start_s, length_s, satellites)


def tunnel(start_s: float, length_s: float) -> Mask:
    """Mask of a tunnel, which blocks every signal."""
    return Mask("tunnel", start_s, length_s)


def parse_mask(text: str) -> Mask:
    """Parse KIND:START:LENGTH (s), such as canyon3:100:60. Kinds: canyon, canyon2 to canyon4,
    tunnel.

    Raises ValueError.
    """
    kind, _, window = text.partition(":")
    start_s, length_s = (float(part) for part in window.split(":"))
    if kind == "tunnel":
        return tunnel(start_s, length_s)
    if kind in {"canyon", "canyon2", "canyon3", "canyon4"}:
        satellites = int(kind[-1]) if kind[-1].isdigit() else None
        return canyon(satellites, start_s, length_s)
    raise ValueError(f"no mask {kind!r}: there are canyon, canyon2, canyon3, canyon4, tunnel")


@dataclass(slots=True)
class View:
    """Visible satellites along the trajectory, to be asked in order of time."""

    elevation_deg: float = 10.0
    masks: Sequence[Mask] = ()
    _street: dict[int, float] = field(default_factory=dict)
    _chosen: dict[int, list[int]] = field(default_factory=dict)

    def mask(self, t_s: float) -> int | None:
        """Index of the mask in force at `t_s`, the first of several."""
        return next((k for k, mask in enumerate(self.masks) if mask.holds(t_s)), None)

    def visible(
        self, t_s: float, azimuth: Array, elevation: Array, heading_rad: float
    ) -> tuple[Booleans, float]:
        """Mask of visible satellites (n,) and the factor of multipath; angles in rad."""
        up: Booleans = elevation >= math.radians(self.elevation_deg)
        k = self.mask(t_s)
        if k is None:
            return up, 1.0
        mask = self.masks[k]
        if mask.kind == "tunnel":
            return np.zeros_like(up), 1.0
        street = self._street.setdefault(
            k, heading_rad if mask.street_deg is None else math.radians(mask.street_deg)
        )
        margin = elevation - wall_elevation(azimuth - street, mask.wall_height)
        if mask.satellites is None:
            return up & (margin >= 0.0), mask.multipath
        kept = [i for i in self._chosen.get(k, []) if up[i]]
        best = (int(i) for i in np.argsort(-margin) if up[i] and int(i) not in kept)
        kept += [i for i, _ in zip(best, range(mask.satellites - len(kept)), strict=False)]
        self._chosen[k] = kept
        seen = np.zeros_like(up)
        seen[kept] = True
        return seen, mask.multipath


def wall_elevation(azimuth_from_street: Array, wall_height: float) -> Array:
    """Elevation (n,) in rad of the roofs at an azimuth counted from the street's direction."""
    roof: Array = np.arctan(wall_height * np.abs(np.sin(azimuth_from_street)))
    return roof
