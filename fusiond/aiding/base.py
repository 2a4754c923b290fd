r"""Interface of an aiding measurement: an innovation that is linear in the error state.

    z = h(x^) - y = H dx + v,   v ~ N(0, diag(r))

x^ the computed state, y the measured value, dx computed minus true
(fusiond.navigation.error_model). So a position row of z is "INS minus fix", as in the papers. H is
dense, (m, n).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from operator import attrgetter
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.aiding.heading_history import HeadingHistory
from fusiond.aiding.initialisation_candidates import Candidate
from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import gravity
from fusiond.navigation.rotation import dcm_from_quaternion, rotation_vector_to_quaternion
from fusiond.navigation.strapdown import HEIGHT, LAT, Q0, STEP_SMOOTH_N, VE, VN

Array = NDArray[np.float64]
Vector3 = tuple[float, float, float]
Feedback = Literal["at_once", "hold", "release"]
"""Time at which the error estimate is fed back into the navigation state: at once; held until a
measurement releases it; or now, with everything held."""
POSITION, VELOCITY, NO_SLIP, SPEED = range(1, 5)
"""Kinds of packed rows; positions and velocities always apply."""
LENT_ROWS = 3
"""Largest number of rows whose innovations go into the filter's own memory, for nearly all
measurements."""


@compiled("f8(f8[::1])")
def speed_of(nav: Array) -> float:
    """Horizontal speed (m/s) of a state (10,)."""
    return math.hypot(nav[VN], nav[VE])


class Innovation(NamedTuple):
    """z (m,), H (m, n), r (m,) variances of uncorrelated noise."""

    z: Array
    h: Array
    r: Array

    @staticmethod
    def unwritten(rows: int, size: int) -> Innovation:
        """Unwritten innovation of so many rows and states, for a measurement to fill."""
        return Innovation(np.empty(rows), np.empty((rows, size)), np.empty(rows))


class State(NamedTuple):
    """View of the filter for a measurement: navigation state (10,), parameters (n,), last step
    (28,), model, and the filter's own P (n, n), None if the state is not a filter's (a sigma point,
    the truth). `lent`: arrays of the filter for innovations, by number of rows, valid until the
    next innovation."""

    nav: Array
    xi: Array
    step: Array
    model: Model
    covariance: Array | None = None
    lent: Mapping[int, Innovation] = MappingProxyType({})

    @property
    def dcm(self) -> Array:
        """C_nb (3, 3)."""
        return dcm_from_quaternion(self.nav[Q0:])

    @property
    def rate_b(self) -> Array:
        """Compensated angular rate (3,), rad/s, body axes, of the last step."""
        return self.step[3:6]

    @property
    def acceleration(self) -> Array:
        """North, east, down (3,), m/s^2: the mean over the last quarter of a second."""
        a = self.step[STEP_SMOOTH_N : STEP_SMOOTH_N + 3].copy()
        a[2] += gravity(self.nav[LAT], self.nav[HEIGHT])
        return a

    @property
    def speed(self) -> float:
        """Horizontal speed, m/s."""
        return speed_of(self.nav)


class Renewal(NamedTuple):
    """Partial renewal, at an instant, of errors that successive measurements share.

    The states t of the `blocks`, in units of their initial sigmas, become R t + w, with R `kept`
    and cov(w) `new` (k, k). A clone adds a part of the navigation errors: `of_navigation` (k, 9)
    times them, in the states' units, with its `estimate` (k,). `with_navigation`, A (9, k) and
    C (k, k), is noise of covariance C that the states take and, as A times it, the navigation
    errors."""

    blocks: tuple[str, ...]
    kept: Array
    new: Array
    of_navigation: Array | None = None
    estimate: Array | None = None
    with_navigation: tuple[Array, Array] | None = None


class Packed(NamedTuple):
    """Packed measurement: kind, number of rows of its innovation, body (fusiond.aiding.packed)."""

    kind: int
    rows: int
    body: bytes


class NotApplicable(NamedTuple):
    """Refusal of a measurement in this state; `outcome` is its name."""

    outcome: str


@immutable()
class AidingMeasurement:
    """Aiding measurement at its instant of validity, in SI units, body axes for `lever` (3,).

    `gate` is the probability with which a consistent innovation passes. Timeline, navigator,
    verdicts and alignment use this interface alone and know no kind of measurement by name.
    """

    screened: ClassVar[bool] = False
    """True if its rows are gated one by one, so that a bad one is left out alone
    (fusiond.estimators.update_with_exclusion)."""
    period: ClassVar[float] = math.inf
    """Period of an innovation that is an angle."""
    locates: ClassVar[bool] = False
    """True if it bounds the horizontal position, which ends coasting."""
    moves: ClassVar[bool] = False
    """True if it bounds the horizontal velocity."""
    rolls: ClassVar[bool] = False
    """True if it measures a speed along the vehicle."""
    constraint: ClassVar[bool] = False
    """True for a constraint of the vehicle's motion instead of a measurement: its innovations are
    neither independent nor white and allow no verdict on a sigma."""
    no_slip: ClassVar[bool] = False
    """True if it holds while the vehicle moves the way it faces. Repeated refusals mean a slide, a
    wrong attitude or a wrong IMU mounting."""
    shown: ClassVar[attrgetter[Any] | None] = None
    """Value that a frozen sensor repeats to the bit; by default of the first of `candidates`."""
    waits: ClassVar[bool] = False
    """True if its `feedback` may be held."""
    placed: ClassVar[bool] = False
    """True if its corrections depend on the position: it is applied as corrected by `at` for the
    filter's position."""
    delayed: ClassVar[bool] = False
    """True if it arrives seldom and long after its instant, as a requested one does."""

    source: str
    t_ns: int
    gate: float
    robust: bool = field(default=False, kw_only=True)
    """Rows with large residuals weigh less (fusiond.estimators.robust)."""

    @property
    def device(self) -> str:
        """Device of the measurement; its positions and velocities may have different sources."""
        return self.source

    @property
    def rests_s(self) -> float:
        """Duration (s) of rest that this measurement proves."""
        return 0.0

    @property
    def shares(self) -> tuple[str, ...]:
        """Blocks of the model for errors that successive measurements share."""
        return ()

    @property
    def remembers(self) -> bool:
        """True if its innovation depends on an instant of which the state keeps a clone: the
        difference of clone and position is known to more digits than either."""
        return False

    @property
    def renewal(self) -> Renewal | None:
        """Change of the shared errors at the measurement's instant."""
        return None

    def leaves(self, state: State, codes: Sequence[int]) -> Renewal | None:
        """Clone of `state` for the next measurement, after the filter has given `codes` to its
        rows."""
        return None

    @property
    def feedback(self) -> Feedback:
        """Choice of when the estimate is fed back."""
        return "at_once"

    def packed(self, model: Model) -> Packed | None:
        """Row of numbers for a kernel's innovation (fusiond.aiding.packed); None without a
        kernel."""
        return None

    def at(self, nav: Array) -> AidingMeasurement:
        """Measurement corrected for the navigation state (10,) at its instant; the measurement
        itself, unless its corrections depend on the position."""
        return self

    def without_attitude(self, way: HeadingHistory) -> AidingMeasurement | None:
        """Measurement for a vehicle of unknown attitude, with a state that faces north and is
        level. Of a lever arm only the upward part is known, the rest is noise; `way` is the heading
        by other measurements. None where an attitude is required."""
        return None

    def innovation(self, state: State) -> Innovation | NotApplicable:
        """Innovation at `state`, or the name of its refusal."""
        raise NotImplementedError

    def judged(self, codes: Sequence[int], whitened: Sequence[float]) -> None:
        """Receive the outcomes of its rows, for a receiver that counts them
        (fusiond.estimators.update_with_exclusion); repeated after a rewind."""

    def candidates(self) -> Sequence[Candidate]:
        """Candidates for the start of alignment."""
        return ()

    def series(self, whitened: Sequence[float], codes: Sequence[int]) -> Mapping[str, Array]:
        """Innovation series of a screened measurement for the verdicts: by name, this epoch's row
        (m,). Other measurements have one series, named after their source.

        `whitened` (m,) the innovation as the filter found it, `codes` (m,) of its rows, 0 if used.
        """
        return {}


class Linearised(Protocol):
    """Interface of a measurement to an estimator."""

    @property
    def screened(self) -> bool: ...
    @property
    def period(self) -> float: ...
    @property
    def source(self) -> str: ...
    @property
    def t_ns(self) -> int: ...
    @property
    def gate(self) -> float: ...
    @property
    def robust(self) -> bool: ...
    @property
    def device(self) -> str: ...
    @property
    def locates(self) -> bool: ...
    @property
    def moves(self) -> bool: ...
    @property
    def rolls(self) -> bool: ...
    @property
    def constraint(self) -> bool: ...
    @property
    def no_slip(self) -> bool: ...
    @property
    def remembers(self) -> bool: ...
    @property
    def renewal(self) -> Renewal | None: ...
    def leaves(self, state: State, codes: Sequence[int]) -> Renewal | None: ...
    def innovation(self, state: State) -> Innovation | NotApplicable:
        """The innovation at `state`."""


def level_arm_m(lever: Vector3) -> float:
    """One sigma (m) of each horizontal axis of a lever arm of unknown direction."""
    return math.hypot(lever[0], lever[1]) / math.sqrt(2.0)


def rate_columns(h: Array, rows: slice, model: Model, per_rate: Array) -> None:
    """Write d(row)/d(rate error) (m, 3) into every block that is a rate error."""
    for axis in range(3):
        for slot in model.parameters(9 + axis):
            h[rows, slot] = per_rate[:, axis]


def misaligned_axes(state: State, block: str) -> tuple[Array, list[int]]:
    """Rotation C exp[m x] (3, 3) from a sensor's axes to navigation axes, and the slots of m.

    m (rad, body axes) turns the body's axes into the sensor's; it is the estimate of the block of
    that name. C and no slots if the model has no such block.
    """
    slots = state.model.slots_of(block) if block else []
    if not slots:
        return state.dcm, slots
    x, y, z = (float(state.xi[slot]) for slot in slots)
    turn = dcm_from_quaternion(np.array(rotation_vector_to_quaternion(x, y, z)))
    return state.dcm @ turn, slots
