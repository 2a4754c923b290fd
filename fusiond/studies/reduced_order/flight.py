r"""Flight of paper 002: truth, satellites, radar points and measurements, for the studies
`reduced-order` and `ins-gnss-sar`.

Set-up: 120 deg E, 30 deg N, 1000 m, due east at 300 m/s for 4000 s, gyro 0.1 deg/h, accelerometer
1e-4 g, pseudorange and its rate to the four satellites of best GDOP (or to all in view), SAR
azimuth and elevation of known points. What the paper does not print is chosen here, each with its
reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, NotApplicable, State, Vector3
from fusiond.aiding.landmark_bearing import BearingMeasurement
from fusiond.aiding.pseudorange import PseudorangeMeasurement, epoch_values
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.base import Estimator
from fusiond.gnss.best_four_satellites import best_four
from fusiond.gnss.nominal_constellation import EPOCH_S, Constellation, beidou_slots, constellation
from fusiond.gnss.orbit import WEEK_S
from fusiond.models.blocks import SAR_MISALIGNMENT, misalignment
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.earth import meridian_radius
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import quaternion_from_rpy
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Path, Profile
from fusiond.studies.covariance_analysis import System

Array = NDArray[np.float64]

START = (30.0 * DEG, 120.0 * DEG, 1000.0)
SPEED_M_S = 300.0
DURATION_S = 4000.0
ARC_SECOND = DEG / 3600.0

IMU = Imu(
    rate_hz=20.0,
    gyro_noise_deg_sqrt_h=0.01,
    accel_noise_m_s_sqrt_h=0.01,
    gyro_bias_initial_deg_h=0.1,
    gyro_bias_instability_deg_h=0.1,
    accel_bias_initial_mg=0.1,
    accel_bias_instability_mg=1e-9,
    bias_correlation_s=3600.0,
    gyro_scale_ppm=1e-6,
    accel_scale_ppm=1e-6,
)
"""IMU with the paper's 0.1 deg/h for the constant and for the Markov part, and its 1e-4 g for a
constant bias. Correlation time of paper 000; white noise of a gyro of that grade (0.01
deg/sqrt(h)). Nothing changes along a straight flight, so 20 Hz suffice."""

RANGE_SD_M, RATE_SD_M_S = 5.0, 0.05
"""One sigma of code with modelled atmosphere, and of Doppler."""
BEARING_SD_RAD = 1e-3
"""A resolution cell of some tens of metres at 30 km."""
SAR_SD_RAD = 20.0 * ARC_SECOND
"""Misalignment of the radar, one sigma an axis. The paper prints none; its azimuth error of 33 arc
seconds cannot come out of a radar that is mounted less well than that."""

EPOCH_NS = 1_000_000_000
MASK_RAD = 10.0 * DEG
CHOICE_S = 60.0
"""Interval at which the satellites are chosen."""
WEEK = round(EPOCH_S / WEEK_S)
POINT_SPACING_S = 150.0
POINT_ASIDE_M = 30_000.0
"""Radar points: 45 km apart, 30 km left and right of the track in turn, on the ground; the one that
is abeam next or was last. Azimuth runs 37 deg to both sides of the beam."""
LEAST_RANGE_M = 5_000.0
GATE = 1.0
"""No gate: no filter hides its errors by rejecting measurements, and the analysis is linear."""

INITIAL_ATTITUDE_SD = np.array([60.0, 60.0, 600.0]) * ARC_SECOND
INITIAL_VELOCITY_SD_M_S = 0.5
INITIAL_POSITION_SD_M = 20.0
"""North, east, down: about what an alignment with such an IMU and a first fix leave (1e-4 g tilts
by 20 arc seconds, 0.1 deg/h turns the azimuth by 1600; here a reference has helped)."""


@lru_cache(maxsize=2)
def truth(seconds: float, rate_hz: float = IMU.rate_hz) -> Truth:
    """True flight, level and due east."""
    still = Profile([0.0], [0.0])
    path = Path(Profile([0.0], [SPEED_M_S]), Profile([0.0], [0.5 * math.pi]), still)
    return Truth(path, START, rate_hz, seconds)


def true_nav(flight: Truth) -> Array:
    """Navigation states (n + 1, 10) at 0, 1, ... s."""
    states = flight.at(np.arange(round(flight.duration_s) + 1, dtype=np.float64))
    q = np.array([quaternion_from_rpy(*rpy) for rpy in states.rpy])
    return np.column_stack([states.position, states.v_ned, q])


def model(
    name: str, sar_sd: float = SAR_SD_RAD, sar_tau_s: float = math.inf, bare: bool = False
) -> Model:
    """`ins23` or `ins17` with the study's IMU and radar, as shipped.

    A radar whose misalignment has a correlation time is driven by noise, as the 14 noises of paper
    002 imply; it prints no figure of that. To a `bare` model the accelerometer has no bias, so that
    nothing stands for it where there is no state.
    """
    noise = imu_noise(IMU)
    if bare:
        noise = replace(noise, force_bias_initial=0.0, force_bias_instability=0.0)
    return make_model(name, noise, misalignment(SAR_MISALIGNMENT, sar_sd, sar_tau_s))


def filters(sar_sd: float = SAR_SD_RAD, sar_tau_s: float = math.inf) -> dict[str, Model]:
    """Models of the compared filters; the first describes the truth.

    `17` has the accelerometer biases as white noise (`fusiond.models.unmodelled_bias_noise`),
    `17_bare` ignores them.
    """
    return {
        "23": model("ins23", sar_sd, sar_tau_s),
        "17": model("ins17", sar_sd, sar_tau_s),
        "17_bare": model("ins17", sar_sd, sar_tau_s, bare=True),
    }


def initial_sd(of: Model) -> Array:
    """One sigma (n,) at the start."""
    sd = of.initial.copy()
    sd[0:3], sd[3:6] = INITIAL_ATTITUDE_SD, INITIAL_VELOCITY_SD_M_S
    sd[6:9] = INITIAL_POSITION_SD_M
    return sd


class Scene(NamedTuple):
    """Measurement at an instant: n satellites (n, 3), ECEF, their places `at` (n,) in the
    constellation, and a point for the radar.

    Geometry of one instant: truth and filter leave the flight time of the signal out alike.
    """

    t_ns: int
    names: tuple[str, ...]
    at: list[int]
    position: Array
    velocity: Array
    point: Vector3

    @property
    def rows(self) -> int:
        """Number of rows: n ranges, n rates, azimuth, elevation."""
        return 2 * len(self.names) + 2

    def noise(self, drawn: Array) -> Array:
        """Noise (rows,) out of that of all the constellation (DRAWN, 2): a satellite's is the same
        whichever others are used."""
        return np.concatenate([drawn[self.at, 0], drawn[self.at, 1], drawn[-1]])


Measurements = tuple[PseudorangeMeasurement, BearingMeasurement]
DRAWN = len(list(beidou_slots())) + 1
"""Pairs of noise an epoch: range and rate of each satellite, then azimuth and elevation."""


@lru_cache(maxsize=4)
def scenes(seconds: float, all_in_view: bool = False) -> tuple[Scene, ...]:
    """Scenes for each second of the flight, from 1 s on: the best four, or all above the mask."""
    nav = true_nav(truth(seconds))
    sky_of = Constellation(constellation(WEEK, 0.0, ("C",)))
    names: tuple[str, ...] = ()
    found = []
    for k in range(1, len(nav)):
        lat, lon, height = (float(x) for x in nav[k, :3])
        sky = sky_of.line_of_sight(lat, lon, height, WEEK * WEEK_S + k)
        if (k - 1) % CHOICE_S == 0:
            up = sky.above(MASK_RAD)
            best = best_four(up.unit_ned)
            if best is None:
                raise ValueError(f"no four satellites at {k} s")
            names = up.satellites if all_in_view else tuple(up.satellites[i] for i in best[0])
        at = [sky.satellites.index(name) for name in names]
        position, velocity = sky.position_ecef_m[at], sky.velocity_ecef_m_s[at]
        found.append(Scene(k * EPOCH_NS, names, at, position, velocity, _point(nav, k)))
    return tuple(found)


def _point(nav: Array, k: int) -> Vector3:
    """Radar point abeam of the middle of second k's stretch."""
    number = int(k // POINT_SPACING_S)
    # Due east at a constant speed: longitude grows evenly.
    rate = (nav[-1, 1] - nav[0, 1]) / (len(nav) - 1)
    lon = nav[0, 1] + rate * (number + 0.5) * POINT_SPACING_S
    aside = POINT_ASIDE_M if number % 2 else -POINT_ASIDE_M
    return (float(nav[0, 0] + aside / meridian_radius(nav[0, 0])), float(lon), 0.0)


def measurements(scene: Scene, values: Array) -> Measurements:
    """Measurements of the epoch with `values` (rows,): ranges, rates, azimuth, elevation."""
    n = len(scene.names)
    ranges = PseudorangeMeasurement(
        "gnss",
        scene.t_ns,
        GATE,
        scene.names,
        epoch_values(
            scene.position,
            scene.velocity,
            values[:n],
            values[n : 2 * n],
            np.full(n, RANGE_SD_M**2),
            np.full(n, RATE_SD_M_S**2),
        ),
        np.zeros(n, dtype=np.int64),
    )
    bearing = BearingMeasurement(
        "sar",
        scene.t_ns,
        GATE,
        float(values[-2]),
        float(values[-1]),
        (BEARING_SD_RAD, BEARING_SD_RAD),
        scene.point,
        (0.0, 0.0, 0.0),
        LEAST_RANGE_M,
        block=SAR_MISALIGNMENT,
    )
    return ranges, bearing


def rows(of: Measurements, state: State) -> Innovation:
    """Rows of both measurements, stacked."""
    found = [measurement.innovation(state) for measurement in of]
    refused = [f.outcome for f in found if isinstance(f, NotApplicable)]
    if refused:
        raise ValueError(f"a measurement of the flight does not apply: {refused}")
    z, h, r = zip(*found, strict=True)
    return Innovation(np.concatenate(z), np.vstack(h), np.concatenate(r))


def measured(scene: Scene, true: State, noise: Array) -> Measurements:
    """Measurement in the `true` state, with its parameters; `noise` (rows,) in sigmas."""
    z, _, r = rows(
        measurements(scene, np.zeros(scene.rows)), true
    )  # of measured zeros: what is predicted
    return measurements(scene, z + np.sqrt(r) * noise)


def imu_buffer(samples: Array, rate_hz: float = IMU.rate_hz) -> ImuBuffer:
    """IMU buffer with all samples (n, 6)."""
    buffer = ImuBuffer(rate_hz, len(samples) / rate_hz, np.eye(3), 0.0, IMU.gap_s)
    times = np.arange(1, len(samples) + 1, dtype=np.int64) * round(1e9 / rate_hz)
    buffer.append(times, samples)
    return buffer


class Transitions(Estimator):
    """Transitions of the filters' own propagation, with the noise of a second."""

    carries_transition = True

    def over_a_second(self, buffer: ImuBuffer, nav: Array, second: int) -> tuple[Array, Array]:
        """Transition (n, n) and noise (n, n) from `second` on, from the true state (10,) there."""
        n, width = self.model.size, self.model.width
        self.nav[:], self.t_ns = nav, second * EPOCH_NS
        self.sample = round(second * IMU.rate_hz)
        self._phi[:] = np.eye(width)
        self._phi[n:] = 0.0
        self._covs[:] = 0.0
        self.propagate(buffer, self.t_ns + EPOCH_NS)
        return self._phi[:n, :n].copy(), self._covs[0, :n, :n].copy()


def systems(of: Model, seconds: float) -> Iterator[System]:
    """Linear model of each second along the true flight, as in the filter."""
    flight = truth(seconds)
    nav = true_nav(flight)
    buffer = imu_buffer(np.hstack([flight.gyro, flight.accel]))
    transitions = Transitions(of, IMU.gap_s)
    xi = np.zeros(of.size)
    for k, scene in enumerate(scenes(seconds)):
        phi, q = transitions.over_a_second(buffer, nav[k], k)
        state = State(nav[k + 1], xi, transitions.step, of)
        _, h, r = rows(measurements(scene, np.zeros(scene.rows)), state)
        yield System(phi, q, h, r)
