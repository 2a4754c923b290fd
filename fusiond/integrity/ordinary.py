"""An ordinary aid in one call: folded in as its filter does it, and judged as its series is.

Nearly all aids are: their series is believed and nothing is open of it, and they pass their gate. A
kernel then calls in turn what update and judgement consist of, and has no formula of its own. It
leaves all as it was where an aid is none, and says what it cannot settle: that is Python's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import LENT_ROWS, Aid, speed_of
from fusiond.aiding.body_velocity import DRIFT, PITCH, YAW, across_of
from fusiond.aiding.packed import COUNTS, KIND, NO_SLIP, POSITION, ROWS, SLOTS, VELOCITY
from fusiond.aiding.rows import write_rows
from fusiond.estimators.base import THRESHOLDS, Outcome
from fusiond.estimators.tilt_axes import (
    ESTIMATE_SIZE,
    carry_over_all,
    may_part,
    remember_estimate,
)
from fusiond.estimators.update import Plain, fuse
from fusiond.integrity.hedge import any_beyond_prior, beyond_chance
from fusiond.integrity.means import BIASED, UNLIKELY, lasting_of, take_few
from fusiond.integrity.moved import FINE_M
from fusiond.integrity.proof import residual_of
from fusiond.integrity.punctual import MOVING_M_S
from fusiond.integrity.series import Said, Series, said
from fusiond.integrity.slip import take_slip
from fusiond.integrity.support import FORGET_NS, OTHERS_NS
from fusiond.integrity.tilt import Tilting, remember, too_far
from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled
from fusiond.navigation.strapdown import VE, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

OTHERWISE = -1
"""Not taken in: nothing has changed."""
BIAS, UNUSUAL, STRAYS, ACROSS, TILTED, SITS, ASSUMED, LATELY = 1, 2, 4, 8, 16, 32, 64, 128
"""What taking in has shown, added up: a mean is beyond chance, or not likely; beyond chance is what
fixes share, what goes across of a vehicle that does not slip, what the tilt was corrected by, where
the unit sits; the sigma that counted is assumed; the last velocities are not likely."""
LEAVES_OPEN = BIAS | UNUSUAL | STRAYS | LATELY
"""What the solution may be less sure for than P is."""


@compiled(
    "Tuple((i8, f8, f8, f8, UniTuple(f8, 3)))(f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1],"
    "i8[::1], f8[::1], b1, i8[:, ::1], i8[::1], i8[::1], i8[::1], f8[::1], i8[::1], f8[::1], i8,"
    "i8, f8, b1, f8[::1], f8, f8[::1], f8[::1], f8[::1])"
)
def _take(
    nav: Array,
    xi: Array,
    step: Array,
    cov: Array,
    dx: Array,
    column_of: Indices,
    initial: Array,
    hold_height: bool,
    biases: Indices,
    gyros: Indices,
    lever: Indices,
    late: Indices,
    room: Array,
    slots: Indices,
    numbers: Array,
    t_ns: int,
    every_ns: int,
    threshold: float,
    tilts: bool,
    means: Array,
    limit: float,
    slip: Array,
    sums: Array,
    before: Array,
) -> tuple[int, float, float, float, tuple[float, float, float]]:
    """Take an aid in at `t_ns`, `every_ns` after the one before it of its series. What it has
    shown, or `OTHERWISE`; the NIS; how far the filter is from a position, north and east (m); the
    whitened innovation, 0 behind it."""
    m, n, width = slots[ROWS], dx.shape[0], cov.shape[0]
    p = cov[:n, :n]
    z, r, y = room[:m], room[LENT_ROWS : LENT_ROWS + m], room[2 * LENT_ROWS : 2 * LENT_ROWS + m]
    at, end = 3 * LENT_ROWS, 3 * LENT_ROWS + m * n
    h, g = room[at:end].reshape((m, n)), room[end : end + m * width].reshape((m, width))
    shown, coarse, assumes = 0, 1.0, False
    if slots[KIND] == VELOCITY:
        coarse, assumes = lasting_of(means, every_ns * 1e-9)
    if not write_rows(
        slots, numbers, coarse, nav, xi, step, column_of, initial, hold_height, p, z, h, r
    ):
        return OTHERWISE, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0)
    if tilts:
        remember(nav, p, before)
    carries = lever.size > 0 or may_part(p, biases[0])
    estimate = room[room.shape[0] - ESTIMATE_SIZE :]
    if carries:
        remember_estimate(nav, xi, biases, gyros, lever, estimate)
    nis = fuse(nav, xi, cov, dx, z, h, r, threshold, False, y, g)
    if not nis <= threshold:
        return OTHERWISE, nis, 0.0, 0.0, (0.0, 0.0, 0.0)
    turned = 0.0
    if carries:
        turned = carry_over_all(p, estimate, nav, xi, biases, gyros, lever, late)
    north = east = 0.0
    if slots[KIND] == POSITION:
        a = SLOTS + slots[COUNTS]
        b = a + slots[COUNTS + 1]
        c = b + slots[COUNTS + 2]
        x = numbers
        north, east = residual_of(nav, xi, slots[a:b], slots[b:c], x[0], x[1], x[3], x[4], x[5])
        if any_beyond_prior(xi, p, slots[c:]):
            shown |= STRAYS
    elif slots[KIND] == NO_SLIP:
        x, of = numbers, slots[SLOTS : SLOTS + slots[COUNTS]]
        row = room[at : at + n].reshape((1, n))
        across = across_of(
            nav,
            step,
            xi,
            column_of,
            hold_height,
            x[0],
            x[1],
            x[2],
            of,
            z[:1],
            row,
        )
        drift_sd = initial[of[DRIFT]] if of[DRIFT] >= 0 else 0.0
        if take_slip(slip, t_ns, across, drift_sd, speed_of(nav), x[6]) > 0.0:
            shown |= ACROSS
        if of[PITCH] >= 0:
            sd = max(initial[of[PITCH]], initial[of[YAW]])
            if beyond_chance(xi[of[PITCH]], sd) + beyond_chance(xi[of[YAW]], sd) > 0.0:
                shown |= SITS
    whitened = y[0], y[1] if m > 1 else 0.0, y[2] if m > 2 else 0.0
    found = take_few(means, t_ns, limit, whitened[0], whitened[1], whitened[2])
    if found == BIASED:
        shown |= BIAS
    elif found == UNLIKELY:
        shown |= UNUSUAL
    if tilts and found != BIASED and too_far(sums, t_ns, before, nav, p, turned):
        shown |= TILTED
    if assumes:
        shown |= ASSUMED
    return shown, nis, north, east, whitened


class Ordinary(NamedTuple):
    """What of an aid is the same each time it is applied: as `Packed`, rows, chi-square of its gate
    and of the test of its means, what it says, the larger horizontal sigma of a position or
    velocity (m, m/s; else 0), and whether its corrections of the tilt add up."""

    slots: Indices
    numbers: Array
    degrees: int
    threshold: float
    limit: float
    says: Said
    sd: float
    tilts: bool


def made(aid: Aid, model: Model, tilts: bool, probability: float) -> Ordinary | None:
    """An aid for filters of a model, whose means are tested with that `probability`; None where it
    is never ordinary."""
    packed = aid.packed(model)
    if packed is None:
        return None
    degrees: int = packed.slots.item(ROWS)
    limits = THRESHOLDS[aid.gate, degrees], THRESHOLDS[probability, degrees]
    says = said(aid.offers())
    measured = says[0] or says[1]
    sd = 0.0 if measured is None else max(measured.sd[:2])
    return Ordinary(*packed, degrees, *limits, says, sd, tilts)


def may_be(one: Ordinary, t_ns: int, record: Series) -> bool:
    """Whether nothing but its innovation may make one at `t_ns` of that series another aid."""
    position, _, value = one.says
    if t_ns - record.heard_ns > FORGET_NS or not record.quiet:
        return False
    if position is not None and not (
        0.0 < record.sd_m <= FINE_M
        and one.sd <= FINE_M
        and t_ns - record.fused_ns <= OTHERS_NS
        and not record.alike
    ):
        return False
    if value is None or value != record.value:
        return True
    return not (record.locates or record.moves) and record.may_repeat


def take(
    one: Ordinary, t_ns: int, record: Series, filter_: Plain, tilting: Tilting
) -> tuple[Outcome, int] | None:
    """Take one in that `may_be` ordinary: how it ended, and what that has shown beside. None where
    it is not, and nothing has changed."""
    slots, numbers, degrees, threshold, limit, (position, velocity, value), sd, tilts = one
    every_ns, means = t_ns - record.heard_ns, record.means
    if (packed := means.ready(degrees)) is None:
        return None
    shown, nis, north, east, whitened = _take(
        *filter_,
        slots,
        numbers,
        t_ns,
        every_ns,
        threshold,
        tilts,
        packed,
        limit,
        record.slip.packed,
        tilting.sums,
        tilting.before,
    )
    if shown == OTHERWISE:
        return None
    record.every_ns, record.heard_ns, record.fused_ns = every_ns, t_ns, t_ns
    means.unlikely = shown & UNUSUAL > 0
    if position is not None:
        record.sd_m, record.away_m = sd, math.hypot(north, east)
    elif velocity is not None:
        record.sd_m_s, means.assuming = sd, shown & ASSUMED > 0
        record.lately = lately = record.lately.and_then(whitened, nis)
        if lately.seldom:
            shown |= LATELY
    if value is not None:
        nav = filter_.nav
        record.repeats_itself(value, math.hypot(nav.item(VN), nav.item(VE)) > MOVING_M_S)
    return Outcome("fused", nis, degrees, whitened[:degrees]), shown
