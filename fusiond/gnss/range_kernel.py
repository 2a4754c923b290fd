r"""Range and range rate equations of all satellites of an epoch.

    rho = |s - r|,  l = (s - r) / rho,   s = Rz(we tau) s_t,  tau = rho / c,  v = Rz(we tau) v_t
    P + c (dt - d) - T - I = rho + b_system + noise
    D (1 + l . v_i / c) + c ddt = l . (v - v_r) + d + noise,    v_i = v + we x s

For a satellite with two carriers I is measured by them (fusiond.gnss.carrier_phase), with variance
V, up to an offset common to its system's signals (the receiver's delay between the bands). With I0
the model's delay, p its unknown share, and sums over the satellites k of its group

    B   = sum w_k (I_k - I0_k) / sum w_k,       w_k = 1 / (V_k + p^2 I0_k^2)
    M   = sum w_k I0_k / sum w_k
    I   = I0 + B + a (I_k - I0 - B),            a = s^2 / (s^2 + V),  a = 0 with one carrier
    s^2 = p^2 (I0 - M)^2 + (0.3 p I0)^2
    var = a^2 V + a 2 cov(P, I_k),              left in common: (1 - a) p (I0 - M)

because with known B a model that is too strong or too weak has the error p (I0 - M), and another
one of 0.3 p I0 in each direction. A group is the signals of one carrier of GPS, Galileo, BeiDou-3
or BeiDou-2; without pairs B = 0. So a satellite with one carrier, or a new one, gets the model's
delay, shifted to the level that the others measure.

s_t, v_t are the satellite's position and velocity at transmission, turned into the ECEF frame of
the instant of reception; r, v_r the receiver's; P pseudorange, D pseudorange rate (m, m/s; positive
while the distance grows); dt, ddt the satellite's clock offset and drift, d the signal's group
delay; T, I troposphere and ionosphere (m); b the receiver's clock offset (m), d its drift (m/s).
The factor of D, worth up to 2 mm/s, is there because transmission time runs 1 - rhodot/c times as
fast as reception time.

A carrier gives a range plus a constant: its length minus T plus I0 (the ionosphere advances a phase
as much as it delays a code), with the satellite's clock, without group delay.

r is taken at the time of the receiver's clock: with an error of 1 ms it is off by 3 cm at 30 m/s.

Variances: see `fusiond.gnss.ranges`. `LASTING` is the variance of errors that last for many minutes
and belong to one satellite: orbit, clock, group delay, the local residual of the ionosphere, and
the error of its two carriers' delay.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from drivers.raw.messages import SIGNAL_VALUES, SPEED_OF_LIGHT_M_S
from fusiond.gnss.atmosphere import (
    klobuchar_beidou,
    klobuchar_gps,
    mapping,
    mapping_coefficients,
    slant,
    zenith_delays,
)
from fusiond.gnss.bdgim import bdgim
from fusiond.gnss.carrier_phase import CARRIER as LENGTH
from fusiond.gnss.carrier_phase import CARRIER_VARIANCE as LENGTH_VARIANCE
from fusiond.gnss.carrier_phase import (
    CNO,
    GROWN,
    SLANT,
    SLANT_VARIANCE,
    SPAN,
    WITH_CODE,
)
from fusiond.gnss.carrier_phase import RATE as DOPPLER
from fusiond.gnss.carrier_phase import SD as SD_PSEUDORANGE
from fusiond.gnss.carrier_phase import SD_RATE as SD_DOPPLER
from fusiond.gnss.carrier_phase import P as PSEUDORANGE
from fusiond.gnss.ecef import to_geodetic
from fusiond.gnss.orbit import BDT_BEHIND_GPS_S, satellite_states
from fusiond.navigation.compiled import compiled

Array = npt.NDArray[np.float64]

EARTH_RATE_RAD_S = 7.2921151467e-5
LOWEST_RADIUS_M = 6.3e6
"""A receiver nearer to the earth's centre is a starting value: no elevation, no atmosphere."""

WALK_M_SQRT_S = 0.0012
"""Walk of a carrier at the zenith beside the models (satellite's clock, atmosphere, orbit): at a
station with a known place a satellite's goes from its range by 4 to 7 mm in 30 s, phases' noise
in it."""
BEIDOU_2_CODE_M, BEIDOU_2_PAIR_M = 1.0, 5.0
"""One sigma of a receiver's delay of BeiDou-2 against BeiDou-3: of B1I (0.5 m for a Septentrio),
and of a delay by a pair (2.4 m on B3I are 4.7 m there); Jiao et al., Remote Sensing 13 (2021), 15,
find metres on two makes of receivers."""

_NEPERS = 0.1 * math.log(10.0)
"""A decibel of power as an exponent of e."""

# Columns of the plan.
SIGNAL_COLUMNS = 8
(
    GROUP_DELAY_M, IONO_MODEL, IONO_SCALE, FIXED_VARIANCE, GROUP, BEIDOU_2, OWN_SLOT, OWN_ISSUE,
) = range(SIGNAL_COLUMNS)  # fmt: skip
NO_MODEL, GPS_MODEL, BEIDOU_MODEL, BDGIM_MODEL = 0.0, 1.0, 2.0, 3.0
# Results; a measurement uses the first nineteen (fusiond.aiding.pseudorange).
ROW_COLUMNS = 30
RANGE_VALUES = 19
(
    X, Y, Z, VX, VY, VZ, CORRECTED, CORRECTED_RATE, VARIANCE, RATE_VARIANCE,
    COMMON, TROPOSPHERE_SIGMA, BEIDOU_2_SIGMA, CARRIER_SPAN, CARRIER, CARRIER_VARIANCE, WALK,
    SLOT, ISSUE,
    LX, LY, LZ, RANGE, ELEVATION, NORTH, EAST, TROPOSPHERE, IONOSPHERE, TOTAL_VARIANCE,
    LASTING,
) = range(ROW_COLUMNS)  # fmt: skip
# Noise.
NOISE_VALUES = 8
(
    CODE_ZENITH, CODE_CNO, CNO_REFERENCE, TROPO_ZENITH, IONO_SHARE, IONO_UNMODELLED, IONO_LOCAL,
    RATE_ZENITH,
) = range(NOISE_VALUES)  # fmt: skip


@compiled("void(f8[:, ::1], f8[:, ::1], f8, b1, f8[:, ::1])", allocates=True)
def _take_off_ionosphere(
    signals: Array, carriers: Array, local: float, on_earth: bool, out: Array
) -> None:
    """Subtract each satellite's ionospheric delay by model and carriers; write its residual
    variance."""
    n = signals.shape[0]
    weights, offsets, middles = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(n):
        if math.isnan(carriers[k, SLANT]):
            continue
        w = 1.0 / (carriers[k, SLANT_VARIANCE] + out[COMMON, k] * out[COMMON, k])
        group = int(signals[k, GROUP])
        weights[group] += w
        offsets[group] += w * (carriers[k, SLANT] - out[IONOSPHERE, k])
        middles[group] += w * out[IONOSPHERE, k]
    for k in range(n):
        group, sigma, delay = int(signals[k, GROUP]), out[COMMON, k], out[IONOSPHERE, k]
        share, variance, own = 0.0, 0.0, local * sigma
        if weights[group] > 0.0:
            level = offsets[group] / weights[group]
            if on_earth and delay > 0.0:
                sigma *= (delay - middles[group] / weights[group]) / delay
            if not math.isnan(carriers[k, SLANT]):
                v = carriers[k, SLANT_VARIANCE]
                s = sigma * sigma + own * own
                share = s / (s + v) if on_earth else 1.0
                level += share * (carriers[k, SLANT] - delay - level)
                variance = share * (share * v + carriers[k, WITH_CODE])
            out[IONOSPHERE, k] += level
        out[CORRECTED, k] -= out[IONOSPHERE, k]
        left = (1.0 - share) * sigma
        out[COMMON, k] = left
        local_variance = ((1.0 - share) * own) ** 2
        out[VARIANCE, k] += variance + local_variance
        out[LASTING, k] = signals[k, FIXED_VARIANCE] + local_variance
        if share > 0.0:
            out[LASTING, k] += share * share * carriers[k, SLANT_VARIANCE]
        out[BEIDOU_2_SIGMA, k] = 0.0
        if signals[k, BEIDOU_2] > 0.0:
            out[BEIDOU_2_SIGMA, k] = BEIDOU_2_CODE_M + BEIDOU_2_PAIR_M * share
        out[TOTAL_VARIANCE, k] = (
            out[VARIANCE, k]
            + left * left
            + out[TROPOSPHERE_SIGMA, k] ** 2
            + out[BEIDOU_2_SIGMA, k] ** 2
        )


@compiled(
    "void(f8[::1], i8[::1], i8[::1], f8[:, ::1], f8, f8, f8[:, ::1], f8[:, ::1], f8[:, ::1])",
    allocates=True,
)
def choose(
    values: Array,
    at: npt.NDArray[np.int64],
    second_at: npt.NDArray[np.int64],
    elements: Array,
    week: float,
    tow: float,
    measured: Array,
    second: Array,
    states: Array,
) -> None:
    """Write the values of the chosen signals and the states of their satellites.

    `measured` (n, 7) of the first signals, `second` (n, 7) of the second ones, NaN where absent;
    `states` (n, 8) as the satellites sent the first.
    `values` (m * 7) of an epoch's signals at GPS time `week`, `tow`; `at` and `second_at` (n,)
    signals of the satellites, -1: none; `elements` (n, 47).
    """
    n = at.shape[0]
    sent = np.empty(n)
    for k in range(n):
        for j in range(SIGNAL_VALUES):
            measured[k, j] = values[at[k] * SIGNAL_VALUES + j]
            second[k, j] = math.nan
            if second_at[k] >= 0:
                second[k, j] = values[second_at[k] * SIGNAL_VALUES + j]
        sent[k] = tow - measured[k, PSEUDORANGE] / SPEED_OF_LIGHT_M_S
    satellite_states(elements, week, sent, True, states)


@compiled(
    "i8(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8, f8, f8[::1], f8[::1], f8,"
    "f8, f8, f8[:, ::1])",
    allocates=True,
)
def range_rows(
    states: Array,
    signals: Array,
    measured: Array,
    carriers: Array,
    ionosphere: Array,
    week: float,
    tow: float,
    receiver: Array,
    noise: Array,
    code_scale: float,
    least_elevation: float,
    least_cno: float,
    out: Array,
) -> int:
    """Write values (30, n) of the satellites, in the receiver's order.

    `receiver` (3,) ECEF m, at GPS time `week`, `tow` of its clock. Returns the number of satellites
    below `least_elevation` (rad) or `least_cno` (dB Hz).

    `states` (n, 8) of `choose`, `signals` (n, 8), `measured` (n, 7), `carriers` (n, 7) of
    fusiond.gnss.carrier_phase, `ionosphere` (3, 49): GPS's and BeiDou's eight coefficients, and the
    terms of BDGIM; `noise` (8,), whose codes are `code_scale` times the model's.
    """
    n = states.shape[0]
    refused = 0
    code_zenith, code_cno = noise[CODE_ZENITH] * code_scale, noise[CODE_CNO] * code_scale
    rx, ry, rz = receiver[0], receiver[1], receiver[2]
    on_earth = rx * rx + ry * ry + rz * rz > LOWEST_RADIUS_M * LOWEST_RADIUS_M
    lat, lon, height = 0.0, 0.0, 0.0
    dry, wet = 0.0, 0.0
    q = np.empty(7)
    if on_earth:
        lat, lon, height = to_geodetic(rx, ry, rz)
        dry, wet = zenith_delays(lat, height)
        mapping_coefficients(lat, height, week * 7.0 + tow / 86400.0, q)
    sp, cp, sl, cl = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    for k in range(n):
        xt, yt, z = states[k, 0], states[k, 1], states[k, 2]
        x, y = xt, yt
        c, s = 1.0, 0.0
        distance = 0.0
        for _ in range(2):  # error 27 m without a turn, then 0.2 mm, then less than a nanometre
            dx, dy, dz = x - rx, y - ry, z - rz
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            angle = EARTH_RATE_RAD_S * distance / SPEED_OF_LIGHT_M_S
            c, s = 1.0 - 0.5 * angle * angle, angle  # error angle^3 / 6, 1e-16
            x, y = c * xt + s * yt, c * yt - s * xt
        dx, dy, dz = x - rx, y - ry, z - rz
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        vx = c * states[k, 3] + s * states[k, 4]
        vy = c * states[k, 4] - s * states[k, 3]
        vz = states[k, 5]
        lx, ly, lz = dx / distance, dy / distance, dz / distance
        elevation, north, east, up = 0.5 * math.pi, 0.0, 0.0, 1.0
        tropo, iono = 0.0, 0.0
        iono_sigma = 0.0
        if on_earth:
            east = -sl * lx + cl * ly
            north = -sp * cl * lx - sp * sl * ly + cp * lz
            up = cp * cl * lx + cp * sl * ly + sp * lz
            up = min(max(up, -1.0), 1.0)
            elevation = math.asin(up)
            level = math.hypot(north, east)
            cos_azimuth, sin_azimuth = (north / level, east / level) if level > 0.0 else (1.0, 0.0)
            dry_map, wet_map = mapping(up, q)
            tropo = dry * dry_map + wet * wet_map
            model = signals[k, IONO_MODEL]
            if model == GPS_MODEL:
                iono = klobuchar_gps(
                    ionosphere[0], tow, lat, lon, elevation, cos_azimuth, sin_azimuth
                )
            elif model == BEIDOU_MODEL:
                bdt = tow - BDT_BEHIND_GPS_S
                iono = klobuchar_beidou(ionosphere[1], bdt, lat, lon, up, cos_azimuth, sin_azimuth)
            elif model == BDGIM_MODEL:
                bdt = tow - BDT_BEHIND_GPS_S
                iono = bdgim(ionosphere[2], bdt, lat, lon, up, cos_azimuth, sin_azimuth)
            iono *= signals[k, IONO_SCALE]
            iono_sigma = noise[IONO_SHARE] * iono
            if model == NO_MODEL:
                iono_sigma = noise[IONO_UNMODELLED] * slant(up) * signals[k, IONO_SCALE]
        out[SLOT, k], out[ISSUE, k] = signals[k, OWN_SLOT], signals[k, OWN_ISSUE]
        out[X, k], out[Y, k], out[Z, k] = x, y, z
        out[VX, k], out[VY, k], out[VZ, k] = vx, vy, vz
        out[LX, k], out[LY, k], out[LZ, k] = lx, ly, lz
        out[RANGE, k] = distance
        out[ELEVATION, k], out[NORTH, k], out[EAST, k] = elevation, north, east
        out[TROPOSPHERE, k], out[IONOSPHERE, k], out[COMMON, k] = tropo, iono, iono_sigma
        clock = SPEED_OF_LIGHT_M_S * states[k, 6] - signals[k, GROUP_DELAY_M]
        out[CORRECTED, k] = measured[k, PSEUDORANGE] + clock - tropo
        inertial = (
            lx * (vx - EARTH_RATE_RAD_S * y) + ly * (vy + EARTH_RATE_RAD_S * x) + lz * vz
        ) / SPEED_OF_LIGHT_M_S
        drift = SPEED_OF_LIGHT_M_S * states[k, 7]
        thin = slant(up)
        out[CORRECTED_RATE, k] = measured[k, DOPPLER] * (1.0 + inertial) + drift
        stated = measured[k, SD_DOPPLER]
        if math.isnan(stated):
            stated = 0.0
        out[RATE_VARIANCE, k] = (
            noise[RATE_ZENITH] * noise[RATE_ZENITH] * thin * thin + stated * stated
        )
        out[CARRIER_SPAN, k] = carriers[k, SPAN]
        out[CARRIER, k] = carriers[k, LENGTH] + SPEED_OF_LIGHT_M_S * states[k, 6] - tropo + iono
        out[CARRIER_VARIANCE, k] = carriers[k, LENGTH_VARIANCE] * thin * thin
        walked = WALK_M_SQRT_S * WALK_M_SQRT_S
        if carriers[k, SPAN] > 0.0:
            walked += carriers[k, GROWN] / carriers[k, SPAN]
        out[WALK, k] = math.sqrt(walked) * thin
        code = code_zenith * thin
        cno = measured[k, CNO]
        refused += elevation < least_elevation or cno < least_cno
        weak = 0.0 if math.isnan(cno) else math.exp(_NEPERS * (noise[CNO_REFERENCE] - cno))
        stated = measured[k, SD_PSEUDORANGE]
        if math.isnan(stated):
            stated = 0.0
        out[VARIANCE, k] = (
            code * code + code_cno * code_cno * weak + stated * stated + signals[k, FIXED_VARIANCE]
        )
        out[TROPOSPHERE_SIGMA, k] = noise[TROPO_ZENITH] * thin if on_earth else 0.0
    _take_off_ionosphere(signals, carriers, noise[IONO_LOCAL], on_earth, out)
    return refused
