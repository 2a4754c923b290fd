"""Compiled kernels: a filter with its bank over many measurements in one call.

Measurements come as rows of numbers in order of validity (fusiond.aiding.packed). Each is processed
as by fusiond.estimators.kalman: propagation, gate, update, evidence, and rotation of the tilt axes.
The call ends before any decision outside the filter's arithmetic: a measurement fails its gate, a
hypothesis is likely, a checkpoint is due, a heading is uncertain.

The covariance that hypotheses add is computed only if it may be read: not before another measured
epoch, which computes it again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import LENT_ROWS, VELOCITY
from fusiond.aiding.packed import (
    APPLIES,
    ASKED,
    GATE,
    KIND,
    MEASURED,
    MEASURES,
    MOTION_ASKED,
    NAMES,
    OF_DEVICE,
    ROWS,
    SERIES,
    T_NS,
    packed_rows,
)
from fusiond.estimators.fault_bank import SUSPECTS, UNJUDGED, UNWEIGHED, is_evidence
from fusiond.estimators.fault_odds import judge
from fusiond.estimators.fault_prescreen import any_likely, judge_what_waits
from fusiond.estimators.fault_sizes import judge_and_widen
from fusiond.estimators.gated_update import fold_and_account
from fusiond.estimators.noise_scale import learn
from fusiond.estimators.propagation import RECORD, propagate_for
from fusiond.estimators.published_state import WIDER, surely_moves
from fusiond.estimators.state_array import (
    BANK,
    LINE,
    NAV_AT,
    PUBLISHED_AT,
    ROOM,
    STEP_AT,
    SUMS_AT,
    WIDER_AT,
    XI_AT,
)
from fusiond.estimators.state_array import SIZE as STATES
from fusiond.estimators.tilt_axes_rotation_after_update import (
    ESTIMATE_SIZE,
    carry_over,
    may_part,
    remember_estimate,
)
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import PHI, WIDTHS
from fusiond.navigation.strapdown import STEP_RESTS_S

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Single = NDArray[np.float32]

FUSED, GATED, NOT_FINITE = range(len(NAMES), len(NAMES) + 3)
"""Results of a measurement beside those of `packed_rows`, which are refusals."""
ENDS = (*NAMES, "fused", "gated", "not_finite")
"""Names of all results."""
BECAME, NIS, MOVES, DEGREES, WHITENED, INNOVATION, OF_STATE = 0, 1, 2, 3, 4, 7, 10
RESULT = OF_STATE + LENT_ROWS * 6
"""Layout of a result: what became of the measurement, NIS, 1 if the vehicle moves, number of rows
that apply, innovation whitened and as it is (3 each), and what its rows have of velocity and
position (3 x 6)."""
DONE, KEEP, JUDGE, OTHERWISE = range(4)
"""Ends of a call: all done; a checkpoint is due before the next measurement; the last one needs a
judgement; the next one is not a row for this kernel."""
KNOWN, TURNED, SETTLES, UNDOUBTED, PLAIN, LARGE, KNOWS = range(7)
"""State of a filter beside its memory: 1 if its heading has been known; rotation (rad) of the tilt
axes by the last update; 1 if its updates may rotate them; 1 if gyros are undoubted; the heading
variances below and above which it is known and unknown."""
_Y, _Z, _R, _BEFORE, AT_H = 0, 3, 6, 9, 9 + ESTIMATE_SIZE
"""Layout of work space, g behind H."""


StateParts = tuple[Array, Array, Array, Array, Array]
"""Navigation state (10,), parameters (n,), last step, P (w, w), error estimate (n,)."""
BankParts = tuple[Array, Indices, Array, Array, Array, Single, Array]
"""Bank, the three parts of its table, `found`, and work space for rows and for the added
covariance."""
OpenedParts = tuple[Array, Array, Array]
"""Axes and clock of publication (3,), mounting (2, 2), and variances added to the sigmas (9,)."""
AxesParts = tuple[Indices, Indices, Indices, Indices]
"""Parts of `Axes`."""
ModelParts = tuple[Indices, Array, bool]
"""Columns of the states, their initial sigmas (n,), and 1 if height is held."""


class Axes(NamedTuple):
    """Slots of an update's rotation: force biases and their axes (2, k), gyros (0 or 3,), lever arm
    (0 or 3,), offset in time (0 or 1,)."""

    biases: Indices
    gyros: Indices
    lever: Indices
    time: Indices


NO_AXES = Axes(np.zeros((2, 0), dtype=np.int64), *(np.zeros(0, dtype=np.int64),) * 3)


_STATE = "Tuple((f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1]))"
_BANK = "Tuple((f8[::1], i8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f4[::1], f8[::1]))"
_OPENED = "Tuple((f8[::1], f8[:, ::1], f8[::1]))"
_MODEL = "Tuple((i8[::1], f8[::1], b1))"
_AXES = "Tuple((i8[:, ::1], i8[::1], i8[::1], i8[::1]))"


@compiled(f"void(b1, b1, {_STATE}, {_BANK}, {_OPENED})")
def conclude(
    later: bool, waits: bool, state: StateParts, of_bank: BankParts, opened: OpenedParts
) -> None:
    """Compute deferred odds; the added covariance follows `later`, or now. Odds `waits` if nothing
    reads them before they change."""
    nav, xi, step, _, dx = state
    bank, ints, numbers, lanes, found, _, work = of_bank
    judge_what_waits(bank, ints, numbers, lanes, found)
    epoch_s = bank[UNJUDGED]
    if epoch_s < np.inf:
        if waits and not any_likely(bank, lanes):
            bank[UNJUDGED], bank[UNWEIGHED] = np.inf, epoch_s
        elif later:
            judge(bank, ints, numbers, lanes, epoch_s, found)
        else:
            published, mounting, wider = opened
            judge_and_widen(
                *(bank, ints, numbers, lanes, dx.shape[0], epoch_s, True, True),
                *(nav, xi, step, published, mounting, work, wider, found),
            )


@compiled("b1(i8[:, ::1], i8, i8)")
def _said_later(ints: Indices, first: int, until_ns: int) -> bool:
    """True if a row from `first` on is measured, applies in any state, and comes before
    `until_ns`."""
    for i in range(first, ints.shape[0]):
        if ints[i, T_NS] >= until_ns:
            return False
        if ints[i, KIND] <= VELOCITY:
            return True
    return False


@compiled(f"i8(i8[::1], f8[::1], {_STATE}, {_BANK}, {_OPENED}, f8[::1])")
def _judged(
    of: Indices,
    y: Array,
    state: StateParts,
    of_bank: BankParts,
    opened: OpenedParts,
    noise: Array,
) -> int:
    """Result `JUDGE` for a fused measurement whose odds cannot be deferred; else `DONE`, after
    learning the noise scale from its innovation y."""
    nav, xi, step, _, dx = state
    bank, ints, numbers, lanes, found, _, work = of_bank
    m, t_s = of[ROWS], of[T_NS] * 1e-9
    measured = of[ASKED] & MEASURED != 0
    if is_evidence(bank, of[MEASURES], t_s, measured):
        if bank[SUSPECTS] != 0.0:
            return JUDGE
        bank[UNJUDGED] = t_s
    if measured:
        learn(noise, t_s, y[0], y[1] if m > 1 else 0.0, y[2] if m > 2 else 0.0, m)
    elif bank[UNJUDGED] == np.inf:
        published, mounting, wider = opened
        judge_and_widen(
            *(bank, ints, numbers, lanes, dx.shape[0], t_s, False, True),
            *(nav, xi, step, published, mounting, work, wider, found),
        )
    return DONE


@compiled(
    f"i8(f8[::1], {_STATE}, {_BANK}, {_OPENED}, {_MODEL}, {_AXES}, f8[::1], f8[::1], f8[::1],"
    " f8[::1])",
    allocates=True,
)
def fold_row(
    x: Array,
    state: StateParts,
    of_bank: BankParts,
    opened: OpenedParts,
    model: ModelParts,
    axes: AxesParts,
    noise: Array,
    work: Array,
    knows: Array,
    result: Array,
) -> int:
    """Apply the packed measurement `x` at its instant, whose series has that `noise`; write
    `result` (RESULT,). Returns `DONE`, `JUDGE`, or `OTHERWISE` without a change."""
    nav, xi, step, cov, dx = state
    bank, ints, numbers, lanes, found, of_rows, _ = of_bank
    of = x.view(np.int64)
    n, width, m = dx.shape[0], cov.shape[1], of[ROWS]
    heading = cov[PHI + 2, PHI + 2]
    if knows[SETTLES] > 0.0:
        if knows[KNOWN] > 0.0 and heading > knows[LARGE]:
            return OTHERWISE
        if heading < knows[PLAIN]:
            knows[KNOWN] = 1.0
    result[NIS], result[MOVES], result[DEGREES] = np.nan, 0.0, 0.0
    if of[ASKED] & MOTION_ASKED:
        result[MOVES] = surely_moves(cov, nav, step, opened[0], np.zeros(WIDER))
    y, z, r = work[_Y : _Y + m], work[_Z : _Z + m], work[_R : _R + m]
    h = work[AT_H : AT_H + m * n].reshape((m, n))
    g = work[AT_H + LENT_ROWS * n : AT_H + LENT_ROWS * n + m * width].reshape((m, width))
    applies = packed_rows(x, (nav, xi, step), model, cov[:n, :n], z, h, r)
    result[BECAME], knows[TURNED] = applies, 0.0
    if applies != APPLIES:
        return DONE
    result[DEGREES] = m
    for a in range(m):
        r[a] *= noise[a]
        result[INNOVATION + a] = z[a]
        for i in range(6):
            result[OF_STATE + 6 * a + i] = h[a, 3 + i]
    before = work[_BEFORE:AT_H]
    carried = axes[2].size > 0 or may_part(cov[:n, :n], axes[0][0])
    if carried:
        remember_estimate(nav, xi, axes[0], axes[1], axes[2], before)
    nis = fold_and_account(
        *(nav, xi, step, cov, dx, z, h, r, x[GATE], y, g, bank, ints, numbers, lanes),
        *(of[T_NS], of[MEASURES], of[OF_DEVICE], of_rows, found),
    )
    result[NIS] = nis
    if not nis <= x[GATE]:
        result[BECAME] = GATED if math.isfinite(nis) else NOT_FINITE
        return JUDGE if math.isfinite(nis) else DONE
    result[BECAME] = FUSED
    for a in range(m):
        result[WHITENED + a] = y[a]
    if carried:
        biases, gyros, lever, time = axes
        kept = gyros if knows[UNDOUBTED] > 0.0 and step[STEP_RESTS_S] == 0.0 else gyros[:0]
        knows[TURNED] = carry_over(cov, n, bank, before, nav, xi, biases, kept, lever, time)
    return _judged(of, y, state, of_bank, opened, noise)


@cache
def run_for(width: int) -> Callable[..., tuple[int, int, int, int]]:
    """`run_rows` for covariances of `width` rows."""
    propagate, square = propagate_for(width), width * width

    @compiled(
        "UniTuple(i8, 4)(f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], i8[:, ::1],"
        "f8[:, ::1], f8[::1], i8[::1], f8[::1], i8[:, ::1], i8[::1], i8[::1], i8[::1], f8[:, ::1],"
        "f8[::1], f4[::1], f8[::1], f8[::1], f8[::1], i8, i8, i8, b1, b1, i8, i8)",
        variant=width,
        allocates=True,
    )
    def run_rows(
        state: Array,
        imu: Array,
        measurements: Array,
        results: Array,
        series: Array,
        ints: Indices,
        numbers: Array,
        lanes: Array,
        column_of: Indices,
        initial: Array,
        biases: Indices,
        gyros: Indices,
        lever: Indices,
        time: Indices,
        mounting: Array,
        work: Array,
        of_rows: Single,
        bank_work: Array,
        knows: Array,
        found: Array,
        sample: int,
        now: int,
        options: int,
        hold_height: bool,
        passing: bool,
        kept_ns: int,
        every_ns: int,
    ) -> tuple[int, int, int, int]:
        """Run the filter over `measurements` (k, SIZE), with the noise of their `series` (s, .).

        The run starts at `now` and the next `sample`, and ends at the first measurement `every_ns`
        after the last checkpoint. Returns next sample, new time, number of rows done and the reason
        for stopping.
        """
        head = state[:LINE].view(np.int64)
        n, room = head[STATES], head[ROOM]
        upto = XI_AT + n + room * n
        rest = state[(upto + LINE - 1) // LINE * LINE :]
        bank = rest[room * square : room * square + head[BANK]]
        parts = (
            state[NAV_AT:STEP_AT],
            state[XI_AT : XI_AT + n],
            state[STEP_AT:SUMS_AT],
            rest[:square].reshape((width, width)),
            state[XI_AT + n : XI_AT + 2 * n],
        )
        of_bank = bank, ints, numbers, lanes, found, of_rows, bank_work
        opened = state[PUBLISHED_AT:WIDER_AT], mounting, state[WIDER_AT : WIDER_AT + WIDER]
        model, axes = (column_of, initial, hold_height), (biases, gyros, lever, time)
        of_all = measurements.view(np.int64)
        recorded, i = (options & RECORD) != 0, 0
        while i < measurements.shape[0]:
            of = of_all[i]
            later = not recorded and _said_later(of_all, i, kept_ns + every_ns)
            waits = later and of[KIND] <= VELOCITY
            if of[T_NS] > now or passing:
                conclude(later, waits, parts, of_bank, opened)
                sample, now = propagate(state, imu, sample, now, of[T_NS], options)
                passing = False
                if now - kept_ns >= every_ns:
                    return sample, now, i, KEEP
            if not of[ASKED] & MEASURED:
                conclude(later, waits, parts, of_bank, opened)
            how = fold_row(
                *(measurements[i], parts, of_bank, opened, model, axes),
                *(series[of[SERIES]], work, knows, results[i]),
            )
            if how == OTHERWISE:
                return sample, now, i, OTHERWISE
            i += 1
            if how == JUDGE:
                return sample, now, i, JUDGE
        return sample, now, i, DONE

    return run_rows


for _width in WIDTHS:
    run_for(_width)
