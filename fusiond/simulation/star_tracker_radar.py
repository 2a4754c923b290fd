r"""Star tracker and radar (SAR) of a simulated vehicle: attitudes and bearings with errors.

    C_y = C_nb exp[m x],   roll, pitch, yaw of C_y, plus white noise            star tracker
    u = exp[m x]^T C_nb^T (p - r),   azimuth atan2(u_y, u_x), elevation atan2(-u_z, |u_xy|), plus
    white noise                                                                 radar

m misalignment (rad, body axes): constant, or a first-order Gauss-Markov process, from its steady
state; r the antenna, p a known point. The radar observes the nearest point that is within its range
and not too steep, or none. Latencies are constant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.si_units import ARCSEC
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.markov import gauss_markov
from fusiond.simulation.trajectories import dcm_from_rpy

Array = NDArray[np.float64]
Vector3 = tuple[float, float, float]

LEAST_SIGHT_DEG = 75.0
"""Largest elevation of a point, above or below, that the radar observes."""


FLIGHT_POINTS: Mapping[str, Vector3] = {
    "1": (30.3931, 114.3256, 20.0),
    "2": (30.3647, 114.7068, 30.0),
    "3": (29.9016, 114.4850, 40.0),
    "4": (29.4200, 114.8964, 50.0),
    "5": (29.0677, 114.5760, 60.0),
    "6": (28.7081, 114.0377, 70.0),
    "7": (28.8418, 113.3305, 80.0),
    "8": (28.2434, 113.5351, 20.0),
    "9": (27.6641, 113.3410, 30.0),
    "10": (27.0973, 113.4022, 40.0),
    "11": (27.2651, 112.7425, 50.0),
    "12": (26.9053, 112.2621, 60.0),
    "13": (26.4872, 112.0043, 70.0),
    "14": (26.0016, 112.4037, 80.0),
    "15": (25.6492, 112.0930, 20.0),
    "16": (25.2894, 111.5710, 30.0),
    "17": (25.4232, 110.8850, 40.0),
    "18": (24.8245, 111.0836, 50.0),
    "19": (24.2450, 110.8951, 60.0),
    "20": (23.6780, 110.9545, 70.0),
}
"""Known points along the flight of `fusiond.simulation.trajectories`, one each 200 s, alternately
15 km to the right and left of the track; as in `config/flight_sar.toml`."""


@dataclass(frozen=True, slots=True)
class StarTrackerOptions:
    """One-sigma errors; `misalignment_correlation_s` None is a constant misalignment."""

    rate_hz: float = 1.0
    sd_arcsec: Vector3 = (200.0, 200.0, 200.0)
    misalignment_sd_arcsec: float = 200.0
    misalignment_correlation_s: float | None = None
    latency_s: float = 0.1


@dataclass(frozen=True, slots=True)
class SarOptions:
    """One-sigma errors of azimuth and elevation, and the points by number: lat, lon (deg), height
    (m)."""

    targets_deg_m: Mapping[str, Vector3] = field(default_factory=dict)
    rate_hz: float = 1.0
    sd_arcsec: tuple[float, float] = (100.0, 100.0)
    misalignment_sd_arcsec: float = 200.0
    misalignment_correlation_s: float | None = None
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    range_m: tuple[float, float] = (2_000.0, 80_000.0)
    latency_s: float = 0.2


_TIMES = (("t_s", 6), ("t_arrival_s", 6))
_RPY = ("roll", "pitch", "yaw")
ATTITUDE_COLUMNS = (
    *_TIMES,
    *((f"{angle}_deg", 7) for angle in _RPY),
    *((f"sd_{angle}_deg", 7) for angle in _RPY),
)
"""Columns of attitude.csv and their decimals."""
BEARING_COLUMNS = (
    *_TIMES,
    *((f"{angle}_deg", 7) for angle in ("azimuth", "elevation", "sd_azimuth", "sd_elevation")),
    ("target_lat_deg", 9),
    ("target_lon_deg", 9),
    ("target_height_m", 4),
)
"""Columns of bearing.csv and their decimals."""


def sensor_streams(seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Random generators for star tracker and radar, independent of the other devices'
    generators."""
    star, sar = (np.random.SeedSequence(seed, spawn_key=(100 + k,)) for k in range(2))
    return np.random.default_rng(star), np.random.default_rng(sar)


def _misalignment(o: StarTrackerOptions | SarOptions, n: int, rng: np.random.Generator) -> Array:
    """Misalignment (n, 3) in rad at the epochs of a sensor."""
    sd = o.misalignment_sd_arcsec * ARCSEC
    if o.misalignment_correlation_s is None:
        return np.tile(rng.standard_normal(3) * sd, (n, 1))
    tau_s = o.misalignment_correlation_s
    return gauss_markov(rng, (n, 3), step_s=1.0 / o.rate_hz, correlation_s=tau_s, sigma=sd)


class StarTracker:
    """Epochs over a whole trajectory, drawn at construction: `t_s`, `t_arrival_s` (n,), `rpy` (n,
    3) in rad, and the true `misalignment` (n, 3)."""

    def __init__(self, truth: Truth, options: StarTrackerOptions, rng: np.random.Generator) -> None:
        o = self.options = options
        n = int(truth.duration_s * o.rate_hz + 1e-9)
        self.t_s = np.arange(1, n + 1) / o.rate_hz
        self.t_arrival_s = self.t_s + o.latency_s
        self.misalignment = _misalignment(o, n, rng)
        turned = dcm_from_rpy(truth.at(self.t_s).rpy) @ _turns(self.misalignment)
        self.sd_rad = np.array(o.sd_arcsec) * ARCSEC
        self.rpy = _rpy(turned) + rng.standard_normal((n, 3)) * self.sd_rad

    @property
    def rows(self) -> Array:
        """Rows of attitude.csv (n, 8)."""
        rpy = np.degrees(self.rpy)
        rpy[:, [0, 2]] = (rpy[:, [0, 2]] + 180.0) % 360.0 - 180.0
        sd = np.tile(np.degrees(self.sd_rad), (len(rpy), 1))
        return np.column_stack((self.t_s, self.t_arrival_s, rpy, sd))

    def values(self, k: int) -> list[float]:
        """Epoch `k` by the slots of `CanAttitudeDecoder`."""
        return [*(float(a) for a in _wrapped(self.rpy[k])), *self.sd_rad.tolist(), 1.0]


class SarRadar:
    """Epochs over a whole trajectory, drawn at construction: `t_s`, `t_arrival_s` (n,), `angles`
    (n, 2) azimuth and elevation in rad, `target` (n,), and the `misalignment` (n, 3)."""

    def __init__(self, truth: Truth, options: SarOptions, rng: np.random.Generator) -> None:
        o = self.options = options
        n = int(truth.duration_s * o.rate_hz + 1e-9)
        t_s = np.arange(1, n + 1) / o.rate_hz
        states = truth.at(t_s, o.lever_arm_m)
        misalignment = _misalignment(o, n, rng)
        noise = rng.standard_normal((n, 2)) * np.array(o.sd_arcsec) * ARCSEC
        names = sorted(o.targets_deg_m)
        places = np.array([o.targets_deg_m[name] for name in names]).reshape(-1, 3)
        points = _earth_fixed(np.radians(places[:, 0]), np.radians(places[:, 1]), places[:, 2])
        here = _earth_fixed(*states.position.T)
        # north-east-down axes as columns in Earth-fixed axes, then body, then the sensor's own
        lat, lon, _ = states.position.T
        ned = dcm_from_rpy(np.column_stack((np.zeros(n), -lat - math.pi / 2.0, lon)))
        from_sensor = ned @ dcm_from_rpy(states.rpy) @ _turns(misalignment)
        distance = np.linalg.norm(points[None, :, :] - here[:, None, :], axis=2)
        chosen = np.full(n, -1)
        best = np.full(n, np.inf)
        angles = np.zeros((n, 2))
        for index, point in enumerate(points):
            x, y, z = np.einsum("nji,nj->in", from_sensor, point - here)
            elevation = np.arctan2(-z, np.hypot(x, y))
            far = distance[:, index]
            seen = (far >= o.range_m[0]) & (far <= o.range_m[1]) & (far < best)
            seen &= np.abs(elevation) < math.radians(LEAST_SIGHT_DEG)
            chosen[seen], best[seen] = index, far[seen]
            angles[seen] = np.column_stack((np.arctan2(y, x), elevation))[seen]
        ok = chosen >= 0
        self.t_s = t_s[ok]
        self.t_arrival_s = self.t_s + o.latency_s
        self.misalignment = misalignment[ok]
        self.sd_rad = np.array(o.sd_arcsec) * ARCSEC
        self.angles = angles[ok] + noise[ok]
        self.angles[:, 0] = _wrapped(self.angles[:, 0])
        self.target = [names[i] for i in chosen[ok]]

    @property
    def rows(self) -> Array:
        """Rows of bearing.csv (n, 9)."""
        sd = np.tile(np.degrees(self.sd_rad), (len(self.t_s), 1))
        points = [self.options.targets_deg_m[name] for name in self.target]
        place = np.array(points, dtype=np.float64).reshape(-1, 3)
        return np.column_stack((self.t_s, self.t_arrival_s, np.degrees(self.angles), sd, place))

    def values(self, k: int) -> list[float]:
        """Epoch `k` by the slots of `CanBearingDecoder`; the names of points must be numbers."""
        azimuth, elevation = (float(a) for a in self.angles[k])
        return [azimuth, elevation, *self.sd_rad.tolist(), float(self.target[k]), 1.0]


def _turns(vectors: Array) -> Array:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = vectors.T
    none = np.zeros_like(x)
    cross = np.array([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(2, 0, 1)
    # sin(a)/a and (1 - cos(a))/a^2; numpy's sinc is of pi times its argument
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross), dtype=np.float64)


def _rpy(dcm: Array) -> Array:
    """Roll, pitch, yaw (n, 3) of body to navigation matrices (n, 3, 3)."""
    roll = np.arctan2(dcm[:, 2, 1], dcm[:, 2, 2])
    pitch = np.arctan2(-dcm[:, 2, 0], np.hypot(dcm[:, 2, 1], dcm[:, 2, 2]))
    return np.column_stack((roll, pitch, np.arctan2(dcm[:, 1, 0], dcm[:, 0, 0])))


def _wrapped(angles: Array) -> Array:
    return np.asarray((angles + math.pi) % (2.0 * math.pi) - math.pi, dtype=np.float64)


def _earth_fixed(lat: Array, lon: Array, height: Array) -> Array:
    """Earth-fixed coordinates (n, 3) in m of geodetic positions (n,), rad and m."""
    n = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
    across = (n + height) * np.cos(lat)
    polar = (n * (1.0 - ECCENTRICITY_SQUARED) + height) * np.sin(lat)
    return np.column_stack((across * np.cos(lon), across * np.sin(lon), polar))


def sensor_tables(
    truth: Truth, star: StarTrackerOptions | None, sar: SarOptions | None, seed: int
) -> dict[str, tuple[tuple[tuple[str, int], ...], Array]]:
    """Columns and rows of attitude.csv and bearing.csv, for the sensors on board."""
    star_rng, sar_rng = sensor_streams(seed)
    tables = {}
    if star is not None:
        tables["attitude"] = (ATTITUDE_COLUMNS, StarTracker(truth, star, star_rng).rows)
    if sar is not None:
        tables["bearing"] = (BEARING_COLUMNS, SarRadar(truth, sar, sar_rng).rows)
    return tables
