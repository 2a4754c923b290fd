r"""What a position is asked once it is back after an outage, or a filter was started from it anew.

That it goes with the motion (fusiond.integrity.proof) and is on time (fusiond.integrity.punctual).
Until then what is published is the wider for it (fusiond.integrity.hedge), and by what its first
fix is off beyond what chance does once in twenty (fusiond.integrity.moved). Where that fix lies
behind the filter by more than is likely, or the start was one after a failure, the mode says so,
too: nothing else is known of it then, and an outage more does not tell either.

A fix that is late by tau lies behind by tau v, along the track and nowhere else. So with the
innovation z = estimate - fix, S its covariance and u the direction of the velocity, it is

    u^T z > SURPRISE sqrt(u^T S u)

that is asked: of all three axes together, a vehicle's height and what is across the track would
hide by their own noise what is along it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid, NotApplicable, State
from fusiond.aiding.offers import PositionOffer
from fusiond.estimators.base import gate_threshold
from fusiond.integrity import support
from fusiond.integrity.means import LIKELY
from fusiond.integrity.moved import FINE_M, Moved
from fusiond.integrity.proof import UNPROVEN_SIGMAS, Proof, settled
from fusiond.integrity.punctual import MOVING_M_S, Before, Punctual
from fusiond.integrity.series import NEVER_NS, Series
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.error_model import DR, PHI
from fusiond.navigation.strapdown import VE, VN

Array = NDArray[np.float64]

# Behind by so many sigmas a sound receiver is one time in forty.
SURPRISE = 1.96


class Begun(NamedTuple):
    """How the filter was started: positions had been `contradicted` by their velocities; a filter
    before it had `failed`; the source that it is made of has `moved` from that one."""

    contradicted: bool = False
    failed: bool = False
    moved: Moved | None = None


class Coming(NamedTuple):
    """Of a position that is about to be fused: whether it lies `behind` by more than is likely,
    the `gain` that the filter follows it with, the horizontal axes' mean, what is known `before`
    it, what it is off by (m^2), north, east, down, beyond what is likely, and what of that the
    filter takes for a tilt (rad^2)."""

    behind: bool = False
    gain: float = 0.0
    before: Before = Before()
    beyond: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt: float = 0.0


NOTHING = Coming()


def coming(aid: Aid, state: State, covariance: Array) -> Coming:
    """Of a position, about to be fused into a filter of that state and P (n, n), and to count with
    `UNPROVEN_SIGMAS` times its sigma."""
    rows = NotApplicable("") if aid.screened else aid.innovation(state)
    if isinstance(rows, NotApplicable) or not np.array_equal(rows.h[:2, DR : DR + 2], np.eye(2)):
        return NOTHING
    with_all = rows.h[:2] @ covariance
    own, r = with_all @ rows.h[:2].T, np.diag(rows.r[:2])
    gain = np.linalg.solve(own + UNPROVEN_SIGMAS**2 * r, with_all[:, DR : DR + 2])
    followed = max(0.0, 0.5 * float(np.trace(gain)))
    tilt, yaw = max(np.diag(covariance)[PHI : PHI + 2]), covariance[PHI + 2, PHI + 2]
    before = Before(math.inf, STANDARD_GRAVITY_M_S2 * math.sqrt(tilt), math.sqrt(yaw))
    s = np.einsum("ij,jk,ik->i", rows.h, covariance, rows.h) + rows.r
    north, east, *down = np.maximum(rows.z**2 - LIKELY * s, 0.0).tolist()
    beyond = (north, east, down[0] if down else 0.0)
    follows = covariance[PHI : PHI + 2, DR : DR + 2] / np.diag(covariance)[DR : DR + 2]
    tilted = float((follows**2 @ beyond[:2]).sum())  # of whichever axis roll and pitch are about
    v_n, v_e = float(state.nav[VN]), float(state.nav[VE])
    speed = math.hypot(v_n, v_e)
    if speed <= MOVING_M_S:
        return Coming(gain=followed, before=before, beyond=beyond, tilt=tilted)
    along = np.array([v_n, v_e]) / speed
    sd = math.sqrt(float(along @ (own + r) @ along))
    behind = float(along @ rows.z[:2]) > SURPRISE * sd
    return Coming(behind, followed, before._replace(late_s=sd / speed), beyond, tilted)


def prove(
    records: Mapping[str, Series],
    record: Series,
    offer: PositionOffer,
    nav: Array,
    state: State | None,
    begun: Begun,
    comes: Coming,
    probability: float,
) -> bool:
    """A position was fused into a filter with the state `nav` (10,), the whole `state` where it is
    known; whether it runs away, beyond a chi-square of that `probability`, from the motion since an
    outage, which a velocity of the same device supports. `comes`: what was seen of it before."""
    first = record.fused_ns == NEVER_NS and record.sd_m <= FINE_M
    suspect = begun.contradicted and first
    if begun.failed and first:
        record.punctual = Punctual(offer.t_ns, started=True)
    if first and begun.moved is not None and begun.moved.device == record.device:
        record.moved = begun.moved
    out = support.outage(records, record, offer.t_ns)
    if out and not (record.punctual and record.punctual.started):
        came = Punctual(offer.t_ns, expected=not comes.behind, before=comes.before)
        record.punctual = came if record.sd_m <= FINE_M else None
        if any(comes.beyond):
            out_ns = max(record.every_ns, support.OTHERS_NS)
            moved = Moved(record.device, offer.t_ns, out_ns, comes.beyond, tilt=comes.tilt)
            record.moved = moved.joined(record.moved)
    if record.punctual is not None:
        v_n, v_e, sd = float(nav[VN]), float(nav[VE]), record.sd_m * record.means.colour
        since = record.punctual.with_one(offer.t_ns, v_n, v_e, sd)
        record.punctual = None if since.over else since
    if not (suspect or out or record.proof):
        return False
    offer = offer if state is None else settled(offer, state)
    if suspect or out or record.proof is None:
        record.proof = Proof.begun(offer, nav, record.means.colour, suspect)
        return False
    sd_m_s = support.velocity_sd(records, record.device)
    proof = record.proof.with_one(offer, nav, sd_m_s, comes.gain)
    record.proof = None if proof.proven else proof
    limit = gate_threshold(probability, 2)
    return proof.drifts(limit) and support.supported(records, record.device, offer.t_ns)
