"""Readers of CSV files of measurements and trajectories: degrees in files, radians in tables.

Each reader returns a table of arrays with one row an epoch, and the rows it rejected with line and
reason (see `fusiond.files.csv_tables`). NaN stands for an empty cell of an optional column. Times
are seconds on whatever timebase the file has; all files of one run share it.

The ranges only reject values that no vehicle and no device has: 100 rad/s and 1000 m/s^2 (102 g)
lie beyond the range of navigation-grade and MEMS inertial units, 10 km/s beyond orbital velocity.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drivers.immutable import immutable
from drivers.standard_atmosphere import PRESSURE_PA
from fusiond.files.csv_tables import (
    TIME,
    Column,
    Floats,
    RawTable,
    Rejection,
    Rule,
    read_table,
)

_LAT = Column("lat_deg", low=-90.0, high=90.0)
_LON = Column("lon_deg", low=-180.0, high=180.0)
_HEIGHT = Column("height_m", low=-1e4, high=1e6)
_ARRIVAL = Column("t_arrival_s", required=False, low=TIME.low, high=TIME.high)
_EARLY = Rule(
    "arrival_before_validity",
    "t_arrival_s = {t_arrival_s:.6f} is before t_s = {t_s:.6f}",
    lambda c: c["t_arrival_s"] < c["t_s"],
)


def _optional(names: tuple[str, ...], limit: float) -> list[Column]:
    return [Column(name, required=False, low=-limit, high=limit) for name in names]


def _sigma(names: tuple[str, ...]) -> list[Column]:
    return [Column(name, required=False, positive=True) for name in names]


_V = ("v_n_m_s", "v_e_m_s", "v_d_m_s")
_SD_POSITION = ("sd_n_m", "sd_e_m", "sd_d_m")
_SD_V = ("sd_vn_m_s", "sd_ve_m_s", "sd_vd_m_s")
_RPY = ("roll_deg", "pitch_deg", "yaw_deg")
_SD_RPY = ("sd_roll_deg", "sd_pitch_deg", "sd_yaw_deg")
_MAX_SPEED_M_S = 1e4
_GYRO = ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s")
_ACCEL = ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2")


def _stack(raw: RawTable, names: tuple[str, ...]) -> Floats:
    return np.stack([raw.columns[name] for name in names], axis=1)


# --------------------------------------------------------------------------- measurements


@immutable()
class ImuTable:
    """Mean angular rate (rad/s) and specific force (m/s^2) since the last row, sensor axes.

    `t_s` (n,); `samples` (n, 6): `gyro` and `accel` (n, 3), side by side.
    """

    t_s: Floats
    samples: Floats
    rejected: list[Rejection]

    @property
    def gyro(self) -> Floats:
        """Angular rates (n, 3), rad/s."""
        return self.samples[:, :3]

    @property
    def accel(self) -> Floats:
        """Specific forces (n, 3), m/s^2."""
        return self.samples[:, 3:]


def read_imu(path: Path | str) -> ImuTable:
    """Read `imu.csv`. Raises `TableError`."""
    columns = [
        TIME,
        *(Column(name, low=-100.0, high=100.0) for name in _GYRO),
        *(Column(name, low=-1000.0, high=1000.0) for name in _ACCEL),
    ]
    raw = read_table(path, columns)
    return ImuTable(raw.columns["t_s"], _stack(raw, _GYRO + _ACCEL), raw.rejected)


@immutable()
class GnssTable:
    """GNSS fixes of the antenna: geodetic position (rad, rad, m), velocity NED, one sigma each.

    `v`, `sd_position`, `sd_v` are (n, 3), the rest (n,). `quality` is the receiver's own number.
    """

    t_s: Floats
    t_arrival_s: Floats
    lat_rad: Floats
    lon_rad: Floats
    height_m: Floats
    quality: Floats
    satellites: Floats
    v: Floats
    sd_position: Floats
    sd_v: Floats
    rejected: list[Rejection]


def read_gnss(path: Path | str) -> GnssTable:
    """Read `gnss.csv`; a row of quality 0 is rejected as `no_fix`. Raises `TableError`."""
    columns = [
        TIME,
        _ARRIVAL,
        _LAT,
        _LON,
        Column("height_m", required=False, low=_HEIGHT.low, high=_HEIGHT.high),
        Column("quality", required=False, low=0.0, high=99.0),
        Column("satellites", required=False, low=0.0, high=999.0),
        *_optional(_V, _MAX_SPEED_M_S),
        *_sigma(_SD_POSITION + _SD_V),
    ]
    no_fix = Rule("no_fix", "quality = 0", lambda c: c["quality"] == 0.0)
    raw = read_table(path, columns, [_EARLY, no_fix])
    c = raw.columns
    return GnssTable(
        t_s=c["t_s"],
        t_arrival_s=c["t_arrival_s"],
        lat_rad=np.radians(c["lat_deg"]),
        lon_rad=np.radians(c["lon_deg"]),
        height_m=c["height_m"],
        quality=c["quality"],
        satellites=c["satellites"],
        v=_stack(raw, _V),
        sd_position=_stack(raw, _SD_POSITION),
        sd_v=_stack(raw, _SD_V),
        rejected=raw.rejected,
    )


@immutable()
class RdssTable:
    """RDSS fixes: `t_s` of validity, `t_arrival_s`, position (rad, rad, m), class (m); all (n,)."""

    t_s: Floats
    t_arrival_s: Floats
    lat_rad: Floats
    lon_rad: Floats
    height_m: Floats
    precision_class_m: Floats
    multi_value: np.ndarray[tuple[int], np.dtype[np.bool_]]
    rejected: list[Rejection]


def read_rdss(path: Path | str) -> RdssTable:
    """Read `rdss.csv`. Raises `TableError`."""
    columns = [
        TIME,
        Column("t_arrival_s", low=TIME.low, high=TIME.high),
        _LAT,
        _LON,
        _HEIGHT,
        Column("precision_class_m", positive=True),
        Column("multi_value", required=False, low=0.0, high=1.0),
    ]
    raw = read_table(path, columns, [_EARLY])
    c = raw.columns
    return RdssTable(
        t_s=c["t_s"],
        t_arrival_s=c["t_arrival_s"],
        lat_rad=np.radians(c["lat_deg"]),
        lon_rad=np.radians(c["lon_deg"]),
        height_m=c["height_m"],
        precision_class_m=c["precision_class_m"],
        multi_value=c["multi_value"] > 0.0,
        rejected=raw.rejected,
    )


@immutable()
class AttitudeTable:
    """Roll, pitch, yaw (rad, NED to body, 3-2-1) and one sigma, (n, 3); NaN: not given."""

    t_s: Floats
    t_arrival_s: Floats
    rpy: Floats
    sd_rpy: Floats
    rejected: list[Rejection]


_ANGLES = [
    Column("roll_deg", required=False, low=-180.0, high=180.0),
    Column("pitch_deg", required=False, low=-90.0, high=90.0),
    Column("yaw_deg", required=False, low=-360.0, high=360.0),
]


def read_attitude(path: Path | str) -> AttitudeTable:
    """Read `attitude.csv`; each angle that is given needs its sigma. Raises `TableError`."""
    rules = [
        _EARLY,
        Rule(
            "missing",
            "no angle is given",
            lambda c: np.isnan(c[_RPY[0]]) & np.isnan(c[_RPY[1]]) & np.isnan(c[_RPY[2]]),
        ),
        *(_angle_without_sigma(angle, sd) for angle, sd in zip(_RPY, _SD_RPY, strict=True)),
    ]
    raw = read_table(path, [TIME, _ARRIVAL, *_ANGLES, *_sigma(_SD_RPY)], rules)
    return AttitudeTable(
        raw.columns["t_s"],
        raw.columns["t_arrival_s"],
        np.radians(_stack(raw, _RPY)),
        np.radians(_stack(raw, _SD_RPY)),
        raw.rejected,
    )


def _angle_without_sigma(angle: str, sd: str) -> Rule:
    return Rule("missing", f"{sd} is not given", lambda c: np.isfinite(c[angle]) & np.isnan(c[sd]))


@immutable()
class BearingTable:
    """Azimuth and elevation (rad, sensor axes) of known points and one sigma, (n, 2); `point`
    latitude, longitude (rad), height (m), (n, 3). NaN sigma: not given."""

    t_s: Floats
    t_arrival_s: Floats
    angles: Floats
    sd: Floats
    point: Floats
    rejected: list[Rejection]


_DIRECTION, _SD_DIRECTION = ("azimuth_deg", "elevation_deg"), ("sd_azimuth_deg", "sd_elevation_deg")
_PLACES = {"target_lat_deg": _LAT, "target_lon_deg": _LON, "target_height_m": _HEIGHT}


def read_bearing(path: Path | str) -> BearingTable:
    """Read `bearing.csv`; a sigma of both angles or of neither. Raises `TableError`."""
    columns = [
        TIME,
        _ARRIVAL,
        Column("azimuth_deg", low=-360.0, high=360.0),
        Column("elevation_deg", low=-90.0, high=90.0),
        *_sigma(_SD_DIRECTION),
        *(Column(name, low=c.low, high=c.high) for name, c in _PLACES.items()),
    ]
    one = Rule(
        "missing",
        "one of the two sigmas is not given",
        lambda c: np.isnan(c[_SD_DIRECTION[0]]) != np.isnan(c[_SD_DIRECTION[1]]),
    )
    raw = read_table(path, columns, [_EARLY, one])
    point = _stack(raw, tuple(_PLACES))
    point[:, :2] = np.radians(point[:, :2])
    return BearingTable(
        raw.columns["t_s"],
        raw.columns["t_arrival_s"],
        np.radians(_stack(raw, _DIRECTION)),
        np.radians(_stack(raw, _SD_DIRECTION)),
        point,
        raw.rejected,
    )


@immutable()
class WheelTable:
    """Speed along the vehicle's forward axis and one sigma (m/s), (n,).

    `step_m_s` is the step to which the speed was rounded. `unsigned` 1: forward and backward look
    alike.
    """

    t_s: Floats
    t_arrival_s: Floats
    speed_m_s: Floats
    sd_m_s: Floats
    step_m_s: Floats
    unsigned: Floats
    rejected: list[Rejection]


def read_wheel(path: Path | str) -> WheelTable:
    """Read `wheel.csv`: t_s, speed_m_s and, where known, sd_m_s, step_m_s, unsigned (0 or 1).

    Raises `TableError`.
    """
    columns = [
        TIME,
        _ARRIVAL,
        Column("speed_m_s", low=-_MAX_SPEED_M_S, high=_MAX_SPEED_M_S),
        *_sigma(("sd_m_s", "step_m_s")),
        Column("unsigned", required=False, low=0.0, high=1.0),
    ]
    raw = read_table(path, columns, [_EARLY])
    c = raw.columns
    return WheelTable(
        c["t_s"],
        c["t_arrival_s"],
        c["speed_m_s"],
        c["sd_m_s"],
        c["step_m_s"],
        c["unsigned"],
        raw.rejected,
    )


@immutable()
class BarometerTable:
    """Air pressure (Pa) and one sigma of the corresponding height (m), (n,)."""

    t_s: Floats
    t_arrival_s: Floats
    pressure_pa: Floats
    sd_m: Floats
    rejected: list[Rejection]


def read_barometer(path: Path | str) -> BarometerTable:
    """Read `barometer.csv`: t_s, pressure_pa and, where known, sd_m. Raises `TableError`."""
    low, high = PRESSURE_PA
    columns = [TIME, _ARRIVAL, Column("pressure_pa", low=low, high=high), *_sigma(("sd_m",))]
    raw = read_table(path, columns, [_EARLY])
    c = raw.columns
    return BarometerTable(c["t_s"], c["t_arrival_s"], c["pressure_pa"], c["sd_m"], raw.rejected)


# --------------------------------------------------------------------------- trajectories


@immutable()
class TrajectoryTable:
    """A truth or a solution: position (rad, rad, m), velocity NED, attitude, one sigma each.

    `v`, `rpy` (rad), `sd_position` (m), `sd_v`, `sd_rpy` (rad) are (n, 3), the rest (n,); NaN where
    the file does not say. `status` is the mode of each row, empty for a truth.
    """

    t_s: Floats
    lat_rad: Floats
    lon_rad: Floats
    height_m: Floats
    v: Floats
    rpy: Floats
    sd_position: Floats
    sd_v: Floats
    sd_rpy: Floats
    status: list[str]
    rejected: list[Rejection]


def _read_trajectory(path: Path | str, positions_known: bool, text: tuple[str, ...]) -> RawTable:
    columns = [
        TIME,
        *(
            Column(c.name, required=positions_known, low=c.low, high=c.high)
            for c in (_LAT, _LON, _HEIGHT)
        ),
        *_optional(_V, _MAX_SPEED_M_S),
        *_ANGLES,
        *_sigma(_SD_POSITION + _SD_V + _SD_RPY),
    ]
    return read_table(path, columns, text=text)


def _trajectory(raw: RawTable) -> TrajectoryTable:
    c = raw.columns
    return TrajectoryTable(
        t_s=c["t_s"],
        lat_rad=np.radians(c["lat_deg"]),
        lon_rad=np.radians(c["lon_deg"]),
        height_m=c["height_m"],
        v=_stack(raw, _V),
        rpy=np.radians(_stack(raw, _RPY)),
        sd_position=_stack(raw, _SD_POSITION),
        sd_v=_stack(raw, _SD_V),
        sd_rpy=np.radians(_stack(raw, _SD_RPY)),
        status=raw.text.get("status", []),
        rejected=raw.rejected,
    )


def read_truth(path: Path | str) -> TrajectoryTable:
    """Read `truth.csv`, or the positions of a `gnss.csv` as a truth. Raises `TableError`."""
    return _trajectory(_read_trajectory(path, positions_known=True, text=()))


def read_solution(path: Path | str) -> TrajectoryTable:
    """Read a solution; its position is empty while the mode is aligning. Raises `TableError`."""
    return _trajectory(_read_trajectory(path, positions_known=False, text=("status",)))
