"""Pseudorange measurement: geometry by hand, Jacobian numerically, clock slots, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, NotApplicable, State
from fusiond.aiding.carrier_anchor import CARRIER, CARRIER_VARIANCE, RATE, SPAN
from fusiond.aiding.pseudorange import NO_CLOCK, RANGE_SHARED, PseudorangeMeasurement, epoch_values
from fusiond.aiding.range_rows import UNUSED_VARIANCE
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.models.blocks import ClockNoise, carrier_blocks, clock_blocks, shared_error
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M
from fusiond.navigation.rotation import dcm_from_quaternion
from fusiond.navigation.strapdown import STEP_SIZE
from tests import runs

Array = NDArray[np.float64]

LEVER = (1.3, -0.4, -2.1)
RATE_SENSED = np.array([0.05, -0.03, 0.4])
RPY, VELOCITY = (0.08, -0.12, 2.3), (12.0, -7.0, 0.8)
AZIMUTHS = np.array([0.4, 1.9, 3.0, 4.1, 5.6])
CLOCK = ClockNoise()
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


# ---------------------------------------------------------------------- shared errors


def test_a_carrier_without_an_anchor_is_its_doppler_or_nothing() -> None:
    model = make_model("ins15", imu_noise(Imu()), *clock_blocks(("C", "G")), *carrier_blocks(CLOCK))
    nav = runs.level_nav(RPY, VELOCITY)
    measurement = _measurement(nav)
    measurement.values[SPAN], measurement.values[CARRIER], measurement.values[CARRIER_VARIANCE] = (
        0.5,
        7.0,
        1e-4,
    )
    found = _innovation(measurement, _state(model, nav, np.zeros(model.size)))
    assert found.r[5:].tolist() == [0.01, 0.02, 0.03, 0.04, 0.05]
    assert [what for _, what in measurement.labels][5:] == ["rate"] * 5
    measurement.values[RATE] = math.nan
    z, _, r = _innovation(measurement, _state(model, nav, np.zeros(model.size)))
    assert (z[5:] == 0.0).all()
    assert (r[5:] == UNUSED_VARIANCE).all()


def test_what_ranges_share_is_a_state_or_noise() -> None:
    nav = runs.level_nav(RPY, VELOCITY)
    measurement = _measurement(nav)
    measurement.values[10:13] = [[2.0] * 5, [0.0, 0.1, 0.2, 0.3, 0.4], [0.0, 0.0, 0.0, 0.0, 5.0]]
    shared = [shared_error(name, "", 1.0, math.inf) for name in RANGE_SHARED]
    model = make_model("ins15", imu_noise(Imu()), *clock_blocks(("C", "G")), *shared)
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
