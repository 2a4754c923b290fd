"""Measurements, stamps and events that drivers emit, in SI units.

A driver does not decide *when* a measurement was valid. It reports the device's own stamp (one of
the `Stamp` classes) and `t_seen_ns`, the host's monotonic clock (`drivers.base`) when the last byte
or frame arrived. The consumer of the measurement resolves the stamp to an instant of validity.

Frames: *sensor* axes are the device's own; *body* is forward-right-down; *NED* is
north-east-down at the point that the measurement speaks of. Angles are radians unless a name says
otherwise. Latitude, longitude and height are geodetic on WGS 84 (CGCS2000 agrees to centimetres).

`rounding_sd` is one sigma of the device's rounding (`drivers.quantization`), in addition to the
sigma that it states or the configuration holds; 0 if the resolution is fine or unknown.
"""

from __future__ import annotations

from drivers.immutable import immutable

Vector3 = tuple[float, float, float]

# --------------------------------------------------------------------------- stamps


@immutable()
class ArrivalStamp:
    """Stamp without a device's time: valid `latency_s` before the measurement was seen."""

    latency_s: float = 0.0


@immutable()
class MonotonicStamp:
    """Instant on the host's monotonic clock (files, simulation)."""

    t_ns: int


@immutable()
class KernelStamp:
    """Receive stamp of the kernel, CLOCK_REALTIME, in ns; `latency_s` from validity to stamp."""

    realtime_ns: int
    latency_s: float = 0.0


@immutable()
class DeviceStamp:
    """Time of a device's free-running clock, unwrapped by the driver; `device` names the clock."""

    device: str
    ticks_ns: int


@immutable()
class UtcStamp:
    """Full UTC instant as POSIX nanoseconds (a leap second repeats the last second's count)."""

    utc_ns: int


@immutable()
class TimeOfDayStamp:
    """Time of day without a date, in one of several possible zones.

    `time_of_day_s` may reach 86401 (leap second). `zones_h` lists the possible offsets of the
    printed time from UTC. `requested_ns` is the monotonic instant of the request, None without one.
    `uncertainty_s` bounds the error of the printed fraction.
    """

    time_of_day_s: float
    zones_h: tuple[int, ...] = (0,)
    requested_ns: int | None = None
    uncertainty_s: float = 0.0


Stamp = ArrivalStamp | MonotonicStamp | KernelStamp | DeviceStamp | UtcStamp | TimeOfDayStamp


# --------------------------------------------------------------------------- measurements


@immutable()
class ImuSample:
    """Mean angular rate (rad/s) and specific force (m/s^2) since the last sample, sensor axes."""

    source: str
    t_seen_ns: int
    stamp: Stamp
    gyro_rad_s: Vector3
    accel_m_s2: Vector3


@immutable()
class PositionFix:
    """Fix of a GNSS receiver's antenna, with velocity if stated.

    `sd_ned_m` and `sd_v_ned_m_s` are one sigma; None if the device states none (then the configured
    sigma is used). A velocity whose down part is None is horizontal only. `quality` follows NMEA
    GGA: 1 autonomous, 2 differential, 4 RTK fixed, 5 RTK float. `height_m` is None if the device
    does not know it. If the device does not state the geoid's height, `height_m` is above the sea,
    and `geoid_sd_m` is one sigma of the geoid's height, an error that all fixes of a neighbourhood
    share; otherwise 0.
    """

    source: str
    t_seen_ns: int
    stamp: Stamp
    lat_rad: float
    lon_rad: float
    height_m: float | None
    quality: int = 1
    satellites: int | None = None
    hdop: float | None = None
    vdop: float | None = None
    sd_ned_m: Vector3 | None = None
    v_ned_m_s: tuple[float, float, float | None] | None = None
    sd_v_ned_m_s: tuple[float, float, float | None] | None = None
    rounding_sd_ned_m: Vector3 = (0.0, 0.0, 0.0)
    rounding_sd_v_m_s: float = 0.0
    geoid_sd_m: float = 0.0


@immutable()
class DelayedFix:
    """BeiDou RDSS fix: position of the terminal when its request left the antenna.

    `precision_class_m` is the class that the centre states (20 or 100 m). `height_m` is the height
    that the centre used, not an independent measurement. `multi_value`: two solutions were
    possible. `height_given`: the height was ours, by the request or by our barometer's pressure, so
    it is no new information; `height_sd_m` is then its sigma, None if unknown.
    """

    source: str
    t_seen_ns: int
    stamp: Stamp
    lat_rad: float
    lon_rad: float
    height_m: float
    precision_class_m: float
    multi_value: bool = False
    height_given: bool = False
    height_sd_m: float | None = None


@immutable()
class Attitude:
    """Roll, pitch, yaw (rad, NED to body, 3-2-1) with one sigma; NaN for an angle not given.

    A star tracker's attitude is converted to north-east-down, too. The sigma of an angle is NaN if
    the device states none.
    """

    source: str
    t_seen_ns: int
    stamp: Stamp
    rpy_rad: Vector3
    sd_rpy_rad: Vector3


@immutable()
class Bearing:
    """Direction from the antenna to a known point (SAR image match), in *sensor* axes.

    Sensor axes are nominally those of the body: x forward, y right, z down. `azimuth_rad` runs from
    x towards y, `elevation_rad` is positive upwards (against z) from the x-y plane. `sd_rad` is one
    sigma of the two, None where the device does not say. `target` names the point; `point` is its
    latitude, longitude (rad) and ellipsoidal height (m), None where the configuration holds it.
    """

    source: str
    t_seen_ns: int
    stamp: Stamp
    azimuth_rad: float
    elevation_rad: float
    sd_rad: tuple[float, float] | None
    target: str
    point: Vector3 | None = None


@immutable()
class Heading:
    """True heading of the body's forward axis (rad, from north, clockwise), one sigma if given."""

    source: str
    t_seen_ns: int
    stamp: Stamp
    yaw_rad: float
    sd_rad: float | None = None
    rounding_sd_rad: float = 0.0


@immutable()
class MagneticHeading:
    """Magnetic heading of a compass: heading of the body's forward axis from magnetic north (rad,
    clockwise), with whatever deviation the vehicle's own iron and currents make."""

    source: str
    t_seen_ns: int
    stamp: Stamp
    yaw_rad: float
    rounding_sd_rad: float = 0.0


@immutable()
class Height:
    """Ellipsoidal height of the body origin (m), one sigma if given.

    `barometric`: height of a pressure in the standard atmosphere. Its changes are right; the
    weather adds an error of 8 m a hPa, which stays for hours.
    """

    source: str
    t_seen_ns: int
    stamp: Stamp
    height_m: float
    sd_m: float | None = None
    rounding_sd_m: float = 0.0
    barometric: bool = False


@immutable()
class WheelSpeed:
    """Speed of the vehicle along its forward axis at the wheel's point (m/s), one sigma if given.

    Without `signed` the device does not distinguish forward from backward, and the speed is an
    absolute value. `shared_step_m_s`: the step of a rounding, up, down or to the nearest;
    `drivers.quantization` has the part of `rounding_sd_m_s` that all readings share.
    """

    source: str
    t_seen_ns: int
    stamp: Stamp
    speed_m_s: float
    sd_m_s: float | None = None
    rounding_sd_m_s: float = 0.0
    signed: bool = True
    shared_step_m_s: float = 0.0


@immutable()
class TimeReport:
    """UTC from a device (NMEA RMC/ZDA, RDSS SJXX/BDZDA), for the clock.

    `trusted` is False while the device marks its time as invalid.
    """

    source: str
    t_seen_ns: int
    utc_ns: int
    trusted: bool


Measurement = (
    ImuSample
    | PositionFix
    | DelayedFix
    | Attitude
    | Bearing
    | Heading
    | MagneticHeading
    | Height
    | WheelSpeed
    | TimeReport
)


@immutable()
class DeviceEvent:
    """Event of a device for the operator: a stable code and one sentence."""

    source: str
    t_seen_ns: int
    code: str
    text: str
