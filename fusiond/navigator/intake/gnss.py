"""Fixes of a GNSS receiver: position and velocity."""

from __future__ import annotations

import math
from typing import NamedTuple

from drivers.measurements import PositionFix, Vector3
from drivers.plausible import SIGMA_M
from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.fix_error_correlation import LASTS_S, Fix, FixErrors
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import SUFFIX, VelocityMeasurement
from fusiond.configuration.aiding import GnssAiding, RawAiding, lever_sd_m
from fusiond.models.blocks import Block, position_bias
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    CLOCK_SKEW,
    FIX_MARKOV,
    FIX_TIME,
    VELOCITY_TIME,
    antenna_lever_block,
    clock_skew_block,
    fix_markov_block,
    time_offset_block,
)
from fusiond.navigator.alignment.evidence import OPERATOR
from fusiond.navigator.intake.kind import (
    LEAST_SPEED_SD_M_S,
    Instants,
    Kind,
    Sections,
    shown_as,
)

# Dilution of precision to assume where a receiver sends neither GST nor GSA: a poor open sky.
ASSUMED_HDOP, ASSUMED_VDOP = 2.0, 3.0
# RTK divides the ranging error by far more than code does; these factors scale the DOP rule only
# when the receiver sends no GST (typical: 0.5 m differential, 0.3 m float, 0.02 m fixed for 3 m
# code).
RANGE_FACTOR = {1: 1.0, 2: 0.5, 4: 0.01, 5: 0.15}
# One sigma an axis that a fix may have where the section says no other, by quality: no receiver is
# better, and one that claims it counts noise alone, not what successive fixes share. By code:
# differentially 0.4 to 0.5 m horizontally and 0.5 to 0.7 m in height (data sheets of Trimble 5700
# and Septentrio mosaic-X5), 0.3 m an axis and 0.5 m. By phase with ambiguities in doubt: a fraction
# of the wavelength of 0.19 m. Fixed: 1 cm + 1 ppm (both sheets and u-blox ZED-F9P's), 2 cm at a
# base 10 km away.
CODE_FLOOR_M, CODE_HEIGHT_FLOOR_M = 0.3, 0.5
FLOOR_M = {4: 0.02, 5: 0.05}
RTK = (4, 5)
"""Quality of fixes by carrier phase against a base station."""
PHASE_SD_M = 0.1
"""Least credible sigma of code, whatever the corrections: a tenth of the best chip's noise."""
FIX_BIAS = "gnss_bias"
PHASE_SHARE = 0.5
"""Share of a carrier-phase fix's stated variance that further fixes share, beside the noise of
each: multipath and residual atmosphere last for minutes (115 s over baselines up to 10 km: Miller,
O'Keefe, Gao, Time correlation in GNSS positioning over short baselines, J. Surv. Eng. 138, 2012).
Receivers do not state the division of their sigma. The error is part of the state of code fixes and
has its correlation time, `bias_correlation_s`, which is longer."""
# Vertical over horizontal sigma of a velocity where the receiver states none: as of the DOPs above.
VERTICAL_VELOCITY_FACTOR = ASSUMED_VDOP / ASSUMED_HDOP
# An operator who errs by six sigma is wrong.
OPERATOR_GATE = 1.0 - 1e-9
Motion = tuple[tuple[float, ...], tuple[float, ...]]
"""Velocity (m/s) north, east, and down if measured, and one sigma of each."""


class _Receiver(NamedTuple):
    """Options of a receiver: its section, use of raw data, the name of its velocities, and `blocks`
    of its fixes' shared errors, empty if they are not estimated."""

    section: GnssAiding
    raw: bool
    velocities: str
    time: str
    velocity_time: str
    lever: str
    bias: tuple[str, ...]
    markov: str
    holds: bool
    """True if the model has states for the shared errors of its fixes: its section is configured.
    """
    shares_stated: bool
    """True if the section states the shared error of fixes."""
    shared_m: tuple[float, float]
    """One sigma of the shared states, horizontal and down."""


def _receiver(source: str, sections: Sections) -> _Receiver:
    o = sections.of(source, GnssAiding)
    raw = isinstance(sections.aiding.get(source), RawAiding)
    names = (sections.own(block, source, o) for block in (FIX_TIME, VELOCITY_TIME, ANTENNA_LEVER))
    time, velocity_time, lever = names
    bias, markov = _fix_bias(source, o, sections), _markov_block(source, o, sections)
    holds = bool(bias) and any(section is o for section in sections.aiding.values())
    shared = o.bias_sd_m is not None, (o.shared_sd_m, o.bias_down_sd_m)
    own = o, raw, source + SUFFIX, time, velocity_time, lever, bias, markov, holds
    return _Receiver(*own, *shared)


def measurements_of(
    m: PositionFix, sections: Sections, when: Instants
) -> list[AidingMeasurement] | str:
    """Position, and velocity if measured and used.

    `raw_is_used`: the receiver's raw data are the measurement, not its fixes.
    """
    source = m.source
    receiver: _Receiver | None = sections.made.get((source, _receiver))
    if receiver is None:
        receiver = sections.made[source, _receiver] = _receiver(source, sections)
    if receiver.raw:
        return "raw_is_used"
    o, stated = receiver.section, m.sd_ned_m
    if stated is not None and min(stated) <= 0.0:
        return "no_sigma"
    least = o.min_position_sd_m
    if least is not None:
        least_d = least
    elif m.quality in FLOOR_M:
        least = least_d = FLOOR_M[m.quality]
    else:
        least, least_d = CODE_FLOOR_M, CODE_HEIGHT_FLOOR_M
    believed = stated if stated is not None and min(stated) >= SIGMA_M[0] else _by_dop(m, o)
    (n, e, d), rounding, scale = believed, m.rounding_sd_ned_m, o.sigma_scale
    sd = (
        math.hypot(max(n * scale, least), rounding[0]),
        math.hypot(max(e * scale, least), rounding[1]),
        math.hypot(max(d * scale, least_d), rounding[2]),
    )
    sd_time_s = math.hypot(when.sd_time_s, o.time_sd_s)
    motion = None if m.v_ned_m_s is None else _velocity(m, m.v_ned_m_s, o)
    by_phase = _by_phase(m, sections)
    share = _phase_share(sd, o) if by_phase else (1.0, 1.0, 1.0)
    markov, markov_m = "" if by_phase else receiver.markov, 0.0
    level_m = math.sqrt(0.5 * (sd[0] ** 2 + sd[1] ** 2))
    if receiver.markov:
        known = sections.fix_errors.get((source, by_phase))
        errors = _errors(source, by_phase, o, sections) if known is None else known
        if motion is not None:  # without velocities nothing tells how the variance divides
            (v_n, v_e, *_), (sd_n, sd_e, *_) = motion
            sd_speed = math.sqrt(0.5 * (sd_n**2 + sd_e**2))
            place = m.lat_rad, m.lon_rad, level_m**2
            errors.waiting.append(Fix(when.t_ns, *place, (v_n, v_e), sd_speed))
            shares = errors.shares(when.t_ns)
            markov_m = math.sqrt(shares.wanders) * level_m
            if receiver.holds and not receiver.shares_stated:
                # What is seen of the horizontal is taken to be so of the height. Its own error
                # counts as stated: how a receiver that smooths its fixes follows a turn is in none.
                level, vertical = (math.sqrt(shares.lasts) / s for s in receiver.shared_m)
                share = level * sd[0], level * sd[1], vertical * sd[2]
    height = m.height_m
    if receiver.holds:
        if m.geoid_sd_m:
            share = _with_geoid(share, m.geoid_sd_m, o)
    elif m.geoid_sd_m > sd[2]:
        height = None  # nothing holds what fixes share: sigma would shrink with their number
    position = PositionMeasurement(
        source,
        when.t_ns,
        o.gate_probability,
        m.lat_rad,
        m.lon_rad,
        height,
        sd,
        o.lever_arm_m,
        sd_time_s,
        receiver.bias,
        receiver.time,
        receiver.lever,
        share,
        markov,
        markov_m if markov else 0.0,
    )
    if motion is None or not o.use_velocity:
        return [position]
    v, sd_v = motion
    velocity = VelocityMeasurement(
        receiver.velocities,
        when.t_ns - round(o.velocity_delay_s * 1e9),
        o.gate_probability,
        v,
        sd_v,
        o.lever_arm_m,
        receiver.velocity_time,
        receiver.lever,
        sd_time_s,
        receiver.time,
    )
    return [position, velocity]


def _by_phase(m: PositionFix, sections: Sections) -> bool:
    """True if the fix is by carrier phase: by its quality, or by a sigma too small for code, unless
    the receiver has stated a sigma of code under the same quality."""
    if m.quality in RTK:
        return True
    if m.sd_ned_m is None:
        return False
    north, east, _ = m.sd_ned_m
    stated = max(north, east)
    if stated >= CODE_FLOOR_M:
        sections.by_code.add((m.source, m.quality))
    return stated < PHASE_SD_M and (m.source, m.quality) not in sections.by_code


def _by_dop(m: PositionFix, o: GnssAiding) -> Vector3:
    """Sigmas from range error times DOP, for a receiver without credible ones."""
    error = o.range_error_m * RANGE_FACTOR.get(m.quality, 1.0)
    horizontal = error * (m.hdop or ASSUMED_HDOP) / math.sqrt(2.0)
    return horizontal, horizontal, error * (m.vdop or ASSUMED_VDOP)


def _velocity(m: PositionFix, v_ned: tuple[float, float, float | None], o: GnssAiding) -> Motion:
    """Velocity north, east, and down if measured, and one sigma of each."""
    north, east, down = v_ned
    v = (north, east) if down is None else (north, east, down)
    horizontal, rounding, sds = o.velocity_sd_m_s, m.rounding_sd_v_m_s, []
    defaults = horizontal, horizontal, horizontal * VERTICAL_VELOCITY_FACTOR
    for _, stated, default in zip(v, m.sd_v_ned_m_s or (None, None, None), defaults, strict=False):
        # What the receiver states, or the default where it states nothing credible.
        sd = default if stated is None or stated < LEAST_SPEED_SD_M_S else stated
        sds.append(math.hypot(max(sd * o.sigma_scale, o.min_velocity_sd_m_s), rounding))
    return v, tuple(sds)


def _phase_share(sd: Vector3, o: GnssAiding) -> Vector3:
    """Share of the code error in one by carrier phase."""
    if o.shared_sd_m == 0.0:
        return (1.0, 1.0, 1.0)
    (north, east, down), part = sd, math.sqrt(PHASE_SHARE)
    level, vertical = o.shared_sd_m, o.bias_down_sd_m
    return part * north / level, part * east / level, part * down / vertical


def _with_geoid(share: Vector3, geoid_sd_m: float, o: GnssAiding) -> Vector3:
    """Shares with the geoid's uncertainty in a height above the sea, which fixes share."""
    north, east, down = share
    return north, east, math.hypot(down, geoid_sd_m / o.bias_down_sd_m)


def _fix_bias(source: str, section: GnssAiding, sections: Sections) -> tuple[str, ...]:
    """Blocks of a receiver's shared error of fixes; none if not estimated."""
    if section.shared_sd_m == 0.0:
        return ()
    level = sections.own(FIX_BIAS, source, section)
    return level, f"{level}_down"


def _markov_block(source: str, section: GnssAiding, sections: Sections) -> str:
    """Block of the error that fixes share for seconds; "" if not estimated."""
    return sections.own(FIX_MARKOV, source, section) if section.shared_sd_m else ""


def _errors(source: str, by_phase: bool, o: GnssAiding, sections: Sections) -> FixErrors:
    """Error model of a receiver's fixes by code or by phase, made at the first fix."""
    offset_sd_s = math.sqrt(2.0) * o.time_offset_sd_s  # that of two instants
    errors = sections.fix_errors[source, by_phase] = FixErrors(offset_sd_s, not by_phase)
    if shown := sections.fixes_shown.get(shown_as(source, by_phase)):
        errors.take_up(shown)
    return errors


def blocks(source: str, section: GnssAiding, sections: Sections) -> list[Block]:
    """Blocks of a receiver's shared errors: time offset of fixes, that of velocities, the clock
    rate of both, the lever arm error, and a position error north and east, and down."""
    found = []
    if section.time_offset_sd_s:
        skew, sd_s = sections.own(CLOCK_SKEW, source, section), section.time_offset_sd_s
        found.append(time_offset_block(sections.own(FIX_TIME, source, section), sd_s, skew))
        if section.use_velocity:
            name = sections.own(VELOCITY_TIME, source, section)
            found.append(time_offset_block(name, sd_s, skew))
        found.append(clock_skew_block(skew))
    lever_sd = lever_sd_m(section, sections.aiding)
    if lever_sd:
        name = sections.own(ANTENNA_LEVER, source, section)
        found.append(antenna_lever_block(name, lever_sd))
    names = _fix_bias(source, section, sections)
    if names:
        level, down = names
        lasts_s = section.bias_correlation_s
        found.append(position_bias(level, section.shared_sd_m, lasts_s))
        found.append(position_bias(down, section.bias_down_sd_m, lasts_s, "d"))
        found.append(fix_markov_block(_markov_block(source, section, sections), LASTS_S))
    return found


def operator_position(
    t_ns: int, where: tuple[float, float, float], sd_m: float
) -> PositionMeasurement:
    """Position (rad, rad, m) by an operator, one sigma (m) of each axis."""
    return PositionMeasurement(OPERATOR, t_ns, OPERATOR_GATE, *where, (sd_m,) * 3, (0.0, 0.0, 0.0))


KIND = Kind(PositionFix, measurements_of, {GnssAiding: blocks})
