"""Pseudorange measurement: geometry by hand, Jacobian numerically, clock slots, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, NotApplicable, State
from fusiond.aiding.pseudorange import (
    CARRIER_CLOCK,
    NO_CLOCK,
    RANGE_SHARED,
    PseudorangeMeasurement,
    epoch_values,
    nothing_left,
)
from fusiond.aiding.range_rows import UNUSED_VARIANCE
from fusiond.configuration.schema import Imu
from fusiond.configuration.settings import imu_noise
from fusiond.estimators.invariant_error import turn_step
from fusiond.models.blocks import clock_blocks, shared_error
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M
from fusiond.navigation.rotation import dcm_from_quaternion
from fusiond.navigation.strapdown import STEP_SIZE, strapdown_step
from tests import runs

Array = NDArray[np.float64]

LEVER = (1.3, -0.4, -2.1)
RATE_SENSED = np.array([0.05, -0.03, 0.4])
RPY, VELOCITY = (0.08, -0.12, 2.3), (12.0, -7.0, 0.8)
AZIMUTHS = np.array([0.4, 1.9, 3.0, 4.1, 5.6])
ELEVATIONS = np.array([0.2, 0.7, 1.3, 0.5, 0.9])


def _model(name: str, clocks: tuple[str, ...] = ("C", "G")) -> Model:
    return make_model(name, imu_noise(Imu()), *clock_blocks(clocks))


def _ecef(nav: Array) -> tuple[Array, Array]:
    """ECEF position (3,) and the matrix (3, 3) of the NED axes in it."""
    lat, lon, height = nav[:3]
    sl, cl, so, co = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    n = SEMI_MAJOR_M / math.sqrt(1.0 - ECCENTRICITY_SQUARED * sl * sl)
    p = [(n + height) * cl * co, (n + height) * cl * so]
    axes = [[-sl * co, -so, -cl * co], [-sl * so, co, -cl * so], [cl, 0.0, -sl]]
    return np.array([*p, (n * (1.0 - ECCENTRICITY_SQUARED) + height) * sl]), np.array(axes)


def _state(model: Model, nav: Array, xi: Array) -> State:
    step = np.zeros(STEP_SIZE)
    for axis in range(3):
        step[3 + axis] = RATE_SENSED[axis] - sum(xi[s] for s in model.parameters(9 + axis))
    return State(nav, xi, step, model)


def _truth(nav: Array, rate_b: Array, s: Array, s_dot: Array) -> tuple[Array, Array]:
    """Ranges and rates by vectors in ECEF axes."""
    p, axes = _ecef(nav)
    dcm = dcm_from_quaternion(nav[6:])
    antenna = p + axes @ dcm @ LEVER
    moving = axes @ (nav[3:6] + dcm @ np.cross(rate_b, LEVER))
    delta = s - antenna
    rho = np.linalg.norm(delta, axis=1)
    return rho, np.sum(delta / rho[:, None] * (s_dot - moving), axis=1)


def _satellites(nav: Array) -> tuple[Array, Array]:
    p, axes = _ecef(nav)
    ce = np.cos(ELEVATIONS)
    unit = np.column_stack([ce * np.cos(AZIMUTHS), ce * np.sin(AZIMUTHS), -np.sin(ELEVATIONS)])
    rng = np.random.default_rng(3)
    return p + 2.5e7 * unit @ axes.T, rng.normal(0.0, 2000.0, (len(unit), 3))


def _measurement(
    nav: Array, clock: object = (0, 0, 1, 1, 0), off: float = 0.0
) -> PseudorangeMeasurement:
    s, s_dot = _satellites(nav)
    ranges, rates = _truth(nav, RATE_SENSED, s, s_dot)
    names = ("C19", "C20", "G01", "G02", "C59")
    return PseudorangeMeasurement(
        "raw",
        0,
        0.999,
        names,
        epoch_values(
            s,
            s_dot,
            ranges + off,
            rates + off,
            np.arange(1.0, 6.0),
            np.arange(1.0, 6.0) * 0.01,
        ),
        np.array(clock),
        LEVER,
    )


def _innovation(measurement: PseudorangeMeasurement, state: State) -> Innovation:
    found = measurement.innovation(state)
    assert isinstance(found, Innovation)
    return found


def test_predicts_what_vectors_in_ecef_axes_say() -> None:
    model = _model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    measurement = _measurement(nav, off=-2.5)
    z, _, r = _innovation(measurement, _state(model, nav, np.zeros(model.size)))
    assert z == pytest.approx(2.5, abs=3e-8)  # a unit in the last place of 2.5e7 m is 4e-9
    assert r.tolist() == [1, 2, 3, 4, 5, 0.01, 0.02, 0.03, 0.04, 0.05]


@pytest.mark.parametrize("name", ["ins15", "ins23", "planar15"])
def test_jacobian(name: str) -> None:
    """Against central differences. Attitude steps of 1e-3 rad: cancellation in a range of 2.5e7 m
    leaves 4e-6, curvature of the lever arm 4e-7; 3e-7 m/m from the curve of the Earth."""
    model = _model(name)
    nav = runs.level_nav(RPY, (*VELOCITY[:2], 0.0) if model.hold_height else VELOCITY)
    measurement = _measurement(nav)
    xi = np.zeros(model.size)
    h = _innovation(measurement, _state(model, nav, xi)).h
    for k in np.flatnonzero(model.active):
        size = 10.0 if 6 <= k < 9 else 1e-3
        ends = []
        for sign in (1.0, -1.0):
            error = np.zeros(model.size)
            error[k] = sign * size
            off = runs.with_error(nav, error[:9])
            ends.append(
                _innovation(measurement, _state(model, off, np.r_[np.zeros(9), -error[9:]])).z
            )
        numeric = (ends[0] - ends[1]) / (2.0 * size)
        assert numeric[:5] == pytest.approx(h[:5, k], abs=1e-5), k
        # A rate changes by 1e-4 (m/s)/m with the place: a sixth digit of that, and 1e-8 (m/s)/m
        # of the lever arm's rate as the axes turn.
        assert numeric[5:] == pytest.approx(h[5:, k], abs=2e-8 if 6 <= k < 9 else 1e-5), k
    assert not h[:, ~model.active].any()


def test_each_range_has_its_system_s_offset() -> None:
    model = _model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    xi = np.zeros(model.size)
    offsets, (drift,) = model.slots_of("clock_offset"), model.slots_of("clock_drift")
    xi[offsets], xi[drift] = [100.0, 200.0], 3.0
    z, h, _ = _innovation(_measurement(nav), _state(model, nav, xi))
    assert z == pytest.approx([100, 100, 200, 200, 100, *[3.0] * 5], abs=1e-4)
    assert h[:5, offsets].tolist() == [[-1, 0], [-1, 0], [0, -1], [0, -1], [-1, 0]]
    assert h[5:, drift].tolist() == [-1.0] * 5


def test_without_a_clock_a_range_is_a_range() -> None:
    model = make_model("ins15", imu_noise(Imu()))
    nav = runs.level_nav(RPY, VELOCITY)
    z, h, _ = _innovation(
        _measurement(nav, [NO_CLOCK] * 5), _state(model, nav, np.zeros(model.size))
    )
    assert np.abs(z).max() < 1e-6
    assert not h[:5, 9:].any()


def test_what_is_not_measured_has_no_row() -> None:
    model = _model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    whole = _measurement(nav)
    state = _state(model, nav, np.zeros(model.size))
    ranges, rates = whole.ranges.copy(), whole.rates.copy()
    ranges[1], rates[[0, 1]] = math.nan, math.nan
    part = PseudorangeMeasurement(
        "raw",
        0,
        0.999,
        whole.satellites,
        epoch_values(
            whole.position,
            whole.velocity,
            ranges,
            rates,
            whole.range_variance,
            whole.rate_variance,
        ),
        whole.clock,
        LEVER,
    )
    rows = [0, 2, 3, 4, 7, 8, 9]
    expected, found = _innovation(whole, state), _innovation(part, state)
    for a, b in zip(expected, found, strict=True):
        assert a[rows].tolist() == b.tolist()
    assert part.labels == [whole.labels[k] for k in rows]
    assert part.only([True, True, False, False, False]).labels == [("C19", "range")]
    nothing = whole.only([False] * 5).innovation(state)
    assert nothing == NotApplicable("no_satellites")


def test_refusals() -> None:
    nav = runs.level_nav(RPY, VELOCITY)
    bare = make_model("ins15", imu_noise(Imu()))
    assert _measurement(nav).innovation(_state(bare, nav, np.zeros(bare.size))) == NotApplicable(
        "no_clock_state"
    )
    one = _model("ins15", ("C",))
    assert _measurement(nav).innovation(_state(one, nav, np.zeros(one.size))) == NotApplicable(
        "no_clock_state"
    )
    with pytest.raises(ValueError, match="with and without"):
        _measurement(nav, [0, NO_CLOCK, 0, 0, 0])
    with pytest.raises(ValueError, match="shape"):
        _measurement(nav, [0, 0])


# ---------------------------------------------------------------------- carriers, shared errors

SPAN_S = 0.5
FORCE = (0.6, -0.4, -9.7)


def _moved(
    error: Array, rate_b: Array, force_b: Array, turned: float = 0.0
) -> tuple[Array, Array, Array, Array]:
    """Navigation state and step at either end of `SPAN_S`, by an IMU of 100 Hz, of a vehicle whose
    heading is `turned` (rad)."""
    nav = runs.level_nav((RPY[0], RPY[1], RPY[2] + turned), VELOCITY)
    nav = runs.with_error(nav, error[:9])
    step, none = np.zeros(STEP_SIZE), np.zeros(3)
    strapdown_step(nav, rate_b, force_b, none, none, 0.01, False, step)
    begun = nav.copy(), step.copy()
    for _ in range(round(SPAN_S / 0.01)):
        strapdown_step(nav, rate_b, force_b, none, none, 0.01, False, step)
    return *begun, nav, step


def _model_with_carriers() -> Model:
    shared = [shared_error(name, "", 1.0, math.inf) for name in RANGE_SHARED]
    clock = shared_error(CARRIER_CLOCK, "", 1.0, 0.01)
    return make_model("ins15", imu_noise(Imu()), *clock_blocks(("C", "G")), *shared, clock)


def _by_carrier(
    model: Model,
    ends: tuple[Array, Array, Array, Array],
    rates: Array,
    s: Array,
    s_dot: Array,
    dopplers: Array | None = None,
    turned: tuple[float, Array] | None = None,
) -> Innovation:
    """Rows of an epoch whose rates are the carriers', with what the epoch before left; at a state
    that a filter has `turned` by psi, and its navigation state (10,) then."""
    nav_0, step_0, nav_1, step_1 = ends
    n = len(s)
    values = epoch_values(s, s_dot, np.full(n, np.nan), np.full(n, np.nan), np.ones(n), np.ones(n))
    values[13], values[14], values[15] = SPAN_S, rates, 1e-4
    if dopplers is not None:
        values[7] = dopplers
    clock, names = np.zeros(n, np.int64), tuple(f"G{k:02d}" for k in range(n))
    first = PseudorangeMeasurement("raw", 0, 0.999, names, values, clock, LEVER)
    first.innovation(State(nav_0, np.zeros(model.size), step_0, model))
    then = PseudorangeMeasurement(
        "raw", 0, 0.999, names, values, clock, LEVER, before=first.left, left=nothing_left()
    )
    if turned is not None:
        psi, nav_1 = turned
        step_1 = step_1.copy()
        turn_step(step_1, psi, then.remembered)
    return _innovation(then, State(nav_1, np.zeros(model.size), step_1, model))


@pytest.mark.parametrize("psi", [0.02, -0.5, 2.5])
def test_a_turned_heading_turns_what_the_carriers_go_by(psi: float) -> None:
    """A filter that asks what an epoch is were its heading another: as of a vehicle that had that
    heading all along, lever arm and what the IMU felt since the epoch before."""
    model = _model_with_carriers()
    ends = _moved(np.zeros(9), RATE_SENSED, np.array(FORCE))
    other = _moved(np.zeros(9), RATE_SENSED, np.array(FORCE), psi)
    s, s_dot = _satellites(ends[2])
    rates = np.zeros(len(s))
    expected = _by_carrier(model, other, rates, s, s_dot)
    found = _by_carrier(model, ends, rates, s, s_dot, None, (psi, other[2]))
    assert found.z == pytest.approx(expected.z, abs=1e-3)  # Coriolis of the other way
    assert found.h == pytest.approx(expected.h, abs=1e-3)
    # Half a second of 0.7 m/s^2, and a lever arm of 1.4 m, are otherwise metres a second off.
    without_attitude = _by_carrier(model, ends, rates, s, s_dot, None, (0.0, other[2]))
    assert np.abs(without_attitude.z - expected.z).max() > 0.5 * abs(math.sin(psi))


def test_rate_of_a_carrier_is_the_way_between_the_epochs() -> None:
    """Satellites at rest: the ranges' difference by vectors, over a vehicle that turns by 12 deg
    and speeds up; 2e-3 m/s are its own acceleration's curvature in a range of 2.5e7 m, and less."""
    model = _model_with_carriers()
    ends = _moved(np.zeros(9), RATE_SENSED, np.array(FORCE))
    s, _ = _satellites(ends[2])
    none = np.zeros_like(s)
    before, _ = _truth(ends[0], RATE_SENSED, s, none)
    now, _ = _truth(ends[2], RATE_SENSED, s, none)
    z, _, r = _by_carrier(model, ends, (now - before) / SPAN_S, s, none)
    assert np.abs(z).max() < 1e-4
    assert (r == 1e-4).all()


@pytest.mark.parametrize("beside", [False, True], ids=["alone", "beside Dopplers"])
def test_jacobian_of_a_carrier(beside: bool) -> None:
    """Errors of the state at the epoch's end, and of accelerometers, made by errors half a second
    before that the IMU has carried along."""
    model = _model_with_carriers()
    true = _moved(np.zeros(9), RATE_SENSED, np.array(FORCE))
    s, s_dot = _satellites(true[2])
    rates = np.zeros(len(s))
    dopplers = np.full(len(s), 3.0) if beside else None
    _, h, _ = _by_carrier(model, true, rates, s, s_dot, dopplers)
    for k in range(9):
        size = 10.0 if k >= 6 else 1e-3
        changes, states = [], []
        for sign in (1.0, -1.0):
            error = np.zeros(9)
            error[k] = sign * size
            ends = _moved(error, RATE_SENSED, np.array(FORCE))
            changes.append(_by_carrier(model, ends, rates, s, s_dot, dopplers).z)
            states.append(runs.nav_error(ends[2], true[2]))
        numeric = (changes[0] - changes[1]) / (2.0 * size)
        expected = h[:, :9] @ (states[0] - states[1]) / (2.0 * size)
        assert numeric == pytest.approx(expected, abs=1e-6 if k >= 6 else 3e-3), k
    # A force error stays where it is while the vehicle turns: here it does not.
    slow = np.zeros(3)
    true = _moved(np.zeros(9), slow, np.array(FORCE))
    _, h, _ = _by_carrier(model, true, rates, s, s_dot, dopplers)
    for axis, slot in enumerate(s for j in range(3) for s in model.parameters(12 + j)[:1]):
        changes, states = [], []
        for sign in (1.0, -1.0):
            force = np.array(FORCE)
            force[axis] += sign * 1e-2
            ends = _moved(np.zeros(9), slow, force)
            changes.append(_by_carrier(model, ends, rates, s, s_dot, dopplers).z)
            states.append(runs.nav_error(ends[2], true[2]))
        numeric = (changes[0] - changes[1]) / 2e-2
        expected = h[:, :9] @ (states[0] - states[1]) / 2e-2 + h[:, slot]
        assert numeric == pytest.approx(expected, abs=2e-3), axis


def test_dopplers_tell_what_the_clock_moved_beyond_its_drift() -> None:
    """Carriers that a clock's phase moved by 0.4 m/s more than Dopplers say: that is taken off, and
    what is left of it has the Dopplers' sigma, for three satellites as for many."""
    model = _model_with_carriers()
    ends = _moved(np.zeros(9), RATE_SENSED, np.array(FORCE))
    s, _ = _satellites(ends[2])
    s, none = s[:3], np.zeros((3, 3))
    before, _ = _truth(ends[0], RATE_SENSED, s, none)
    now, dopplers = _truth(ends[2], RATE_SENSED, s, none)
    found = _by_carrier(model, ends, (now - before) / SPAN_S + 0.4, s, none, dopplers)
    weight = 3.0 / (1.0 + 1e-4)  # the Dopplers here have 1 m/s, as has the clock beforehand
    assert found.z == pytest.approx(np.full(3, -0.4 / (1.0 + weight)), abs=1e-3)
    slot = model.slots_of_all((CARRIER_CLOCK,))
    assert found.h[:, slot] == pytest.approx(np.full((3, 1), -1.0 / math.sqrt(1.0 + weight)))


def test_a_carrier_without_the_epoch_before_says_nothing() -> None:
    """Of another start of the filter, or with no Doppler beside it."""
    model = _model_with_carriers()
    nav_0, step_0, nav_1, step_1 = _moved(np.zeros(9), RATE_SENSED, np.array(FORCE))
    s, s_dot = _satellites(nav_1)
    step_0[28] -= 3.0
    z, _, r = _by_carrier(model, (nav_0, step_0, nav_1, step_1), np.zeros(len(s)), s, s_dot)
    assert (z == 0.0).all()
    assert (r == UNUSED_VARIANCE).all()
    measurement = _measurement(nav_1)
    measurement.values[13], measurement.values[14], measurement.values[15] = SPAN_S, 7.0, 1e-4
    assert _innovation(measurement, _state(model, nav_1, np.zeros(model.size))).r[5:].tolist() == [
        0.01, 0.02, 0.03, 0.04, 0.05
    ]  # fmt: skip
    assert [what for _, what in measurement.labels][5:] == ["carrier"] * 5


def test_what_ranges_share_is_a_state_or_noise() -> None:
    nav = runs.level_nav(RPY, VELOCITY)
    measurement = _measurement(nav)
    measurement.values[10:13] = [[2.0] * 5, [0.0, 0.1, 0.2, 0.3, 0.4], [0.0, 0.0, 0.0, 0.0, 5.0]]
    model = _model_with_carriers()
    xi = np.zeros(model.size)
    slots = model.slots_of_all(RANGE_SHARED)
    xi[slots] = [0.5, -1.0, 2.0]
    z, h, r = _innovation(measurement, _state(model, nav, xi))
    assert z[:5] == pytest.approx([1.0, 0.9, 0.8, 0.7, 10.6], abs=1e-6)
    assert np.array_equal(h[:5, slots], -measurement.values[10:13].T)
    assert r[:5].tolist() == [1, 2, 3, 4, 5]
    plain = _model("ins15")
    r = _innovation(measurement, _state(plain, nav, np.zeros(plain.size))).r
    assert r[:5] == pytest.approx(measurement.total_variance)
    assert measurement.total_variance[4] == pytest.approx(5.0 + 4.0 + 0.16 + 25.0)
