"""Sensor data of a drive with arrival times, which faults alter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import (
    DelayedFix,
    Measurement,
    MonotonicStamp,
    PositionFix,
    WheelSpeed,
)
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG
from fusiond.simulation.gnss.receiver import GnssReceiver
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.rdss.centre import RdssCentre
from fusiond.simulation.scenarios import SCENARIOS, Scenario, random_streams
from fusiond.simulation.trajectories import Leg, Path, follow

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

DURATION_S = 220.0
REST_S = 15.0
BEND_S = 90.0
"""Start of the bend of 180 deg in `town`, which lasts 15 s at 20 m/s."""
RDSS_EVERY_S = 11.0
GNSS, SECOND = "gnss", "second"
"""Names of the receivers in the configuration."""
"""Interval of RDSS fixes: one second more than the service interval of a 10 s card."""
WHEEL_EVERY_S = 0.1
WHEEL_SD_M_S = 0.1
"""Sigma of wheel speeds: the default of `[aiding.wheel]`."""


@dataclass(frozen=True, slots=True)
class Received:
    """Measurement with its instants of validity and arrival (ns)."""

    t_ns: int
    seen_ns: int
    measurement: Measurement


@dataclass(frozen=True, slots=True)
class Recording:
    """Sensor data of a drive. IMU samples (n, 6) are rate and force in sensor axes, with stamps
    (n,) and arrivals (n,) in ns; the other measurements follow in order of arrival. `spare` has the
    samples of a second unit, in its own axes."""

    stamps: Stamps
    imu_seen: Stamps
    samples: Array
    received: tuple[Received, ...]
    spare: Recording | None = None

    def window(self, begin_s: float, length_s: float) -> NDArray[np.bool_]:
        """Mask of samples (n,) that arrive in the window."""
        begin, end = round(begin_s * 1e9), round((begin_s + length_s) * 1e9)
        return (self.imu_seen >= begin) & (self.imu_seen < end)

    def without(self, lost: NDArray[np.bool_]) -> Recording:
        """Recording without some samples."""
        kept = ~lost
        return replace(
            self,
            stamps=self.stamps[kept],
            imu_seen=self.imu_seen[kept],
            samples=self.samples[kept],
        )

    def withheld(self, begin_s: float, end_s: float) -> Recording:
        """Recording without measurements valid from `begin_s` to before `end_s`; wheels
        continue."""
        begin, end = round(begin_s * 1e9), round(end_s * 1e9)
        return replace(
            self,
            received=tuple(
                r
                for r in self.received
                if isinstance(r.measurement, WheelSpeed) or not begin <= r.t_ns < end
            ),
        )

    def with_received(self, received: list[Received]) -> Recording:
        """Recording with these measurements instead, in order of arrival."""
        return replace(self, received=tuple(sorted(received, key=lambda r: r.seen_ns)))


Alter = Callable[[Recording, float, float], Recording]
"""Change of a recording by a fault, from an instant (s) on, for a duration (s)."""

TOWN_LEGS = (
    Leg(8, speed_m_s=14.0),
    Leg(12),
    Leg(8, turn_deg=90.0),
    Leg(8, speed_m_s=20.0),
    Leg(12, turn_deg=-90.0),
    Leg(27),
    Leg(15, turn_deg=180.0),
    Leg(10),
    Leg(8, speed_m_s=0.0),
    Leg(12),
    Leg(8, speed_m_s=12.0),
    Leg(10, turn_deg=-120.0),
    Leg(20),
    Leg(8, turn_deg=60.0),
)


def town(duration_s: float) -> Path:
    """Drive: rest, town at 14 and 20 m/s with bends, a stop, and on."""
    legs = (Leg(REST_S), *TOWN_LEGS, Leg(duration_s))
    return follow(legs, duration_s, course_deg=40.0, bank_ratio=-0.08)


@dataclass(frozen=True, slots=True)
class Drive:
    """Motion and sensors on board, without vibration: a quiet IMU need not be at rest."""

    path: Callable[[float], Path] = town
    wheels: bool = False
    spare: bool = False
    """A second inertial unit, `[imu.spare]` of the configuration."""
    second: bool = False
    """A second receiver, `SECOND` of the configuration, as good as the first."""
    places_alone: bool = False
    """True if receivers send positions only."""
    gnss_rate_hz: float = 5.0
    duration_s: float = DURATION_S

    def recorded(
        self, config: Config, seed: int | np.random.SeedSequence
    ) -> tuple[Truth, Recording]:
        """Truth and sensor data of the car of `fusiond simulate`, mounted as configured; equal
        seeds give equal data."""
        car = replace(SCENARIOS["drive"], path=self.path).fitted(config)
        truth = car.truth(self.duration_s)
        sequence = np.random.SeedSequence(seed) if isinstance(seed, int) else seed
        imu_rng, gnss_rng, rdss_rng, wheel_rng = random_streams(sequence)
        imu = car.imu_output(truth, imu_rng)
        stamps = np.rint(truth.t_s[1:] * 1e9).astype(np.int64)
        receiver = replace(car.gnss, rate_hz=self.gnss_rate_hz)
        received = gnss_fixes(GnssReceiver(truth, receiver, gnss_rng))
        if self.places_alone:
            received = [_without_velocity(item) for item in received]
        received += _rdss(RdssCentre(truth, car.rdss, rdss_rng), self.duration_s)
        if self.wheels:
            received += _wheels(truth, wheel_rng)
        spare_seed, second_seed = sequence.spawn(2)
        if self.second:
            twin = GnssReceiver(truth, receiver, np.random.default_rng(second_seed))
            received += [
                replace(r, measurement=replace(r.measurement, source=SECOND))
                for r in gnss_fixes(twin)
            ]
        samples = np.hstack((imu.gyro, imu.accel))
        recording = Recording(stamps, stamps, samples, ()).with_received(received)
        if self.spare:
            said = _spare(car, truth, np.random.default_rng(spare_seed))
            recording = replace(recording, spare=replace(recording, samples=said, received=()))
        return truth, recording


def _spare(car: Scenario, truth: Truth, rng: np.random.Generator) -> Array:
    """Samples of a car's spare IMU (n, 6), with independent errors of the same size and the
    misalignment that the configuration allows."""
    spare = car.imu.spare
    assert spare is not None
    misalignment = np.add(spare.mounting_deg, rng.normal(0.0, spare.mounting_sd_deg, 3))
    own = {"axes": spare.axes, "mounting_deg": tuple(misalignment.tolist())}
    sits = replace(car, imu=car.imu.model_copy(update=own))
    said = sits.imu_output(truth, rng)
    return np.hstack((said.gyro, said.accel))


def gnss_fixes(receiver: GnssReceiver) -> list[Received]:
    found = []
    for k in range(len(receiver)):
        t_ns, seen_ns = (round(float(t[k]) * 1e9) for t in (receiver.t_s, receiver.t_arrival_s))
        lat, lon, height = receiver.position[k].tolist()
        north, east, down = receiver.v_ned[k].tolist()
        fix = PositionFix(
            GNSS,
            seen_ns,
            MonotonicStamp(t_ns),
            lat,
            lon,
            height,
            satellites=receiver.options.satellites,
            sd_ned_m=receiver.sd_ned_m,
            v_ned_m_s=(north, east, down),
            sd_v_ned_m_s=receiver.sd_v_ned_m_s,
        )
        found.append(Received(t_ns, seen_ns, fix))
    return found


def _without_velocity(item: Received) -> Received:
    assert isinstance(item.measurement, PositionFix)
    return replace(item, measurement=replace(item.measurement, v_ned_m_s=None))


def _rdss(centre: RdssCentre, duration_s: float) -> list[Received]:
    found = []
    for t_s in np.arange(RDSS_EVERY_S, duration_s, RDSS_EVERY_S).tolist():
        fix = centre.fix(t_s, None)
        t_ns, seen_ns = round(fix.t_s * 1e9), round(fix.t_arrival_s * 1e9)
        measured = DelayedFix(
            "rdss",
            seen_ns,
            MonotonicStamp(t_ns),
            fix.lat_deg * DEG,
            fix.lon_deg * DEG,
            fix.height_m,
            fix.precision_class_m,
        )
        found.append(Received(t_ns, seen_ns, measured))
    return found


def _wheels(truth: Truth, rng: np.random.Generator) -> list[Received]:
    """Speed of the point that follows the path."""
    t_s = np.arange(WHEEL_EVERY_S, truth.duration_s, WHEEL_EVERY_S)
    speed = truth.path.speed(t_s)[0] + WHEEL_SD_M_S * rng.standard_normal(len(t_s))
    found = []
    for t, v in zip(np.rint(t_s * 1e9).astype(int).tolist(), speed.tolist(), strict=True):
        found.append(Received(t, t, WheelSpeed("wheel", t, MonotonicStamp(t), v, WHEEL_SD_M_S)))
    return found
