"""Who speaks for a filter: the series that are believed, and those that contradict it.

`lost`       positions come and none is believed: the IMU alone carries the solution
`contested`  something is believed, but what was left out may be right, and nobody can tell
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from fusiond.aiding.base import Aid
from fusiond.integrity.moved import FINE_M
from fusiond.integrity.series import NEVER_NS, REPEATED, Series, said

# What is not heard of for so long is judged anew: the vehicle has left the place of the trouble.
FORGET_NS = 5_000_000_000
# Another position supports the filter for as long as `coasting` is not said.
OTHERS_NS = 10_000_000_000
# A position says nothing of what is finer than it by more than this.
COARSER = 3.0
# While the velocity of the same device was fused this lately, the filter's motion is supported.
SUPPORT_NS = 2_000_000_000
# How long (ns) a sensor that has changed is wrong has no scale: what has lasted for t may be over
# within another. That counts from when a doubt is over for the operator; what has lasted for ten
# times as long is how the sensor is. Between two aids it counts no longer than `SUPPORT_NS`: what
# an outage hides it would have hidden before.
UNSETTLED_NS, SETTLED_NS = 10_000_000_000, 100_000_000_000
# Two velocities in a row that the gate of 0.9999 refuses are no chance: an IMU that has turned is
# wrong by the full acceleration from the first on, and of a receiver of 1 Hz the third comes late.
REFUSED_TWICE = 2
# A value that is the same to the bit has the same error: each more of a run of them counts with
# half of the information of the one before, so that all of them together are not three
# measurements. So many halves are as good as none.
HALVED, MOST_HALVES = math.sqrt(2.0), 60
# A coarse position contradicts one that is so many of its sigmas away; it is asked for seldom, and
# an IMU keeps within the same for a minute.
DISPUTE_SIGMAS, DISPUTE_NS = 6.0, 60_000_000_000

Records = Mapping[str, Series]


class Lost(NamedTuple):
    """No position is believed: since when, whether `source` or `filter` is to blame, and how the
    first of them ended (`jumped`, `drifts`, ...), and how far they are away (m). `disputed`: a
    coarse position that is believed says that the source is wrong. `returning`: one is on its way
    back. `alone`: it sends no velocity."""

    since_ns: int
    cause: str
    device: str
    reason: str
    away_m: float
    disputed: bool
    returning: bool = False
    alone: bool = False


def lost(records: Records, t_ns: int) -> Lost | None:
    """Set while positions come and none is believed."""
    heard = []
    for r in records.values():
        if r.locates and t_ns - r.heard_ns <= FORGET_NS:
            if r.believed:
                return None
            heard.append(r)
    if not heard:
        return None
    first = min(heard, key=lambda r: r.refused_ns)
    source = all(r.jumped or supported(records, r.device, t_ns) for r in heard)
    away_m = min(math.hypot(r.away_m, r.above_m) for r in heard)
    disputed = any(
        r.locates
        and r.believed
        and t_ns - r.fused_ns <= DISPUTE_NS
        and away_m > DISPUTE_SIGMAS * r.sd_m
        for r in records.values()
    )
    reason = first.excluded or "refused"
    cause = "source" if source else "filter"
    returning = any(r.excluded and r.returning for r in heard)
    alone = not any(r.moves and r.device == first.device for r in records.values())
    return Lost(first.refused_ns, cause, first.device, reason, away_m, disputed, returning, alone)


def contested(records: Records, t_ns: int) -> str | None:
    """What may be right though it was left out, or was not checked yet."""
    for name, r in records.items():
        if r.no_slip and r.excluded:
            return f"{name} does not hold: sliding, or the IMU has turned in its mounting"
        if t_ns - r.heard_ns > OTHERS_NS:
            continue
        if r.locates and r.excluded and not fine_enough(records, r, t_ns):
            return f"{name} is left out ({r.excluded}) and no other is as fine"
        # A velocity that jumped away is wrong by itself; one that left slowly may be right.
        wrong = r.excluded or (r.refused >= REFUSED_TWICE and "refused")
        if r.moves and wrong and not r.jumped and not _moving(records, r, t_ns):
            return f"{name} is left out ({wrong}), or the IMU is wrong"
        if (
            r.proof
            and not _goes_along(records, r)
            and r.believed
            and not others(records, r, t_ns, FINE_M)
        ):
            return f"{name} is back and not yet seen to go with the motion"
        if (
            r.punctual
            and r.punctual.matters
            and r.believed
            and not others(records, r, t_ns, FINE_M)
        ):
            came = "began anew after a failure" if r.punctual.started else "is back"
            return f"{name} {came}, and no change of velocity has shown yet that it is on time"
    return None


def unsettled(records: Records, doubts: Sequence[int], t_ns: int) -> float:
    """Of a doubt's variances, the share by which the sensors' errors may have changed anew since
    the position or velocity before the one that comes."""
    since_ns = t_ns - doubts[-1] if doubts else 0
    if not 0 < since_ns <= SETTLED_NS:
        return 0.0
    before_ns = max(r.heard_ns for r in records.values() if r.moves or r.locates)
    step_ns = min(t_ns - before_ns, since_ns, SUPPORT_NS)
    return max(step_ns, 0) / max(since_ns, UNSETTLED_NS)


def hangs(records: Records, record: Series) -> bool:
    """Whether a series repeats itself no less often than the position of the same device, so that
    the device hangs."""
    return record.repeats >= REPEATED and any(
        r.locates and r.device == record.device and r.repeats >= REPEATED for r in records.values()
    )


def supported(records: Records, device: str, t_ns: int) -> bool:
    """Whether a velocity of the device agrees with the filter still."""
    return any(
        r.moves and r.device == device and r.believed and t_ns - r.fused_ns <= SUPPORT_NS
        for r in records.values()
    )


def vouched(records: Records, device: str, t_ns: int) -> bool:
    """Whether a velocity of the device supports the filter that was not left out lately: what has
    just come back does not speak against a position that was believed meanwhile."""
    return supported(records, device, t_ns) and not any(
        r.moves and r.device == device and r.believed and t_ns - r.back_ns <= OTHERS_NS
        for r in records.values()
    )


def velocity_left_out(records: Records, t_ns: int) -> bool:
    """Whether a velocity that comes is not believed."""
    return any(r.moves and r.excluded and t_ns - r.heard_ns <= FORGET_NS for r in records.values())


def velocity_sd(records: Records, device: str) -> float:
    """Sigma (m/s) of the device's velocities as a mean of many shows it; 0 without any."""
    found = (r.sd_m_s * r.means.colour for r in records.values() if r.moves and r.device == device)
    return max(found, default=0.0)


def coarseness(records: Records, record: Series, aid: Aid) -> float:
    """With how many times its stated sigma a velocity counts: receivers filter theirs, so that its
    errors last for seconds (fusiond.integrity.means). A position has a state for what its fixes
    share. Both, where the device says the same to the bit again and again."""
    hangs = _hangs(records, record, aid) if record.alike else 1.0
    if not aid.moves:
        return hangs
    return hangs * record.means.lasting((aid.t_ns - record.heard_ns) * 1e-9)


def assumes(records: Records, aid: Aid) -> bool:
    """Whether an aid counts as coarser than it says, and its own errors have not shown that."""
    if not (aid.moves or aid.locates) or (record := records.get(aid.source)) is None:
        return False
    return record.means.assuming if aid.moves else record.alike > 0


def _hangs(records: Records, record: Series, aid: Aid) -> float:
    """With how many times its sigma one more value counts, after a run of the same, at rest as
    well. Speeds are printed coarser and may stay the same: they hang where the position of the same
    device does."""
    alike = record.alike
    if not record.locates:
        positions = (r.alike for r in records.values() if r.locates and r.device == record.device)
        alike = min(alike, max(positions, default=0))
    if not alike or said(aid.offers())[2] != record.value:
        return 1.0
    return HALVED ** min(alike, MOST_HALVES)


def others(records: Records, record: Series, t_ns: int, sd_m: float) -> bool:
    """Whether other positions, good to `sd_m`, have been believed lately: a coarse one cannot
    say that a fine one is wrong."""
    return any(
        r.locates
        and r is not record
        and r.believed
        and (r.proof is None or _goes_along(records, r))
        and r.sd_m <= sd_m
        and t_ns - r.fused_ns <= OTHERS_NS
        for r in records.values()
    )


def _goes_along(records: Records, record: Series) -> bool:
    """Whether a position that is back goes with the motion as far as is known. Of a device whose
    own velocity was left out since, nothing but the whole proof says so: late fixes take a filter
    along, and the velocities that had contradicted it with it."""
    proof = record.proof
    return (
        proof is not None
        and proof.goes_along
        and not any(
            r.moves and r.device == record.device and (r.excluded or r.back_ns >= proof.begin_ns)
            for r in records.values()
        )
    )


def from_another(records: Records, device: str) -> bool:
    """Whether another device's position is believed and was fused, be it a coarse one."""
    return any(
        r.locates and r.device != device and r.believed and r.fused_ns > NEVER_NS
        for r in records.values()
    )


def fine_enough(records: Records, record: Series, t_ns: int) -> bool:
    """Whether a position that is left out is stood in for by one about as fine."""
    return others(records, record, t_ns, max(FINE_M, COARSER * record.sd_m))


def outage(records: Records, record: Series, t_ns: int) -> bool:
    """Whether there were fine positions, and none has been fused for as long as makes coasting;
    `record` is that of a position."""
    if record.sd_m <= FINE_M and t_ns - record.fused_ns <= OTHERS_NS:
        return False  # itself has been, as nearly always
    latest_ns = NEVER_NS
    for r in records.values():
        if r.locates and r.sd_m <= FINE_M and r.fused_ns > latest_ns:
            latest_ns = r.fused_ns
    return latest_ns > NEVER_NS and t_ns - latest_ns > OTHERS_NS


def _moving(records: Records, record: Series, t_ns: int) -> bool:
    """Whether another velocity is believed."""
    return any(
        r.moves and r is not record and r.believed and t_ns - r.fused_ns <= SUPPORT_NS
        for r in records.values()
    )
