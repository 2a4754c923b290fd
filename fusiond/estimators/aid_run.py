"""Compiled kernels: a filter taken from aid to aid, with its bank of hypotheses, in one call.

Aids come as rows of numbers in order of validity (fusiond.aiding.packed). Each is what
fusiond.estimators.kalman makes of it: propagated to, gated, folded in, taken for evidence, and the
axes of a tilt carried over. The call ends where something is to be decided that is no arithmetic of
a filter: an aid fails its gate, a hypothesis is likely, a checkpoint is due, a heading is wide.

What hypotheses leave open of what is published is computed where somebody may read it: not before
an aid that is measured, whose epoch says it anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple, Protocol

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
    OF_DEVICE,
    ROWS,
    SERIES,
    T_NS,
    packed_rows,
)
from fusiond.estimators.fault_bank import PHI as BANK_PHI
from fusiond.estimators.fault_bank import SUSPECTS, UNJUDGED, UNWEIGHED, WAITS
from fusiond.estimators.fault_carried import settle
from fusiond.estimators.fault_odds import judge
from fusiond.estimators.fault_opened import judge_and_widen
from fusiond.estimators.fault_suspects import any_likely, judge_what_waits
from fusiond.estimators.gated_update import fold_and_account
from fusiond.estimators.hypotheses import Hypotheses
from fusiond.estimators.memory import (
    BANK,
    LINE,
    NAV_AT,
    PUBLISHED_AT,
    ROOM,
    STEP_AT,
    SUMS_AT,
    WIDER_AT,
    XI_AT,
    Memory,
)
from fusiond.estimators.memory import SIZE as STATES
from fusiond.estimators.noise_scale import learn
from fusiond.estimators.propagation import RECORD, propagate_for
from fusiond.estimators.published_state import WIDER, surely_moves
from fusiond.estimators.tilt_axes_carried import (
    ESTIMATE_SIZE,
    carry_over_all,
    carry_over_rows,
    may_part,
    remember_estimate,
)
from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import PHI, WIDTHS
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.strapdown import STEP_RESTS_S

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Single = NDArray[np.float32]

FUSED, GATED, NOT_FINITE = 10, 11, 12
"""Results of an aid beside those of `packed_rows`, which say why it does not apply."""
BECAME, NIS, MOVES, WHITENED, INNOVATION, OF_STATE = 0, 1, 2, 3, 6, 9
RESULT = OF_STATE + LENT_ROWS * 6
"""Layout of a result: what became of the aid, NIS, 1 if the vehicle moves, innovation whitened and
as it is (3 each), and what its rows have of velocity and position (3 x 6)."""
DONE, KEEP, JUDGE, OTHERWISE = range(4)
"""Ways in which a call ends: all is done; a checkpoint is due before the next aid; the last one is
to be judged; the next one is no row of this kernel."""
KNOWN, TURNED, SETTLES, UNDOUBTED, PLAIN, LARGE, KNOWS = range(7)
"""Layout of a filter's state beside its memory: 1 if its heading has been known; by how much (rad)
the last update turned the axes of a tilt; 1 if its updates may turn; 1 if gyros are undoubted; the
heading's variances below and above which it is known, and is not."""
_Y, _Z, _R, _BEFORE, _H = 0, 3, 6, 9, 9 + ESTIMATE_SIZE
"""Layout of work space, g behind H."""


class Axes(NamedTuple):
    """Slots of what an update carries over: force biases and their axes (2, k), gyros (0 or 3,),
    lever arm (0 or 3,), offset in time (0 or 1,)."""

    biases: Indices
    gyros: Indices
    lever: Indices
    late: Indices


NO_AXES = Axes(np.zeros((2, 0), dtype=np.int64), *(np.zeros(0, dtype=np.int64),) * 3)


class Ran(NamedTuple):
    """Number of aids that are done, `DONE` or why there are no more, and results (k, RESULT)."""

    done: int
    how: int
    results: Array


@compiled(
    "void(b1, i8, i8[:, ::1], f8[::1], i8[:, ::1], f8[:, ::1], f8[::1], i8, f8[::1], f8[::1],"
    " f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[::1])"
)
def conclude(
    later: bool,
    next_: int,
    aids: Indices,
    bank: Array,
    ints: Indices,
    numbers: Array,
    lanes: Array,
    n: int,
    nav: Array,
    xi: Array,
    step: Array,
    published: Array,
    mounting: Array,
    work: Array,
    wider: Array,
    found: Array,
) -> None:
    """Judge what waits for it, before the `next_` of `aids`; what is open of what is published is
    said `later`, or now. Odds that nobody reads before they are others wait."""
    judge_what_waits(bank, ints, numbers, lanes, found)
    epoch_s = bank[UNJUDGED]
    if epoch_s < np.inf:
        if later and aids[next_, KIND] <= VELOCITY and not any_likely(bank, lanes):
            bank[UNJUDGED], bank[UNWEIGHED] = np.inf, epoch_s
        elif later:
            judge(bank, ints, numbers, lanes, epoch_s, found)
        else:
            judge_and_widen(
                *(bank, ints, numbers, lanes, n, epoch_s, True, True),
                *(nav, xi, step, published, mounting, work, wider, found),
            )


@compiled("b1(i8[:, ::1], i8, i8)")
def _said_later(ints: Indices, first: int, until_ns: int) -> bool:
    """True if one of the rows from `first` on is measured, applies in any state, and comes before
    `until_ns`."""
    for i in range(first, ints.shape[0]):
        if ints[i, T_NS] >= until_ns:
            return False
        if ints[i, KIND] <= VELOCITY:
            return True
    return False


@compiled(
    "i8(f8[::1], i8[::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], i8[:, ::1],"
    "f8[:, ::1], f8[::1], i8[::1], b1, f8[::1], i8[:, ::1], i8[::1], i8[::1], i8[::1], f8[:, ::1],"
    "f8[::1], f8[::1], f8[::1], f8[::1], f4[::1], f8[::1], f8[::1], f8[::1], f8[::1])",
    allocates=True,
)
def take_aid(
    x: Array,
    of: Indices,
    nav: Array,
    xi: Array,
    step: Array,
    cov: Array,
    dx: Array,
    bank: Array,
    ints: Indices,
    numbers: Array,
    lanes: Array,
    column_of: Indices,
    hold_height: bool,
    initial: Array,
    biases: Indices,
    gyros: Indices,
    lever: Indices,
    late: Indices,
    mounting: Array,
    published: Array,
    wider: Array,
    noise: Array,
    work: Array,
    of_rows: Single,
    bank_work: Array,
    knows: Array,
    found: Array,
    result: Array,
) -> int:
    """Fold in the aid of a row `x`, as integers `of`, at its instant; its series has that `noise`;
    write `result` (RESULT,). `DONE`, or `JUDGE`, or `OTHERWISE` with nothing done."""
    n, width, m = dx.shape[0], cov.shape[1], of[ROWS]
    p = cov[:n, :n]
    heading = cov[PHI + 2, PHI + 2]
    if knows[SETTLES] > 0.0:
        if knows[KNOWN] > 0.0 and heading > knows[LARGE]:
            return OTHERWISE
        if heading < knows[PLAIN]:
            knows[KNOWN] = 1.0
    measured, t_s = (of[ASKED] & MEASURED) != 0, of[T_NS] * 1e-9
    result[NIS], result[MOVES] = np.nan, 0.0
    if of[ASKED] & MOTION_ASKED:
        result[MOVES] = surely_moves(cov, nav, step, published, np.zeros(WIDER))
    y, z, r = work[_Y : _Y + m], work[_Z : _Z + m], work[_R : _R + m]
    before, h = work[_BEFORE:_H], work[_H : _H + m * n].reshape((m, n))
    g = work[_H + LENT_ROWS * n : _H + LENT_ROWS * n + m * width].reshape((m, width))
    applies = packed_rows(x, of, nav, xi, step, column_of, hold_height, initial, p, z, h, r)
    result[BECAME], knows[TURNED] = applies, 0.0
    if applies != APPLIES:
        return DONE
    for a in range(m):
        r[a] *= noise[a]
        result[INNOVATION + a] = z[a]
        for i in range(6):
            result[OF_STATE + 6 * a + i] = h[a, 3 + i]
    apart = lever.size > 0 or may_part(p, biases[0])
    if apart:
        remember_estimate(nav, xi, biases, gyros, lever, before)
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
    if apart:
        undoubted = knows[UNDOUBTED] > 0.0 and step[STEP_RESTS_S] == 0.0
        kept = gyros if undoubted else gyros[:0]
        turned = carry_over_all(p, before, nav, xi, biases, kept, lever, late)
        knows[TURNED] = turned
        at = int(bank[BANK_PHI])
        phi = bank[at : at + width * width].reshape((width, width))
        carry_over_rows(phi, before, nav, xi, turned, biases, kept, lever, late)
        bank[WAITS] = 1.0
        settle(bank, n)
    if not measured:
        judge_and_widen(
            *(bank, ints, numbers, lanes, n, t_s, False, True),
            *(nav, xi, step, published, mounting, bank_work, wider, found),
        )
        return DONE
    if bank[SUSPECTS] != 0.0:
        return JUDGE
    bank[UNJUDGED] = t_s
    learn(noise, t_s, y[0], y[1] if m > 1 else 0.0, y[2] if m > 2 else 0.0, m)
    return DONE


@cache
def run_for(width: int) -> Callable[..., tuple[int, int, int, int]]:
    """`run` for covariances of `width` rows."""
    propagate, square = propagate_for(width), width * width

    @compiled(
        "UniTuple(i8, 4)(f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], i8[:, ::1],"
        "f8[:, ::1], f8[::1], i8[::1], f8[::1], i8[:, ::1], i8[::1], i8[::1], i8[::1], f8[:, ::1],"
        "f8[::1], f4[::1], f8[::1], f8[::1], f8[::1], i8, i8, i8, b1, b1, i8, i8)",
        variant=width,
        allocates=True,
    )
    def run(
        state: Array,
        imu: Array,
        aids: Array,
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
        late: Indices,
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
        """Run the filter over `aids` (k, SIZE) with the noise of their `series` (s, .), from `now`
        and the next `sample`, and on to the first that comes `every_ns` after the last checkpoint;
        next sample, new time, number of aids done and how it ended."""
        head = state[:LINE].view(np.int64)
        n, room = head[STATES], head[ROOM]
        wider, published = state[WIDER_AT : WIDER_AT + WIDER], state[PUBLISHED_AT:WIDER_AT]
        nav, step = state[NAV_AT:STEP_AT], state[STEP_AT:SUMS_AT]
        xi, dx = state[XI_AT : XI_AT + n], state[XI_AT + n : XI_AT + 2 * n]
        upto = XI_AT + n + room * n
        rest = state[(upto + LINE - 1) // LINE * LINE :]
        cov = rest[:square].reshape((width, width))
        bank = rest[room * square : room * square + head[BANK]]
        of_all = aids.view(np.int64)
        recorded, i = (options & RECORD) != 0, 0
        while i < aids.shape[0]:
            x, of = aids[i], of_all[i]
            later = not recorded and _said_later(of_all, i, kept_ns + every_ns)
            if of[T_NS] > now or passing:
                conclude(
                    *(later, i, of_all, bank, ints, numbers, lanes, n, nav, xi, step, published),
                    *(mounting, bank_work, wider, found),
                )
                sample, now = propagate(state, imu, sample, now, of[T_NS], options)
                passing = False
                if now - kept_ns >= every_ns:
                    return sample, now, i, KEEP
            if not of[ASKED] & MEASURED:
                conclude(
                    *(later, i, of_all, bank, ints, numbers, lanes, n, nav, xi, step, published),
                    *(mounting, bank_work, wider, found),
                )
            how = take_aid(
                *(x, of, nav, xi, step, cov, dx, bank, ints, numbers, lanes, column_of),
                *(hold_height, initial, biases, gyros, lever, late, mounting, published, wider),
                *(series[of[SERIES]], work, of_rows, bank_work, knows, found, results[i]),
            )
            if how == OTHERWISE:
                return sample, now, i, OTHERWISE
            i += 1
            if how == JUDGE:
                return sample, now, i, JUDGE
        return sample, now, i, DONE

    return run


for _width in WIDTHS:
    run_for(_width)


class Filter(Protocol):
    """State that a run moves on, of a filter beside its memory."""

    t_ns: int
    sample: int
    passing: bool
    turned: float
    kernel_options: int


class AidRun:
    """`run` of one filter: its memory, its bank and its axes, with what it `knows` (KNOWS,)."""

    def __init__(
        self,
        filter_: Filter,
        memory: Memory,
        model: Model,
        bank: Hypotheses,
        axes: Axes,
        knows: Array,
    ) -> None:
        work = np.zeros(_H + LENT_ROWS * (model.size + model.width))
        self._filter, self._memory, self._kernel = filter_, memory.array, run_for(model.width)
        self._given = (
            *(*bank.table[:3], model.column_of, model.initial, *axes),
            *(bank.mounting, work, bank.rows, bank.work, knows, bank.found),
        )
        self._hold_height, self._knows, self.bank = model.hold_height, knows, bank

    def __call__(
        self, imu: ImuBuffer, aids: Array, series: Array, record: bool, kept: tuple[int, int]
    ) -> Ran:
        """Fold in packed `aids` (k, SIZE) with the noise of their `series` (s, .), each at its
        instant; `kept`: when (ns) the last checkpoint was, and after what time the next is due."""
        f, results = self._filter, np.empty((len(aids), RESULT))
        options = f.kernel_options | (RECORD if record else 0)
        f.sample, f.t_ns, done, how = self._kernel(
            *(self._memory, imu.packed, aids, results, series, *self._given),
            *(f.sample, f.t_ns, options, self._hold_height, f.passing, *kept),
        )
        f.passing, f.turned = False, self._knows.item(TURNED)
        return Ran(done, how, results)
