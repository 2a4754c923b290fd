"""The door of the navigator: a driver's measurement becomes aids, or is refused by name.

Here the configuration meets the measurement: lever arm, sigma where the device states none, floors
and gates. Behind it everything is in SI units with a settled instant.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from drivers.measurements import (
    Attitude,
    Bearing,
    DelayedFix,
    Heading,
    Height,
    Measurement,
    PositionFix,
    WheelSpeed,
)
from fusiond.aiding.attitude import STAR_BLOCK, AttitudeAid, HeadingAid
from fusiond.aiding.base import Aid, NotApplicable
from fusiond.aiding.bearing import SAR_BLOCK, BearingAid
from fusiond.aiding.body_velocity import WheelSpeedAid
from fusiond.aiding.height import HeightAid
from fusiond.aiding.position import PositionAid
from fusiond.aiding.rdss_geometry import RdssGeometry, with_floor
from fusiond.aiding.rdss_position import BIAS_BLOCK, FeedBackAid, RdssPositionAid
from fusiond.aiding.velocity import VelocityAid
from fusiond.configuration.aiding import (
    Aiding,
    AnyAiding,
    AttitudeAiding,
    GnssAiding,
    HeadingAiding,
    HeightAiding,
    Misaligned,
    RawAiding,
    RdssAiding,
    SarAiding,
    StarTrackerAiding,
    WheelAiding,
)
from fusiond.configuration.settings import ARCSEC, DEG
from fusiond.models.model import Block, misalignment, position_bias
from fusiond.navigator.raw_gnss import RawGnss, raw_blocks

# What a fix moved forward by the computed velocity is wrong by: an acceleration of 2.5 m/s^2 over a
# delay of 1.5 s, which lasts as long as a manoeuvre. The velocity's own error is in the Jacobian.
COMPENSATION_SD_M, COMPENSATION_TAU_S = 3.0, 5.0

S = TypeVar("S", bound=Aiding)

# Dilution of precision to assume where a receiver sends neither GST nor GSA: a poor open sky.
ASSUMED_HDOP, ASSUMED_VDOP = 2.0, 3.0
# RTK divides the ranging error by far more than code does; these factors scale the DOP rule only
# when the receiver sends no GST (typical: 0.5 m differential, 0.3 m float, 0.02 m fixed for 3 m
# code).
RANGE_FACTOR = {1: 1.0, 2: 0.5, 4: 0.01, 5: 0.15}
RTK = (4, 5)
"""Quality of fixes by carrier phase against a base station."""
FIX_BIAS = "gnss_bias"
# A receiver's own velocity has no meaning below this sigma; none states less in practice.
VERTICAL_VELOCITY_FACTOR = 1.5


class Intake:
    """Holds `aiding` by source name; a source without a section takes its kind's defaults."""

    def __init__(self, aiding: dict[str, AnyAiding]) -> None:
        self._aiding = aiding
        self._sections: dict[tuple[str, type[Aiding]], Aiding] = {}

    def aids(
        self, m: Measurement, t_ns: int, sd_time_s: float, seen_ns: int = 0
    ) -> list[Aid] | str:
        """The aids that `m`, valid at `t_ns`, stands for, or the name of the refusal."""
        match m:
            case PositionFix():
                if isinstance(self._aiding.get(m.source), RawAiding):
                    return "raw_is_used"
                return self._gnss(m, t_ns, sd_time_s)
            case DelayedFix():
                return self._rdss(m, t_ns, sd_time_s, seen_ns)
            case Attitude():
                return self._attitude(m, t_ns, sd_time_s)
            case Bearing():
                return self._bearing(m, t_ns, sd_time_s)
            case Heading():
                h = self._section(m.source, HeadingAiding)
                sd_rad = (m.sd_rad or h.sd_deg * DEG) * h.sigma_scale
                # One receiver may send position and heading of the same instant: two names.
                name = m.source if m.source == h.kind else f"{m.source}_heading"
                return [HeadingAid(name, t_ns, h.gate_probability, m.yaw_rad, sd_rad)]
            case Height():
                e = self._section(m.source, HeightAiding)
                sd_m = (m.sd_m or e.sd_m) * e.sigma_scale
                return [HeightAid(m.source, t_ns, e.gate_probability, m.height_m, sd_m)]
            case WheelSpeed():
                w = self._section(m.source, WheelAiding)
                sd_v = (m.sd_m_s or w.sd_m_s) * w.sigma_scale
                return [
                    WheelSpeedAid(
                        m.source, t_ns, w.gate_probability, m.speed_m_s, sd_v, w.lever_arm_m
                    )
                ]
            case _:
                return "not_an_aid"

    def extra_blocks(self) -> list[Block]:
        """What the aids need in the model beside its own blocks: errors that successive
        measurements share.

        North, east and down of a receiver's fixes; north and east of RDSS fixes (`BIAS_BLOCK`),
        which position compensation needs for what the moved fix is wrong by; the misalignment of
        each star tracker and radar.
        """
        blocks: list[Block] = []
        for name, o in self._aiding.items():
            match o:
                case GnssAiding() if o.bias_sd_m > 0.0:
                    level, down = self._fix_bias(name, o)
                    lasts_s = o.bias_correlation_s
                    blocks.append(position_bias(level, o.bias_sd_m, lasts_s))
                    blocks.append(position_bias(down, o.bias_down_sd_m, lasts_s, "d"))
                case RdssAiding() if BIAS_BLOCK not in {b.name for b in blocks}:
                    if o.bias_sd_m > 0.0:
                        bias = o.bias_sd_m, o.bias_correlation_s
                        blocks.append(position_bias(BIAS_BLOCK, *bias))
                    elif o.strategy == "position_compensation":
                        bias = COMPENSATION_SD_M, COMPENSATION_TAU_S
                        blocks.append(position_bias(BIAS_BLOCK, *bias))
                case RawAiding():
                    blocks += raw_blocks(o)
                case Misaligned() if o.misalignment_sd_arcsec > 0.0:
                    sd, tau_s = o.misalignment_sd_arcsec * ARCSEC, o.misalignment_correlation_s
                    blocks.append(misalignment(self._block(name, o), sd, tau_s or math.inf))
        return blocks

    def raw_receiver(self, source: str) -> RawGnss | None:
        """What becomes of a source's raw data; None where its fixes are the aid, not they."""
        section = self._aiding.get(source)
        return RawGnss(source, section) if isinstance(section, RawAiding) else None

    def _section(self, source: str, kind: type[S]) -> S:
        """The source's own section, else the one named after the kind, else its defaults."""
        section = self._sections.get((source, kind))
        if not isinstance(section, kind):
            names = (source, str(kind.model_fields["kind"].default))
            named = (self._aiding.get(name) for name in names)
            section = next((s for s in named if isinstance(s, kind)), None) or kind()
            self._sections[source, kind] = section
        return section

    def _block(self, source: str, section: Misaligned) -> str:
        """The block of a source's misalignment, named after its kind, or after the source where
        that has a section of its own; empty where none is estimated."""
        if section.misalignment_sd_arcsec == 0.0:
            return ""
        block = STAR_BLOCK if isinstance(section, StarTrackerAiding) else SAR_BLOCK
        return self._own(block, source, section)

    def _fix_bias(self, source: str, section: GnssAiding) -> tuple[str, ...]:
        """The blocks of the error that a receiver's fixes share; none where it is not estimated."""
        if section.bias_sd_m == 0.0:
            return ()
        level = self._own(FIX_BIAS, source, section)
        return level, f"{level}_down"

    def _own(self, block: str, source: str, section: GnssAiding | Misaligned) -> str:
        own = self._aiding.get(source) is section and source != section.kind
        return f"{block}_{source}" if own else block

    def _attitude(self, m: Attitude, t_ns: int, sd_time_s: float) -> list[Aid] | str:
        own = self._aiding.get(m.source)
        tracker = isinstance(own, StarTrackerAiding) or (own is None and m.source == "star_tracker")
        stated, block = m.sd_rpy_rad, ""
        o: Aiding
        if tracker:
            o = star = self._section(m.source, StarTrackerAiding)
            default = star.sd_arcsec * ARCSEC
            r, p, y = (default if math.isnan(s) else s for s in stated)
            stated, block = (r, p, y), self._block(m.source, star)
        else:
            o = self._section(m.source, AttitudeAiding)
        roll, pitch, yaw = (s * o.sigma_scale for s in stated)
        sd = (roll, pitch, yaw)
        if not all(s > 0.0 or math.isnan(a) for s, a in zip(sd, m.rpy_rad, strict=True)):
            return "no_sigma"
        return [AttitudeAid(m.source, t_ns, o.gate_probability, m.rpy_rad, sd, sd_time_s, block)]

    def _bearing(self, m: Bearing, t_ns: int, sd_time_s: float) -> list[Aid] | str:
        o = self._section(m.source, SarAiding)
        if not (math.isfinite(m.azimuth_rad) and math.isfinite(m.elevation_rad)):
            return "not_finite"
        point = m.point
        if point is None:
            known = o.targets_deg_m.get(m.target)
            if known is None:
                return "unknown_target"
            point = (known[0] * DEG, known[1] * DEG, known[2])
        default = o.sd_arcsec * ARCSEC
        azimuth, elevation = (s * o.sigma_scale for s in m.sd_rad or (default, default))
        if not (azimuth > 0.0 and elevation > 0.0):
            return "no_sigma"
        return [
            BearingAid(
                m.source,
                t_ns,
                o.gate_probability,
                m.azimuth_rad,
                m.elevation_rad,
                (azimuth, elevation),
                point,
                o.lever_arm_m,
                o.min_range_m,
                sd_time_s,
                self._block(m.source, o),
            )
        ]

    def _gnss(self, m: PositionFix, t_ns: int, sd_time_s: float) -> list[Aid] | str:
        o = self._section(m.source, GnssAiding)
        if not (math.isfinite(m.lat_rad) and math.isfinite(m.lon_rad)):
            return "not_finite"
        if m.sd_ned_m is not None:
            sd = m.sd_ned_m
        else:
            error = o.range_error_m * RANGE_FACTOR.get(m.quality, 1.0)
            horizontal = error * (m.hdop or ASSUMED_HDOP) / math.sqrt(2.0)
            sd = (horizontal, horizontal, error * (m.vdop or ASSUMED_VDOP))
        if not (sd[0] > 0.0 and sd[1] > 0.0 and sd[2] > 0.0):
            return "no_sigma"
        scale, least = o.sigma_scale, o.min_position_sd_m
        n, e, d = sd[0] * scale, sd[1] * scale, sd[2] * scale
        if n < least or e < least or d < least:
            n, e, d = max(n, least), max(e, least), max(d, least)
        sd_time = math.hypot(sd_time_s, o.time_sd_s)
        aids: list[Aid] = [
            PositionAid(
                m.source,
                t_ns,
                o.gate_probability,
                m.lat_rad,
                m.lon_rad,
                m.height_m,
                (n, e, d),
                o.lever_arm_m,
                sd_time,
                () if m.quality in RTK else self._fix_bias(m.source, o),
            )
        ]
        if o.use_velocity and m.v_ned_m_s is not None:
            north, east, down = m.v_ned_m_s
            sd_n, sd_e, sd_d = m.sd_v_ned_m_s or (None, None, None)
            horizontal, least = o.velocity_sd_m_s, o.min_velocity_sd_m_s
            v: tuple[float, ...] = (north, east)
            sd_v: tuple[float, ...] = (
                max((sd_n or horizontal) * scale, least),
                max((sd_e or horizontal) * scale, least),
            )
            if down is not None:
                v = (north, east, down)
                vertical = horizontal * VERTICAL_VELOCITY_FACTOR
                sd_v = (*sd_v, max((sd_d or vertical) * scale, least))
            if math.isfinite(sum(v)):
                aids.append(
                    VelocityAid(
                        f"{m.source}_velocity",
                        t_ns - round(o.velocity_delay_s * 1e9),
                        o.gate_probability,
                        v,
                        sd_v,
                        o.lever_arm_m,
                    )
                )
        return aids

    def _rdss(self, m: DelayedFix, t_ns: int, sd_time_s: float, seen_ns: int) -> list[Aid] | str:
        o = self._section(m.source, RdssAiding)
        if m.multi_value:
            return "multi_value"
        if not m.precision_class_m > 0.0:
            return "no_sigma"
        class_m = m.precision_class_m
        r = np.eye(2) * class_m**2
        if o.noise == "geometry":
            geometry = RdssGeometry(o.satellites_deg).covariance(
                m.lat_rad, m.lon_rad, m.height_m, o.range_sd_m, o.height_sd_m
            )
            if isinstance(geometry, NotApplicable):
                return geometry.outcome
            r = with_floor(geometry.total, class_m)
        r *= o.sigma_scale**2
        arrival_ns = max(t_ns, seen_ns)
        at_arrival = o.strategy in {"position_compensation", "none"}
        holds = o.strategy == "optimal_prediction" and arrival_ns > t_ns
        when_ns = arrival_ns if at_arrival else t_ns
        moved_s = (arrival_ns - t_ns) * 1e-9 if o.strategy == "position_compensation" else 0.0
        gate = o.gate_probability
        aids: list[Aid] = [
            RdssPositionAid(
                m.source,
                when_ns,
                gate,
                m.lat_rad,
                m.lon_rad,
                (float(r[0, 0]), float(r[0, 1]), float(r[1, 1])),
                o.lever_arm_m,
                sd_time_s,
                moved_s,
                holds,
            )
        ]
        if holds:
            aids.append(FeedBackAid(f"{m.source}_feedback", arrival_ns, gate))
        if o.fix_height_sd_m is not None and not m.height_given:
            sd = o.fix_height_sd_m * o.sigma_scale
            aids.append(HeightAid(f"{m.source}_height", when_ns, gate, m.height_m, sd))
        return aids
