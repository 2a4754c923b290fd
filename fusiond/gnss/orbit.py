r"""Satellite position, velocity and clock from a broadcast Keplerian ephemeris.

    A0 = sqrtA^2,  A = A0 + Adot tk,  n = sqrt(GM / A0^3) + dn,  M = M0 + (n + n' tk / 2) tk
    M = E - e sin E
    phi = atan2(sqrt(1 - e^2) sin E, cos E - e) + omega
    u = phi + cus sin 2phi + cuc cos 2phi
    r = A (1 - e cos E) + crs sin 2phi + crc cos 2phi
    i = i0 + idot tk + cis sin 2phi + cic cos 2phi
    MEO, IGSO:  Omega = Omega0 + (Omegadot - we) tk - we toe
                s = Rz(-Omega) Rx(-i) [r cos u, r sin u, 0]
    BeiDou GEO: Omega = Omega0 + Omegadot tk - we toe,  s as above, then Rz(we tk) Rx(-5 deg) s
    dt = a0 + a1 (t - toc) + a2 (t - toc)^2 + F e sqrtA sin E,   F = -2 sqrt(GM) / c^2

tk = t - toe, t the system time of transmission; R(x) are rotations of the axes. Velocity and clock
drift are the derivatives of these equations by t, with Edot = (n + n' tk) / (1 - e cos E). Angles
rad, lengths m, times s; ECEF is that of the instant of transmission (WGS 84, GTRF and BDCS agree to
centimetres). A transmission at t_sv by the satellite's clock was at t = t_sv - dt(t_sv); the
relativistic term is neglected in this one step: 50 ns move a satellite 0.2 mm.

A service's corrections (fusiond.gnss.corrections), dO of the orbit and dC of the clock, at the age
a = t - t0 of each:

    s <- s - [er ea ec] (dO + dO' a),     ea = v / |v|,  ec = s x v / |s x v|,  er = ea x ec
    dt <- dt + (C0 + C1 a + C2 a^2) / c

BeiDou's time is 14 s behind GPS time, which only this module handles: `Orbits` takes GPS time, and
toe and toc are converted to GPS time on input; `we toe` keeps the system's own toe.

Source: IS-GPS-200N 20.3.3.3.3.1, 20.3.3.4.3 and table 20-IV; BDS-SIS-ICD-B1I-3.0 5.2.4
(ephemeris parameters, with the rotation for GEO); BDS-SIS-ICD-B1C-1.0 7.7 (Adot and n', which
are 0 elsewhere); Galileo OS SIS ICD 2.1 5.1.1 and 5.1.4; RTCM 10403.3 3.5.12 (corrections).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from drivers.immutable import immutable
from drivers.raw.messages import SPEED_OF_LIGHT_M_S, Ephemeris, System
from fusiond.navigation.compiled import compiled

Array = npt.NDArray[np.float64]

WEEK_S = 604800.0
BDT_BEHIND_GPS_S = 14.0
BDT_WEEK_0_IN_GPS_WEEKS = 1356
"""2006-01-01, where BeiDou's weeks start."""

GEO_TILT_RAD = math.radians(-5.0)
_TILTED = ("d1", "d2")
"""Messages whose GEO orbits are inclined; B-CNAV has no GEO."""


class Constants(NamedTuple):
    """`gm` m^3/s^2, `earth_rate` rad/s, `relativity` F in s/sqrt(m)."""

    gm: float
    earth_rate: float
    relativity: float


CONSTANTS: dict[System, Constants] = {
    "G": Constants(3.986005e14, 7.2921151467e-5, -4.442807633e-10),
    "E": Constants(3.986004418e14, 7.2921151467e-5, -4.442807309e-10),
    "C": Constants(
        3.986004418e14, 7.2921150e-5, -2.0 * math.sqrt(3.986004418e14) / SPEED_OF_LIGHT_M_S**2
    ),
}
"""Each ICD's own: an ephemeris fits its orbit only with the constants it was made with."""


def is_beidou_geo(system: System, prn: int) -> bool:
    """True if the orbit is in the tilted frame: C01 to C05 and C59 to C63."""
    return system == "C" and (prn <= 5 or 59 <= prn <= 63)


def gps_time(system: System, week: int, seconds: float) -> tuple[int, float]:
    """Convert a system's own week and second to GPS week and second; seconds may exceed the
    week."""
    if system == "C":
        return week + BDT_WEEK_0_IN_GPS_WEEKS, seconds + BDT_BEHIND_GPS_S
    return week, seconds


# Columns of the elements' array.
_COLUMNS = 47
(
    _WEEK, _TOE, _TOC, _RATE, _F, _GEO, _OWN_TOE, _SQRT_A, _E, _ROOT, _COS_I0, _SIN_I0, _NODE,
    _COS_PERIGEE, _SIN_PERIGEE, _M0, _MOTION, _I_RATE, _NODE_RATE, _CUC, _CUS, _CRC, _CRS, _CIC,
    _CIS, _A0, _A1, _A2, _COS_TILT, _SIN_TILT, _TOC_WEEK, _AXIS_RATE,
    _MOTION_RATE, _CORRECTED, _ORBIT_WEEK, _ORBIT_TOW, _RADIAL, _ALONG, _ACROSS, _RADIAL_RATE,
    _ALONG_RATE, _ACROSS_RATE, _CLOCK_WEEK, _CLOCK_TOW, _C0, _C1, _C2,
) = range(_COLUMNS)  # fmt: skip


SMALL_RAD = 1e-3
"""Angle below which `turned` is exact to rounding."""


STATE_COLUMNS = 8
"""Position, velocity, clock offset and drift of a satellite."""


@compiled("UniTuple(f8, 2)(f8, f8, f8)", forceinline=True)
def turned(cosine: float, sine: float, small: float) -> tuple[float, float]:
    """Cosine and sine of an angle after a `small` turn (rad), at a tenth of the cost of computing
    them."""
    square = small * small
    c = 1.0 - square * (0.5 - square / 24.0)
    s = small * (1.0 - square * (1.0 / 6.0 - square / 120.0))
    return cosine * c - sine * s, sine * c + cosine * s


@compiled("void(f8[::1], f8, f8[::1])")
def _correct(q: Array, age: float, state: Array) -> None:
    """Subtract an orbit's error at an `age` (s) from the position in `state` (8,)."""
    x, y, z, vx, vy, vz = state[0], state[1], state[2], state[3], state[4], state[5]
    speed = math.sqrt(vx * vx + vy * vy + vz * vz)
    ax, ay, az = vx / speed, vy / speed, vz / speed
    cx, cy, cz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    size = math.sqrt(cx * cx + cy * cy + cz * cz)
    cx, cy, cz = cx / size, cy / size, cz / size
    rx, ry, rz = ay * cz - az * cy, az * cx - ax * cz, ax * cy - ay * cx
    r = q[_RADIAL] + q[_RADIAL_RATE] * age
    a = q[_ALONG] + q[_ALONG_RATE] * age
    c = q[_ACROSS] + q[_ACROSS_RATE] * age
    state[0] -= rx * r + ax * a + cx * c
    state[1] -= ry * r + ay * a + cy * c
    state[2] -= rz * r + az * a + cz * c


@compiled("void(f8[:, ::1], f8, f8[::1], b1, f8[:, ::1])")
def satellite_states(
    elements: Array, week: float, tow: Array, by_satellite_clock: bool, out: Array
) -> None:
    """Write (n, 8): position m, velocity m/s, clock offset s and drift s/s.

    `elements` (n, 47) rows of `Orbits`; `week`, `tow` (n,) GPS time of transmission, or the
    satellite clock's if `by_satellite_clock`.
    """
    for k in range(elements.shape[0]):
        q = elements[k]
        since_toc = (week - q[_TOC_WEEK]) * WEEK_S + (tow[k] - q[_TOC])
        tk = (week - q[_WEEK]) * WEEK_S + (tow[k] - q[_TOE])
        if by_satellite_clock:
            step = q[_A0] + (q[_A1] + q[_A2] * since_toc) * since_toc
            for _ in range(2):
                dt = since_toc - step
                step = q[_A0] + (q[_A1] + q[_A2] * dt) * dt
            since_toc -= step
            tk -= step
        sqrt_a = q[_SQRT_A]
        ecc = q[_E]
        axis = sqrt_a * sqrt_a + q[_AXIS_RATE] * tk
        mean = q[_M0] + (q[_MOTION] + 0.5 * q[_MOTION_RATE] * tk) * tk
        anomaly = mean + ecc * math.sin(mean)
        cos_e, sin_e = math.cos(anomaly), math.sin(anomaly)
        for _ in range(12):  # Newton: two steps suffice at e = 0.02
            change = (anomaly - ecc * sin_e - mean) / (1.0 - ecc * cos_e)
            anomaly -= change
            if abs(change) < SMALL_RAD:
                cos_e, sin_e = turned(cos_e, sin_e, -change)
            else:
                cos_e, sin_e = math.cos(anomaly), math.sin(anomaly)
            if abs(change) < 1e-8:
                break
        nearness = 1.0 - ecc * cos_e
        anomaly_rate, root = (q[_MOTION] + q[_MOTION_RATE] * tk) / nearness, q[_ROOT]
        sin_true, cos_true = root * sin_e / nearness, (cos_e - ecc) / nearness
        cos_phi = cos_true * q[_COS_PERIGEE] - sin_true * q[_SIN_PERIGEE]
        sin_phi = sin_true * q[_COS_PERIGEE] + cos_true * q[_SIN_PERIGEE]
        phi_rate = root * anomaly_rate / nearness
        s2, c2 = 2.0 * sin_phi * cos_phi, (cos_phi - sin_phi) * (cos_phi + sin_phi)
        u_rate = phi_rate * (1.0 + 2.0 * (q[_CUS] * c2 - q[_CUC] * s2))
        r = axis * nearness + q[_CRS] * s2 + q[_CRC] * c2
        r_rate = axis * ecc * sin_e * anomaly_rate + 2.0 * phi_rate * (q[_CRS] * c2 - q[_CRC] * s2)
        r_rate += q[_AXIS_RATE] * nearness
        inc_rate = q[_I_RATE] + 2.0 * phi_rate * (q[_CIS] * c2 - q[_CIC] * s2)
        we = q[_RATE]
        geo = q[_GEO] > 0.0
        node_rate = q[_NODE_RATE] if geo else q[_NODE_RATE] - we
        node = q[_NODE] + node_rate * tk - we * q[_OWN_TOE]
        cu, su = turned(cos_phi, sin_phi, q[_CUS] * s2 + q[_CUC] * c2)
        lean = q[_I_RATE] * tk + q[_CIS] * s2 + q[_CIC] * c2
        ci, si = turned(q[_COS_I0], q[_SIN_I0], lean)
        so, co = math.sin(node), math.cos(node)
        px, py = r * cu, r * su
        px_rate = r_rate * cu - py * u_rate
        py_rate = r_rate * su + px * u_rate
        level, level_rate = py * ci, py_rate * ci - py * si * inc_rate
        x = px * co - level * so
        y = px * so + level * co
        z = py * si
        vx = px_rate * co - level_rate * so - y * node_rate
        vy = px_rate * so + level_rate * co + x * node_rate
        vz = py_rate * si + level * inc_rate
        if geo:
            ct, st = q[_COS_TILT], q[_SIN_TILT]
            y, z = y * ct + z * st, z * ct - y * st
            vy, vz = vy * ct + vz * st, vz * ct - vy * st
            turn = we * tk
            cz, sz = math.cos(turn), math.sin(turn)
            x, y = x * cz + y * sz, y * cz - x * sz
            vx, vy = vx * cz + vy * sz + we * y, vy * cz - vx * sz - we * x
        out[k, 0], out[k, 1], out[k, 2] = x, y, z
        out[k, 3], out[k, 4], out[k, 5] = vx, vy, vz
        relativity = q[_F] * ecc * sqrt_a
        out[k, 6] = q[_A0] + (q[_A1] + q[_A2] * since_toc) * since_toc + relativity * sin_e
        out[k, 7] = q[_A1] + 2.0 * q[_A2] * since_toc + relativity * cos_e * anomaly_rate
        if q[_CORRECTED] > 0.0:
            _correct(q, (week - q[_ORBIT_WEEK]) * WEEK_S + (tow[k] - q[_ORBIT_TOW]), out[k])
            age = (week - q[_CLOCK_WEEK]) * WEEK_S + (tow[k] - q[_CLOCK_TOW])
            out[k, 6] += (q[_C0] + (q[_C1] + q[_C2] * age) * age) / SPEED_OF_LIGHT_M_S
            out[k, 7] += (q[_C1] + 2.0 * q[_C2] * age) / SPEED_OF_LIGHT_M_S


NOT_CORRECTED = (0.0,) * 14
"""Last columns of a satellite without corrections."""


def elements_row(ephemeris: Ephemeris, corrected: Sequence[float] = NOT_CORRECTED) -> Array:
    """Row (47,) of an ephemeris for `satellite_states`. `corrected` (14,): 1; week and second (GPS
    time) of the orbit correction, radial, along, across (m), their rates; week and second of the
    clock correction, C0, C1, C2."""
    e = ephemeris
    constants = CONSTANTS[e.system]
    week, toe = gps_time(e.system, e.week, e.toe_s)
    _, toc = gps_time(e.system, e.week, e.toc_s)
    # toc is in the week nearest to toe, from which it differs by hours
    toc_week = week + round((toe - toc) / WEEK_S)
    axis = e.sqrt_a * e.sqrt_a
    motion = math.sqrt(constants.gm / axis) / axis + e.mean_motion_correction
    values = (
        week, toe, toc, constants.earth_rate, constants.relativity,
        is_beidou_geo(e.system, e.prn) and e.message in _TILTED, e.toe_s, e.sqrt_a, e.eccentricity,
        math.sqrt(1.0 - e.eccentricity * e.eccentricity), math.cos(e.inclination),
        math.sin(e.inclination), e.ascending_node, math.cos(e.perigee), math.sin(e.perigee),
        e.mean_anomaly, motion, e.inclination_rate, e.ascending_node_rate, e.cuc, e.cus, e.crc,
        e.crs, e.cic, e.cis, e.clock_bias_s, e.clock_drift, e.clock_drift_rate,
        math.cos(GEO_TILT_RAD), math.sin(GEO_TILT_RAD), toc_week, e.semi_major_rate,
        e.mean_motion_rate, *corrected,
    )  # fmt: skip
    return np.array(values, float)


class SatelliteStates(NamedTuple):
    """Satellite states: `position` (n, 3) m and `velocity` (n, 3) m/s in ECEF, `clock_s` (n,),
    `clock_drift` (n,)."""

    position: Array
    velocity: Array
    clock_s: Array
    clock_drift: Array


@immutable()
class Orbits:
    """Ephemerides of n satellites, stacked once: `elements` (n, 47)."""

    elements: Array

    @classmethod
    def of(
        cls, ephemerides: Sequence[Ephemeris], corrected: Sequence[Sequence[float]] = ()
    ) -> Orbits:
        """Stack ephemerides in order, each with its correction, if any."""
        given = corrected or (NOT_CORRECTED,) * len(ephemerides)
        rows = [elements_row(e, c) for e, c in zip(ephemerides, given, strict=True)]
        return cls(np.array(rows).reshape(len(rows), _COLUMNS))

    def at(self, week: int, tow_s: float | Array) -> SatelliteStates:
        """States at a GPS time of transmission: week and seconds, () or (n,)."""
        return self._states(week, tow_s, False)

    def sent(self, week: int, tow_s: float, pseudorange_m: Array) -> SatelliteStates:
        """States at the transmission of signals received at `tow_s` of the receiver's clock.

        Receiver time minus pseudorange / c is the satellite clock's time of transmission, whatever
        the receiver's clock error, so no iteration over the flight time is needed.
        """
        return self._states(week, tow_s - pseudorange_m / SPEED_OF_LIGHT_M_S, True)

    def _states(self, week: int, tow_s: float | Array, by_clock: bool) -> SatelliteStates:
        n = len(self.elements)
        out = np.empty((n, STATE_COLUMNS))
        tow = np.empty(n)
        tow[:] = tow_s
        satellite_states(self.elements, float(week), tow, by_clock, out)
        return SatelliteStates(out[:, :3], out[:, 3:6], out[:, 6], out[:, 7])
