"""Fixes of an RDSS terminal, with one of four strategies for their delay
(fusiond.aiding.rdss_position)."""

from __future__ import annotations

import numpy as np

from drivers.measurements import DelayedFix
from fusiond.aiding.base import AidingMeasurement, NotApplicable
from fusiond.aiding.height import HeightMeasurement
from fusiond.aiding.rdss_fix_covariance import RdssGeometry, with_floor
from fusiond.aiding.rdss_position import BIAS_BLOCK, HeldFeedback, RdssPositionMeasurement
from fusiond.configuration.aiding import RdssAiding
from fusiond.models.blocks import Block, position_bias
from fusiond.navigator.intake.kind import Instants, Kind, Sections

# What a fix moved forward by the computed velocity is wrong by: an acceleration of 2.5 m/s^2 over a
# delay of 1.5 s, which lasts as long as a manoeuvre. The velocity's own error is in the Jacobian.
COMPENSATION_SD_M, COMPENSATION_TAU_S = 3.0, 5.0


def measurements_of(
    m: DelayedFix, sections: Sections, when: Instants
) -> list[AidingMeasurement] | str:
    """Fix, the instant of a delayed feedback, and a height that is new information.

    Rejections: `multi_value`, `no_sigma`, and a name for a place without geometry.
    """
    o = sections.of(m.source, RdssAiding)
    if m.multi_value:
        return "multi_value"
    if not m.precision_class_m > 0.0:
        return "no_sigma"
    class_m = m.precision_class_m
    r = np.eye(2) * class_m**2
    if o.noise == "geometry":
        height_sd_m = o.height_sd_m if m.height_sd_m is None else m.height_sd_m
        geometry = RdssGeometry(o.satellites_deg).covariance(
            m.lat_rad, m.lon_rad, m.height_m, o.range_sd_m, height_sd_m
        )
        if isinstance(geometry, NotApplicable):
            return geometry.outcome
        r = with_floor(geometry.total, class_m)
    r *= o.sigma_scale**2
    arrival_ns = max(when.t_ns, when.seen_ns)
    at_arrival = o.strategy in {"position_compensation", "none"}
    holds = o.strategy == "optimal_prediction" and arrival_ns > when.t_ns
    t_ns = arrival_ns if at_arrival else when.t_ns
    compensated = o.strategy == "position_compensation"
    gate = o.gate_probability
    found: list[AidingMeasurement] = [
        RdssPositionMeasurement(
            m.source,
            t_ns,
            gate,
            m.lat_rad,
            m.lon_rad,
            (float(r[0, 0]), float(r[0, 1]), float(r[1, 1])),
            o.lever_arm_m,
            when.sd_time_s,
            (arrival_ns - when.t_ns) * 1e-9 if compensated else 0.0,
            holds,
        )
    ]
    if holds:
        found.append(HeldFeedback(f"{m.source}_feedback", arrival_ns, gate))
    if o.fix_height_sd_m is not None and not m.height_given:
        sd_m = o.fix_height_sd_m * o.sigma_scale
        found.append(
            HeightMeasurement(f"{m.source}_height", t_ns, gate, m.height_m, sd_m, (BIAS_BLOCK,))
        )
    return found


def blocks(source: str, section: RdssAiding, sections: Sections) -> list[Block]:
    """Block of the fixes' shared error north and east, which position compensation needs for the
    error of the moved fix. One block for all terminals, with the noise of the first."""
    if section.bias_sd_m > 0.0:
        return [position_bias(BIAS_BLOCK, section.bias_sd_m, section.bias_correlation_s)]
    if section.strategy == "position_compensation":
        return [position_bias(BIAS_BLOCK, COMPENSATION_SD_M, COMPENSATION_TAU_S)]
    return []


KIND = Kind(DelayedFix, measurements_of, {RdssAiding: blocks})
