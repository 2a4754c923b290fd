"""Sections `[aiding.NAME]`: use of a source's measurements in the filter, in data sheets' units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, Self, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
)

Vector = tuple[float, float, float]
Place = tuple[
    Annotated[float, Field(ge=-90.0, le=90.0)],
    Annotated[float, Field(ge=-180.0, le=180.0)],
    Annotated[float, Field(ge=-1000.0, le=20000.0)],
]
"""Latitude, longitude (deg), ellipsoidal height (m) of a place on land."""
Probability = Annotated[float, Field(gt=0.0, lt=1.0)]

UNKNOWN_BIAS_SD_M = 1.0
"""Error shared by fixes where neither receiver nor configuration states it: half of a data sheet's
1.5 to 2 m is noise."""
UNKNOWN_LEVER_SD_M = 1.0
"""Sigma of an unknown antenna position on each axis, for a car or van: 0.5 to 3 m from the IMU."""


class Section(BaseModel):
    """Base of every section: frozen, unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    @classmethod
    def unsaid(cls) -> Self:
        """Default for a section that the file lacks: `cls()`, less the validator that pydantic
        would build for each alone, beside that of the whole, and then find nothing to validate."""
        return cls.model_construct()


class Aiding(Section):
    """Common options of aiding sections: lever arm and gate."""

    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    """Body axes (forward, right, down), from the IMU to the device's reference point."""
    gate_probability: Probability = 0.9999
    """Probability with which a correct measurement passes the gate."""
    sigma_scale: PositiveFloat = 1.0
    """Factor on every sigma that the device states; above 1 for an optimistic device."""
    robust: bool = False
    """True: outliers get less weight (Student's t) instead of being rejected; for fixes among
    houses. See `docs/estimators.md`."""


class GnssAiding(Aiding):
    """Position and velocity fixes of a GNSS receiver."""

    kind: Literal["gnss"] = "gnss"
    use_velocity: bool = True
    """True if the receiver's velocity is a measurement too."""
    range_error_m: PositiveFloat = 3.0
    """Range error; times DOP it is the sigma of a fix without GST. See `docs/gnss-nmea.md`."""
    velocity_sd_m_s: PositiveFloat = 0.1
    """Sigma where the receiver states none."""
    min_position_sd_m: PositiveFloat | None = None
    """Least sigma of a position. Default by the fix's quality: 0.3 m by code (0.5 m of height),
    0.05 m RTK float, 0.02 m RTK fixed."""
    min_velocity_sd_m_s: PositiveFloat = 0.02
    """Least sigma of a velocity."""
    velocity_delay_s: NonNegativeFloat = 0.0
    """Age of the velocity at the fix's instant; half an epoch if the receiver averages over one."""
    time_offset_sd_s: NonNegativeFloat = 0.1
    """Offset of validity from the stamps, for fixes and velocities: one sigma of offsets that the
    filter estimates. A serial line's latency is known to 0.1 s. 0: none is."""
    time_sd_s: NonNegativeFloat = 0.0
    """Timing error of a single fix against the IMU; multiplied by the speed it adds to sigma."""
    lever_arm_sd_m: NonNegativeFloat | None = None
    """One sigma of the error of `lever_arm_m` on each axis; the filter estimates that error. 0:
    exact. Default: 1 m for the only receiver if its `lever_arm_m` is not set, else 0."""
    bias_sd_m: NonNegativeFloat | None = None
    """One sigma, north and east, of an error that fixes share for minutes (orbits, ionosphere),
    beside the stated sigma; carrier-phase fixes have half of what they state. Default: as the
    receiver's velocities show, or 1 m without velocities, since data sheets state 1.5 to 2 m for
    half of all fixes, noise included. 0: no shared error is estimated, nor one that lasts for
    seconds, and sigma shrinks as if errors were white."""
    bias_down_sd_m: PositiveFloat = 3.0
    """Down component of the shared error, which has most of the ionosphere."""
    bias_correlation_s: PositiveFloat = 1800.0
    """Correlation time of that error."""

    @property
    def shared_sd_m(self) -> float:
        """Value of `bias_sd_m`, or its default."""
        return UNKNOWN_BIAS_SD_M if self.bias_sd_m is None else self.bias_sd_m


class RawAiding(Aiding):
    """Pseudoranges and rates of a GNSS receiver, satellite by satellite; see `docs/gnss-raw.md`."""

    kind: Literal["raw"] = "raw"
    systems: tuple[Literal["G", "E", "C"], ...] = ("G", "E", "C")
    """GPS, Galileo, BeiDou: which to use. Each has a clock offset of its own."""
    elevation_mask_deg: Annotated[float, Field(ge=0.0, lt=90.0)] = 10.0
    """Lower satellites are not used."""
    cno_mask_db_hz: NonNegativeFloat = 28.0
    """Weaker signals are not used."""
    best_four: bool = False
    """Use only the four satellites of smallest GDOP (paper 002), not all in view."""
    bias_sd_m: NonNegativeFloat = 0.5
    """One sigma, north and east, of a displacement that the ranges share for minutes (orbits,
    multipath), with eight satellites; less with more. 0: not estimated, and sigma shrinks as if
    errors were white."""
    bias_down_sd_m: PositiveFloat = 1.0
    """Down component of the shared displacement, beside the residual of ionosphere and troposphere
    models."""
    bias_correlation_s: PositiveFloat = 1800.0
    """Correlation time of that displacement."""
    clock_phase_m_sqrt_s: PositiveFloat = 0.1
    """Random walk of the receiver clock's offset; a temperature-compensated crystal's."""
    clock_drift_m_s_sqrt_s: PositiveFloat = 0.2
    """Random walk of the clock's drift; likewise."""
    clock_drift_tau_s: PositiveFloat | None = None
    """Correlation time of the drift as a first-order Markov process about zero (paper 003), of the
    same density over shorter times; without it the drift is a random walk. Unsuitable for a crystal
    with a constant offset."""
    start_velocity_sd_m_s: PositiveFloat = 0.2
    """One sigma of the velocity from one epoch's rates, for alignment."""


class RdssAiding(Aiding):
    """BeiDou RDSS fixes: late, horizontal, 20 or 100 m class."""

    kind: Literal["rdss"] = "rdss"
    strategy: Literal["rewind", "optimal_prediction", "position_compensation", "none"] = "rewind"
    """Treatment of the delay; see `docs/rdss-strategies.md`. `rewind` is exact."""
    noise: Literal["geometry", "class"] = "geometry"
    """Covariance from the satellites' geometry with the terminal's class as its floor, or the class
    alone on both axes."""
    satellites_deg: tuple[float, float] = (80.0, 140.0)
    """Longitudes of the two geostationary satellites, east positive."""
    range_sd_m: PositiveFloat = 15.3
    """One sigma of a slant range after differential correction: 8 m satellite drift and 13 m
    ranging."""
    height_sd_m: PositiveFloat = 10.0
    """One sigma of the height in the centre's solution. If the request gave the solution's height,
    that height's sigma is used."""
    fix_height_sd_m: PositiveFloat | None = 30.0
    """One sigma of the fix's height. A height from the request is not used, since it is the
    solution's own. Without any height measurement an inertial height diverges."""
    bias_sd_m: NonNegativeFloat = 15.0
    """One sigma on each axis of an error that successive fixes share (height model, satellite
    positions). 0: not estimated; `docs/rdss-strategies.md` shows that sigma is then too small."""
    bias_correlation_s: PositiveFloat = 600.0
    """Correlation time of that error."""


class AttitudeAiding(Aiding):
    kind: Literal["attitude"] = "attitude"


class Misaligned(Aiding):
    """Measurement by a misaligned sensor: three small angles that the filter estimates.

    The angles rotate body axes to sensor axes; the device has removed the known mounting.
    """

    misalignment_sd_arcsec: NonNegativeFloat = 200.0
    """One sigma of each angle before it is estimated; 0: not estimated."""
    misalignment_correlation_s: PositiveFloat | None = None
    """Correlation time of the angles, if mount or airframe bend; default: they are constant."""


class StarTrackerAiding(Misaligned):
    """Attitude of a star tracker against north-east-down; see `docs/star-tracker-sar.md`."""

    kind: Literal["star_tracker"] = "star_tracker"
    sd_arcsec: PositiveFloat = 200.0
    """One sigma of roll, pitch and yaw if the device states none (paper 001)."""


class SarAiding(Misaligned):
    """Azimuth and elevation of known points in a radar's image; see `docs/star-tracker-sar.md`."""

    kind: Literal["sar"] = "sar"
    sd_arcsec: PositiveFloat = 100.0
    """One sigma of azimuth and elevation if the device states none."""
    min_range_m: PositiveFloat = 1000.0
    """A nearer point is rejected as `too_close`: 16 m of position error turn its angles by half the
    default sigma."""
    targets_deg_m: dict[str, Place] = Field(default_factory=dict)
    """Known points, by the device's number or name: latitude, longitude (deg), ellipsoidal height
    (m)."""


class HeadingAiding(Aiding):
    kind: Literal["heading"] = "heading"
    sd_deg: PositiveFloat = 1.0


class CompassAiding(Aiding):
    """Heading of a compass, with its deviation as states; see `docs/compass.md`."""

    kind: Literal["compass"] = "compass"
    sd_deg: PositiveFloat = 1.0
    """Noise of a single reading."""
    declination_deg: Annotated[float, Field(ge=-180.0, le=180.0)] | None = None
    """Declination, east positive. Default: the World Magnetic Model at place and date of the
    fixes."""
    deviation_sd_deg: PositiveFloat = 5.0
    """One sigma of the deviation at any heading, as left in a steel vehicle after compensation. The
    filter estimates it."""
    disturbance_sd_deg: PositiveFloat = 3.0
    """One sigma of errors that last for seconds: bridges, vehicles beside, own currents."""
    disturbance_s: PositiveFloat = 20.0
    """Correlation time of those errors."""


class HeightAiding(Aiding):
    kind: Literal["height"] = "height"
    sd_m: PositiveFloat = 5.0


class BarometerAiding(Aiding):
    """Height by air pressure, with states for its errors; see `docs/can-height.md`."""

    kind: Literal["barometer"] = "barometer"
    sd_m: PositiveFloat = 5.0
    """Sigma where the device states none: gusts of 0.5 m that last for 5 s, at ten measurements a
    second."""
    weather_sd_m: PositiveFloat = 100.0
    """One sigma of the offset at first: 10 hPa of weather (80 m) and the geoid (30 m)."""
    weather_walk_m_sqrt_s: PositiveFloat = 0.15
    """Random walk of the offset: 9 m in an hour, by the weather and by driving through it."""
    temperature_sd: PositiveFloat = 0.04
    """One sigma of the scale error: 4 % in air 10 K off the standard."""
    airflow_sd: PositiveFloat = 0.1
    """Share of the dynamic pressure missing at the sensor's place: 2 m at 20 m/s."""


class WheelAiding(Aiding):
    """Speed of the vehicle from its wheels; see `docs/vehicle.md`."""

    kind: Literal["wheel"] = "wheel"
    sd_m_s: PositiveFloat = 0.1
    """Sigma where the device states none."""
    scale: PositiveFloat = 1.0
    """Ratio of the device's speed to the true speed; `fusiond calibrate` finds it."""
    latency_s: float = 0.0
    """Latency of a speed."""
    drift_sd_m_s: NonNegativeFloat = 0.1
    """One sigma of lasting errors (slip, wheel load, rounding at a steady speed), a state; 0: none.
    """
    drift_s: PositiveFloat = 1.0
    """Correlation time of that error."""
    scale_sd: NonNegativeFloat = 0.02
    """One sigma of the error of `scale`; the filter estimates it. Tyres wear by 2 % of their
    radius. 0: exact."""
    latency_sd_s: NonNegativeFloat = 0.2
    """One sigma of the error of `latency_s`; the filter estimates it. 0: exact."""


AnyAiding = Annotated[
    GnssAiding
    | RawAiding
    | RdssAiding
    | AttitudeAiding
    | StarTrackerAiding
    | SarAiding
    | HeadingAiding
    | CompassAiding
    | HeightAiding
    | BarometerAiding
    | WheelAiding,
    Field(discriminator="kind"),
]
AIDING_KINDS = tuple(
    section.model_fields["kind"].default for section in get_args(get_args(AnyAiding)[0])
)


def lever_sd_m(section: GnssAiding, aiding: Mapping[str, Aiding]) -> float:
    """One sigma (m) on each axis of a receiver's lever arm error, for the sections `aiding` by
    source; 0: not estimated. Two receivers' lever arms share one reference point and would exceed
    the kernels' states."""
    if section.lever_arm_sd_m is not None:
        return section.lever_arm_sd_m
    receivers = sum(isinstance(each, GnssAiding) for each in aiding.values())
    given = "lever_arm_m" in section.model_fields_set
    return 0.0 if given or receivers > 1 else UNKNOWN_LEVER_SD_M
