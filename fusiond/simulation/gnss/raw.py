r"""Simulated raw observations of a receiver: pseudorange, range rate, carrier, C/N0.

    t    = t_r - b / c                               the receiver's clock shows t_r
    rho  = |Rz(we tau) p(t - tau) - r(t)|,  tau = rho / c
    P    = rho + b + isb - c (dt - d) + T + (f1/f)^2 I + s + nlos + mp + n_P
    D    = rho' + b' - c dt' + n_D
    L    = (rho + b + isb - c (dt - d) + T - (f1/f)^2 I + s + n_L) / lambda + N
    rho' = u (Rz v - v_r) / (1 - u (we x Rz p - Rz v) / c),   we x p here (y, -x, 0) we

p, v satellite, r, v_r antenna, u unit vector to the satellite (ECEF); dt, d satellite clock and
group delay; all lengths m. What is drawn, one sigma in `GnssRawOptions`:

    b    receiver clock, b' = drift + w_b:  drift a constant and a first-order Gauss-Markov part
         (paper 003 has the latter); a clock half a millisecond off is set by a whole one
    isb  offset of BeiDou against GPS in the receiver, constant
    s    error of the broadcast orbit and clock of each satellite, as smooth as orbits: what follows
         a Gauss-Markov process u, s' = (u - s) / T
    T    Saastamoinen's zenith delays with the wet one off by a constant, mapped by Niell
    I    Klobuchar's GPS model, on a day on which the sky has more or less of it by a constant
         factor; GPS broadcasts other coefficients, BeiDou its own model's
    nlos what a satellite's ranges have more while it comes by a wall alone
    mp   multipath, Gauss-Markov for each signal: sigma_mp (0.13 + 0.53 exp(-E / 10 deg))
    n    white; its sigma is that at 45 dB Hz times 10^((45 - C/N0) / 20)
    C/N0 36 + 12 sin E dB Hz, and noise

True orbits are those of `fusiond.gnss.nominal_constellation`; what is broadcast is the same,
quantised. Everything random is drawn at construction, so the start (GPS time) may be set later.

Source: Groves, 2nd ed., sections 8.5.3 and 9.1.2.3; multipath by elevation: RTCA DO-229D J.2.4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import UtcStamp
from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    Ephemeris,
    Klobuchar,
    RawGnssEpoch,
    RawSignal,
    System,
)
from fusiond.gnss.atmosphere import (
    klobuchar_gps,
    mapping,
    mapping_coefficients,
    zenith_delays,
)
from fusiond.gnss.ecef import ned_axes, to_ecef
from fusiond.gnss.group_delay import group_delay
from fusiond.gnss.nominal_constellation import EPOCH_S, constellation, ephemeris, slots
from fusiond.gnss.orbit import CONSTANTS, WEEK_S, Orbits
from fusiond.navigation.gps_time import GPS_EPOCH_POSIX_S
from fusiond.simulation.gnss.masks import Mask, View
from fusiond.simulation.gnss.nav_fields import quantised
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.markov import gauss_markov, smooth_markov

Array = NDArray[np.float64]

START = (2400, 0.0)
"""Default GPS week and second at the trajectory's 0: 2026-01-04, so that t_s is the second of the
week, as in recorded drives."""
LEAP_SECONDS = 18
_MS_M = SPEED_OF_LIGHT_M_S * 1e-3

TRUE_ALPHA = (2.0e-8, 1.5e-8, -6.0e-8, -6.0e-8)
TRUE_BETA = (1.2e5, 6.5e4, -1.3e5, -1.3e5)
"""True ionosphere: a day of moderate solar activity, as GPS broadcast it in 2024."""
GPS_ALPHA = (1.4e-8, 1.5e-8, -6.0e-8, -1.2e-7)
GPS_BETA = (1.05e5, 9.8e4, -6.5e4, -3.3e5)
BEIDOU_ALPHA = (2.4e-8, 4.5e-8, -3.0e-7, 4.2e-7)
BEIDOU_BETA = (1.25e5, -3.3e4, 1.3e5, 1.3e5)
"""Broadcast ionosphere of the same day, wrong by about a third at noon."""
LEAST_IONOSPHERE = 0.1
"""Least ionosphere, as a share of an ordinary day's."""


@dataclass(frozen=True, slots=True)
class GnssRawOptions:
    """One-sigma errors of a single-frequency receiver; lengths in m."""

    rate_hz: float = 5.0
    signals: tuple[tuple[System, str], ...] = (("C", "2I"), ("G", "1C"))
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    elevation_deg: float = 10.0
    masks: tuple[Mask, ...] = ()
    pseudorange_sd_m: float = 0.4
    range_rate_sd_m_s: float = 0.04
    carrier_sd_m: float = 0.002
    cno_sd_db: float = 0.7
    multipath_sd_m: float = 1.0
    multipath_correlation_s: float = 20.0
    signal_in_space_sd_m: float = 0.5
    signal_in_space_correlation_s: float = 1800.0
    wet_delay_sd_m: float = 0.04
    ionosphere_sd: float = 0.0
    """One sigma of the day's ionosphere, as a share of an ordinary one: models leave half of it."""
    ionosphere_local_sd: float = 0.0
    """One sigma of the independent part of each satellite's path, likewise."""
    ionosphere_as_broadcast: bool = False
    """True if both systems broadcast an ordinary day exactly; else their models are wrong by a
    third."""
    clock_offset_sd_m: float = 3000.0
    clock_drift_constant_sd_m_s: float = 20.0
    clock_drift_sd_m_s: float = 0.5
    clock_drift_correlation_s: float = 300.0
    clock_noise_m_sqrt_s: float = 0.05
    inter_system_sd_m: float = 5.0
    reflections_per_hour: float = 0.0
    """Rate at which a satellite's direct signal is lost and only a reflection remains."""
    reflection_m: tuple[float, float] = (3.0, 60.0)
    """Additional path length of a reflection: uniform in the logarithm."""
    reflection_s: float = 20.0
    """Mean duration of a loss, exponentially distributed."""
    latency_s: tuple[float, float] = (0.05, 0.1)
    """Delay from an epoch to its last byte, uniform."""

    @property
    def systems(self) -> tuple[System, ...]:
        """Systems that are received, in the order of `signals`."""
        return tuple(dict.fromkeys(system for system, _ in self.signals))


class GnssRaw:
    """Raw epochs of a whole trajectory, drawn from `rng`; epoch k is at `t_s[k]` of its clock.

    `clock_m` (n,) is the true offset of that clock without whole milliseconds, `clock_drift_m_s`
    (n,) its rate, `inter_system_m` the excess of a system's pseudoranges, `ionosphere` the
    broadcast model.
    """

    def __init__(
        self,
        truth: Truth,
        options: GnssRawOptions,
        rng: np.random.Generator,
        start: tuple[int, float] = START,
    ) -> None:
        self.truth, self.options, self.rng = truth, options, rng
        o = options
        n, step = int(truth.duration_s * o.rate_hz + 1e-9), 1.0 / o.rate_hz
        self.t_s = np.arange(1, n + 1) / o.rate_hz
        self.t_arrival_s = np.maximum.accumulate(self.t_s + rng.uniform(*o.latency_s, n))
        states = truth.at(self.t_s, o.lever_arm_m)
        self._position, self._v_ned = states.position, states.v_ned
        self._heading = states.rpy[:, 2]
        self._draw_clock(n, step)
        self._slots = slots(o.systems)
        index = range(len(self._slots))
        # All signals of one satellite together; the order of `signals` within it.
        self._cells = [
            (i, signal)
            for i in index
            for system, signal in o.signals
            if system == self._slots[i].system
        ]
        cells = len(self._cells)
        self._multipath = gauss_markov(
            rng, (n, cells), step_s=step, correlation_s=o.multipath_correlation_s, sigma=1.0
        )
        self._in_space = smooth_markov(
            rng,
            (n, len(self._slots)),
            step_s=step,
            correlation_s=o.signal_in_space_correlation_s,
            sigma=o.signal_in_space_sd_m,
        )
        self._white = rng.standard_normal((n, cells, 4), dtype=np.float32)
        self._ambiguity = rng.integers(-100, 101, cells)
        self._wet_error = float(rng.standard_normal()) * o.wet_delay_sd_m
        isb = float(rng.standard_normal()) * o.inter_system_sd_m
        self.inter_system_m: dict[System, float] = {"G": 0.0, "C": isb}
        gps, beidou = (GPS_ALPHA, GPS_BETA), (BEIDOU_ALPHA, BEIDOU_BETA)
        if o.ionosphere_as_broadcast:
            gps = beidou = TRUE_ALPHA, TRUE_BETA
        self.ionosphere = (
            Klobuchar("simulation", 0, "G", *gps),
            Klobuchar("simulation", 0, "C", *beidou),
        )
        self.reflected_m = self._draw_reflections(n, step)
        """Excess of each satellite's ranges (n, satellites), m; satellites as in `satellites`."""
        # The last ones drawn: what has no such days is as before.
        more = float(rng.standard_normal()) * o.ionosphere_sd if o.ionosphere_sd else 0.0
        own = rng.standard_normal(len(self._slots)) if o.ionosphere_local_sd else 0.0
        factors = 1.0 + more + np.broadcast_to(own * o.ionosphere_local_sd, len(self._slots))
        self.ionosphere_factor: Array = np.maximum(factors, LEAST_IONOSPHERE)
        """Ionosphere of each satellite (satellites,), as a share of an ordinary day's."""
        self.begin(*start)

    @property
    def satellites(self) -> tuple[str, ...]:
        """Names of all satellites, above the horizon or not."""
        return tuple(f"{slot.system}{slot.prn:02d}" for slot in self._slots)

    def _draw_reflections(self, n: int, step: float) -> Array:
        o, found = self.options, np.zeros((n, len(self._slots)))
        if o.reflections_per_hour <= 0.0:
            return found
        low, high = (math.log(m) for m in o.reflection_m)
        for column in found.T:
            t_s = float(self.rng.exponential(3600.0 / o.reflections_per_hour))
            while t_s < n * step:
                lasts_s = float(self.rng.exponential(o.reflection_s))
                more = math.exp(float(self.rng.uniform(low, high)))
                column[int(t_s / step) : int((t_s + lasts_s) / step) + 1] = more
                t_s += lasts_s + float(self.rng.exponential(3600.0 / o.reflections_per_hour))
        return found

    def _draw_clock(self, n: int, step: float) -> None:
        o, rng = self.options, self.rng
        drift = gauss_markov(
            rng,
            (n, 1),
            step_s=step,
            correlation_s=o.clock_drift_correlation_s,
            sigma=o.clock_drift_sd_m_s,
        )[:, 0]
        drift += rng.standard_normal() * o.clock_drift_constant_sd_m_s
        walk = rng.standard_normal(n) * (o.clock_noise_m_sqrt_s * math.sqrt(step))
        offset = rng.standard_normal() * o.clock_offset_sd_m + np.cumsum(drift * step + walk)
        whole = np.round(offset / _MS_M)
        self.clock_m = offset - whole * _MS_M
        self.clock_drift_m_s = drift
        self._reset = np.diff(whole, prepend=whole[:1]) != 0.0

    def begin(self, week: int, tow_s: float, sky: tuple[int, float] | None = None) -> None:
        """Set GPS time at the trajectory's 0, and optionally another GPS time, `sky`, for the
        satellites' positions."""
        o = self.options
        self.start = week, tow_s
        sky_week, sky_tow_s = sky or self.start
        self._epoch_s = EPOCH_S + (week - sky_week) * WEEK_S + (tow_s - sky_tow_s)
        self._true = constellation(week, tow_s, o.systems, self._epoch_s)
        self._orbits = Orbits.of(self._true)
        self._earth_rate = np.array([CONSTANTS[e.system].earth_rate for e in self._true])
        self._view = View(o.elevation_deg, o.masks)
        self._coefficients = np.array((*TRUE_ALPHA, *TRUE_BETA))
        self._delays = [_delay(self._true[i], signal) for i, signal in self._cells]

    def __len__(self) -> int:
        return len(self.t_s)

    def broadcast(self, t_s: float, satellites: set[tuple[System, int]]) -> list[Ephemeris]:
        """Messages of satellites (system, PRN) at `t_s`, as broadcast."""
        week, tow_s = self.gps_time(t_s)
        return [
            quantised(ephemeris(slot, week, tow_s, self._epoch_s))
            for slot in self._slots
            if (slot.system, slot.prn) in satellites
        ]

    def gps_time(self, t_s: float) -> tuple[int, float]:
        """GPS week and second of week at an instant of the trajectory."""
        weeks, tow_s = divmod(self.start[1] + t_s, WEEK_S)
        return self.start[0] + int(weeks), tow_s

    def sky(self, k: int) -> tuple[Array, Array, Array, Array, Array]:
        """All satellites at epoch `k`: azimuth, elevation (rad), range m, rate m/s, clock (n, 2) in
        m and m/s."""
        week, tow_s = self.start[0], self.start[1] + float(self.t_s[k])
        tow_s -= float(self.clock_m[k]) / SPEED_OF_LIGHT_M_S
        lat, lon, height = (float(x) for x in self._antenna(k))
        axes = ned_axes(lat, lon)
        r, v_r = np.array(to_ecef(lat, lon, height)), axes @ self._v_ned[k]
        flight = np.full(len(self._slots), 0.08)
        for _ in range(3):  # a satellite comes 1e-5 of the error nearer: 20 ms, 0.2 us, 2 ps
            states = self._orbits.at(week, tow_s - flight)
            turn = self._earth_rate * flight
            p, v = _turned(states.position, turn), _turned(states.velocity, turn)
            delta = p - r
            distance = np.linalg.norm(delta, axis=1)
            flight = distance / SPEED_OF_LIGHT_M_S
        u = delta / distance[:, None]
        sweep = self._earth_rate[:, None] * np.stack((p[:, 1], -p[:, 0], 0.0 * p[:, 0]), axis=-1)
        along = np.einsum("ij,ij->i", u, v - v_r)
        rate = along / (1.0 - np.einsum("ij,ij->i", u, sweep - v) / SPEED_OF_LIGHT_M_S)
        north, east, down = (u @ axes).T
        clock = np.stack((states.clock_s, states.clock_drift), axis=-1) * SPEED_OF_LIGHT_M_S
        return np.arctan2(east, north) % (2.0 * math.pi), np.arcsin(-down), distance, rate, clock

    def _antenna(self, k: int) -> Array:
        """Antenna's position at the true instant of epoch `k`, b / c before its clock shows it."""
        lat, lon, height = self._position[k]
        early = -float(self.clock_m[k]) / SPEED_OF_LIGHT_M_S
        if abs(early) < 1e-9:
            return np.array([lat, lon, height])
        # At most half a millisecond: 0.15 m at 300 m/s, for which a sphere will do.
        north, east, down = self._v_ned[k] * early
        radius = 6.371e6 + height
        return np.array(
            [lat + north / radius, lon + east / (radius * math.cos(lat)), height - down]
        )

    def epoch(self, k: int) -> RawGnssEpoch:
        """Epoch number `k`, from 0. Epochs must be asked in order of time, since a mask keeps its
        choice."""
        o, t = self.options, float(self.t_s[k])
        week, tow_s = self.gps_time(t)
        azimuth, elevation, distance, rate, clock = self.sky(k)
        seen, reflecting = self._view.visible(t, azimuth, elevation, float(self._heading[k]))
        lat, lon, height = (float(x) for x in self._position[k])
        dry, wet = zenith_delays(lat, height)
        wet += self._wet_error
        niell = np.empty(7)
        mapping_coefficients(lat, height, (week * WEEK_S + tow_s) / 86400.0, niell)
        signals = []
        for cell, (i, signal) in enumerate(self._cells):
            if not seen[i]:
                continue
            satellite = self._true[i]
            system, e = satellite.system, float(elevation[i])
            hz = CARRIER_HZ[system, signal[0]]
            m_dry, m_wet = mapping(math.sin(e), niell)
            ionosphere = (CARRIER_HZ["G", "1"] / hz) ** 2 * klobuchar_gps(
                self._coefficients, tow_s, lat, lon, e, math.cos(azimuth[i]), math.sin(azimuth[i])
            )
            ionosphere *= float(self.ionosphere_factor[i])
            cno = 36.0 + 12.0 * math.sin(e)
            weaker = 10.0 ** ((45.0 - cno) / 20.0)
            noise = self._white[k, cell].astype(np.float64)
            path = o.multipath_sd_m * reflecting * (0.13 + 0.53 * math.exp(-e / math.radians(10.0)))
            common = (
                float(distance[i] - clock[i, 0] + self.clock_m[k] + self._in_space[k, i])
                + self.inter_system_m[system]
                + self._delays[cell]
                + dry * m_dry
                + wet * m_wet
            )
            code = o.pseudorange_sd_m * weaker
            phase = common - ionosphere + float(noise[2]) * o.carrier_sd_m * weaker
            signals.append(
                RawSignal(
                    system,
                    satellite.prn,
                    signal,
                    common
                    + ionosphere
                    + float(self.reflected_m[k, i])
                    + float(noise[0]) * code
                    + path * float(self._multipath[k, cell]),
                    float(rate[i] - clock[i, 1] + self.clock_drift_m_s[k])
                    + float(noise[1]) * o.range_rate_sd_m_s * weaker,
                    phase * hz / SPEED_OF_LIGHT_M_S + int(self._ambiguity[cell]),
                    round(cno + float(noise[3]) * o.cno_sd_db, 1),
                    math.hypot(code, path),
                    o.range_rate_sd_m_s * weaker,
                )
            )
        utc_ns = (GPS_EPOCH_POSIX_S + week * int(WEEK_S) - LEAP_SECONDS) * 1_000_000_000
        stamp = UtcStamp(utc_ns + round(tow_s * 1e9))
        return RawGnssEpoch(
            "simulation", 0, stamp, week, tow_s, tuple(signals), bool(self._reset[k])
        )


def _delay(satellite: Ephemeris, signal: str) -> float:
    """Group delay in m. Raises ValueError for a signal whose delay no message carries."""
    found = group_delay(satellite, signal)
    if found is None:
        raise ValueError(f"no broadcast group delay for {satellite.system} {signal}")
    return found.delay_s * SPEED_OF_LIGHT_M_S


def _turned(vectors: Array, angle: Array) -> Array:
    """Rz(angle) of vectors (n, 3), a rotation of the axes."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack((c * x + s * y, c * y - s * x, z), axis=-1)
