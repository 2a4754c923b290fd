"""Raw observations of the simulated receiver against the model that the filter uses, and masks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.raw.messages import SPEED_OF_LIGHT_M_S, Klobuchar
from fusiond.gnss.ecef import ned_axes, to_ecef
from fusiond.gnss.nominal_constellation import constellation, slots
from fusiond.gnss.ranges import RangeModel, RangeOptions
from fusiond.gnss.single_point import SinglePoint, single_point
from fusiond.gnss.store import EphemerisStore
from fusiond.simulation.gnss.masks import Mask, View, canyon, parse_mask, tunnel, wall_elevation
from fusiond.simulation.gnss.raw import (
    TRUE_ALPHA,
    TRUE_BETA,
    GnssRaw,
    GnssRawOptions,
)
from fusiond.simulation.gnss.raw_stream import GnssRawStream
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.scenarios import SCENARIOS

NOON = (2400, 100_800.0 + 4.5 * 3600.0)
"""Half past twelve over Wuhan, where the ionosphere is thickest an hour and a half later."""
QUIET = GnssRawOptions(
    rate_hz=1.0, elevation_deg=12.0, pseudorange_sd_m=0.0, range_rate_sd_m_s=0.0, carrier_sd_m=0.0,
    multipath_sd_m=0.0, signal_in_space_sd_m=0.0, wet_delay_sd_m=0.0, inter_system_sd_m=0.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def moving() -> Truth:
    return SCENARIOS["drive"].truth(130.0)


def model_of(receiver: GnssRaw, *, perfect: bool = False) -> RangeModel:
    """What a receiver knows; `perfect`: unrounded ephemerides, and GPS tells the true ionosphere.

    Rounding alone is up to 7 cm each in the clock and the group delay of GPS.
    """
    store = EphemerisStore()
    systems = receiver.options.systems
    everything = {(slot.system, slot.prn) for slot in slots(systems)}
    exact = constellation(*receiver.start, systems)
    for e in exact if perfect else receiver.broadcast(0.0, everything):
        store.add(e)
    for model in receiver.ionosphere:
        store.add(model)
    if perfect:
        store.add(Klobuchar("x", 0, "G", TRUE_ALPHA, TRUE_BETA))
    return RangeModel(store, RangeOptions(cno_mask_db_hz=0.0))


def antenna(truth: Truth, t_s: float) -> tuple[np.ndarray, np.ndarray]:
    state = truth.at(np.array([t_s]))
    lat, lon, height = (float(x) for x in state.position[0])
    return np.array(to_ecef(lat, lon, height)), ned_axes(lat, lon) @ state.v_ned[0]


def test_without_errors_the_filters_model_explains_gps_to_a_centimetre(moving: Truth) -> None:
    options = replace(QUIET, signals=(("G", "1C"),))
    receiver = GnssRaw(moving, options, np.random.default_rng(1), NOON)
    model = model_of(receiver, perfect=True)
    for k in (0, 90, 120):
        t = float(receiver.t_s[k]) - float(receiver.clock_m[k]) / SPEED_OF_LIGHT_M_S
        r, v = antenna(moving, t)
        rows = model.rows(receiver.epoch(k), r)
        assert len(rows.satellites) >= 5
        left = rows.pseudorange_m - rows.range_m - receiver.clock_m[k]
        assert np.abs(left).max() < 0.01
        rate = np.einsum("ij,ij->i", rows.line_of_sight, rows.velocity - v)
        assert np.abs(rows.rate_m_s - rate - receiver.clock_drift_m_s[k]).max() < 1e-3


def test_beidou_is_left_with_its_ionosphere_and_offset(moving: Truth) -> None:
    options = replace(QUIET, inter_system_sd_m=5.0)
    receiver = GnssRaw(moving, options, np.random.default_rng(2), NOON)
    rows = model_of(receiver).rows(receiver.epoch(9), antenna(moving, 10.0)[0])
    beidou = np.array([name.startswith("C") for name in rows.satellites])
    assert np.count_nonzero(beidou) >= 8
    left = rows.pseudorange_m - rows.range_m - receiver.clock_m[9]
    left -= np.where(beidou, receiver.inter_system_m["C"], 0.0)
    # Different models of the same ionosphere: noticeable, but less than the delay itself.
    assert 0.5 < np.abs(left).max() < 0.6 * rows.ionosphere_m.max()


def test_single_points_of_a_noisy_drive_lie_around_the_truth(moving: Truth) -> None:
    options = GnssRawOptions(rate_hz=1.0)
    receiver = GnssRaw(moving, options, np.random.default_rng(3), (2400, 57_600.0))
    model = model_of(receiver)
    errors, velocity = [], []
    for k in range(len(receiver)):
        solved = single_point(model, receiver.epoch(k))
        assert isinstance(solved, SinglePoint)
        r, v = antenna(moving, float(receiver.t_s[k]))
        lat, lon, _ = moving.at(receiver.t_s[k : k + 1]).position[0]
        axes = ned_axes(float(lat), float(lon))
        errors.append(axes.T @ (solved.position - r))
        assert solved.velocity is not None
        velocity.append(axes.T @ (solved.velocity - v))
    assert np.sqrt(np.mean(np.square(errors), axis=0))[:2].max() < 2.0
    assert np.abs(np.mean(velocity, axis=0)).max() < 0.02
    assert 0.01 < np.std(velocity, axis=0)[:2].max() < 0.1


def test_carrier_and_rate_belong_to_the_pseudorange() -> None:
    """Over a second at rest the carrier moves by the mean of the rates."""
    receiver = GnssRaw(SCENARIOS["static"].truth(110.0), QUIET, np.random.default_rng(4), NOON)
    a, b = ({s.satellite: s for s in receiver.epoch(k).signals} for k in (99, 100))
    step = receiver.clock_m[100] - receiver.clock_m[99]
    drift = 0.5 * (receiver.clock_drift_m_s[99] + receiver.clock_drift_m_s[100])
    for name in a.keys() & b.keys():
        wavelength = SPEED_OF_LIGHT_M_S / (1_561_098_000.0 if name[0] == "C" else 1_575_420_000.0)
        moved = (b[name].carrier_cycles - a[name].carrier_cycles) * wavelength  # type: ignore[operator]
        mean = 0.5 * (a[name].range_rate_m_s + b[name].range_rate_m_s)  # type: ignore[operator]
        assert moved - step == pytest.approx(mean - drift, abs=0.002)


def test_the_clock_is_set_by_whole_milliseconds() -> None:
    truth = SCENARIOS["static"].truth(100.0)
    options = replace(QUIET, clock_offset_sd_m=0.0, clock_drift_constant_sd_m_s=30_000.0)
    receiver = GnssRaw(truth, options, np.random.default_rng(5))
    resets = [k for k in range(1, len(receiver)) if receiver.epoch(k).clock_reset]
    jumps = np.abs(np.diff(receiver.clock_m)) > 0.5e-3 * SPEED_OF_LIGHT_M_S
    assert resets == (np.flatnonzero(jumps) + 1).tolist()
    assert resets
    assert np.abs(receiver.clock_m).max() <= 0.5e-3 * SPEED_OF_LIGHT_M_S


def test_same_seed_same_epochs(moving: Truth) -> None:
    a, b = (
        GnssRaw(moving, GnssRawOptions(rate_hz=1.0), np.random.default_rng(6)) for _ in range(2)
    )
    assert a.epoch(7) == b.epoch(7)
    b.begin(2401, 0.0)
    assert b.epoch(7).week == 2401


# --------------------------------------------------------------------------- masks


def test_a_sky_may_be_that_of_another_time(moving: Truth) -> None:
    """To the millimetre that a toe on another grid, and the rounding of an angle, leave."""
    early, late = (GnssRaw(moving, QUIET, np.random.default_rng(6)) for _ in range(2))
    late.begin(2437, 423_196.3, sky=early.start)
    assert late.gps_time(10.0) == (2437, 423_206.3)
    for k in (0, 100):
        for there, here in zip(early.sky(k)[:4], late.sky(k)[:4], strict=True):
            np.testing.assert_allclose(here, there, rtol=1e-9, atol=1e-4)
    satellites = {(slot.system, slot.prn) for slot in slots(("C", "G"))}
    told = late.broadcast(0.0, satellites)
    assert all(abs(e.toe_s - 423_196.3) <= 3614.0 for e in told)
    fix = single_point(model_of(late), late.epoch(0))
    assert isinstance(fix, SinglePoint)
    true, _ = antenna(moving, float(late.t_s[0]))
    assert float(np.linalg.norm(fix.position - true)) < 10.0


def counts(truth: Truth, *masks: Mask) -> np.ndarray:
    options = replace(QUIET, masks=masks)
    receiver = GnssRaw(truth, options, np.random.default_rng(1), NOON)
    return np.array([len(receiver.epoch(k).signals) for k in range(len(receiver))])


def test_windows_of_masks(moving: Truth) -> None:
    n = counts(moving, tunnel(20.0, 10.0), canyon(3, 60.0, 40.0), canyon(2, 110.0, 5.0))
    t = np.arange(1, len(n) + 1)
    in_tunnel, in_three, in_two = (
        (t >= 20) & (t < 30),
        (t >= 60) & (t < 100),
        (t >= 110) & (t < 115),
    )
    assert set(n[in_tunnel]) == {0}
    assert set(n[in_three]) == {3}
    assert set(n[in_two]) == {2}
    assert n[~(in_tunnel | in_three | in_two)].min() >= 12


@pytest.mark.parametrize("satellites", [2, 3, 4])
def test_a_canyon_keeps_its_satellites(moving: Truth, satellites: int) -> None:
    options = replace(QUIET, masks=(canyon(satellites),))
    receiver = GnssRaw(moving, options, np.random.default_rng(1), NOON)
    seen = {tuple(s.satellite for s in receiver.epoch(k).signals) for k in range(len(receiver))}
    assert len(seen) == 1
    assert len(seen.pop()) == satellites


def test_walls_leave_the_street_and_the_zenith() -> None:
    azimuth = np.radians([0.0, 90.0, 180.0, 270.0, 90.0, 45.0])
    elevation = np.radians([15.0, 60.0, 15.0, 60.0, 75.0, 30.0])
    north = View(10.0, (Mask("canyon", wall_height=3.0),))
    seen, factor = north.visible(1.0, azimuth, elevation, heading_rad=0.0)
    assert seen.tolist() == [True, False, True, False, True, False]
    assert factor == 2.0
    # The street was entered heading north; a turn of the vehicle does not turn the houses.
    again, _ = north.visible(2.0, azimuth, elevation, heading_rad=1.5)
    assert again.tolist() == seen.tolist()
    east = View(10.0, (Mask("canyon", wall_height=3.0, street_deg=90.0),))
    seen, _ = east.visible(1.0, azimuth, elevation, heading_rad=0.0)
    assert seen.tolist() == [False, True, False, True, True, False]
    assert wall_elevation(np.array([math.pi / 2]), 1.0) == pytest.approx(math.radians(45.0))


def test_a_street_canyon_of_beidou_alone_leaves_few(moving: Truth) -> None:
    options = replace(QUIET, signals=(("C", "2I"),), masks=(canyon(),))
    receiver = GnssRaw(moving, options, np.random.default_rng(1), NOON)
    n = [len(receiver.epoch(k).signals) for k in range(0, len(receiver), 10)]
    assert min(n) >= 1
    assert max(n) <= 6


def test_satellite_that_sets_is_replaced() -> None:
    view = View(10.0, (canyon(2),))
    azimuth, high = np.zeros(4), np.radians([80.0, 70.0, 60.0, 50.0])
    first, _ = view.visible(0.0, azimuth, high, 0.0)
    assert first.tolist() == [True, True, False, False]
    sunk = high.copy()
    sunk[0] = 0.0
    second, _ = view.visible(1.0, azimuth, sunk, 0.0)
    assert second.tolist() == [False, True, True, False]
    third, _ = view.visible(2.0, azimuth, high, 0.0)
    assert third.tolist() == second.tolist()


def test_masks_as_text() -> None:
    assert parse_mask("canyon3:100:60") == canyon(3, 100.0, 60.0)
    assert parse_mask("canyon:1.5:2") == canyon(None, 1.5, 2.0)
    assert parse_mask("tunnel:10:20") == tunnel(10.0, 20.0)
    for bad in ("canyon", "canyon7:1:2", "cave:1:2", "tunnel:1"):
        with pytest.raises(ValueError):  # noqa: PT011 - float's own words serve
            parse_mask(bad)


def test_nmea_has_no_fix_where_the_sky_is_hidden() -> None:
    scenario = SCENARIOS["drive"].masked((canyon(3, 10.0, 5.0), canyon(4, 20.0, 5.0)))
    assert scenario.gnss.outages == ((10.0, 5.0),)
    assert len(scenario.gnss_raw.masks) == 2


# --------------------------------------------------------------------------- timing


def test_messages_come_at_the_pace_of_the_air(moving: Truth) -> None:
    receiver = GnssRaw(moving, QUIET, np.random.default_rng(1), (2400, 0.0))
    stream = GnssRawStream(receiver, "ubx", warm=False)
    blocks = []
    for k in range(60):
        before = stream.counters["subframes"]
        stream.bytes_of(k)
        blocks.append(stream.counters["subframes"] - before)
    satellites = [s.satellite for s in receiver.epoch(0).signals]
    gps = sum(name[0] == "G" for name in satellites)
    geo = sum(name in {"C59", "C60", "C61"} for name in satellites)
    others = len(satellites) - gps - geo
    assert geo == 3
    # A minute holds two frames: GPS 3 subframes and page 18, D1 3 subframes, D2 ten pages.
    assert sum(blocks) == 2 * (4 * gps + 3 * others + 10 * geo)
    # Epoch k is at k + 1 s. GPS's four blocks of a frame end at 6, 12, 18 and 24 s; BeiDou's time
    # is 14 s behind: D1's three end at 20, 26 and 32 s, a page of D2 every 3 s, the first at 2 s.
    expected = np.zeros(60, dtype=int)
    for t in range(1, 61):
        expected[t - 1] += gps * (t % 30 in {6, 12, 18, 24})
        expected[t - 1] += others * (t % 30 in {20, 26, 2}) + geo * (t % 3 == 2)
    assert blocks == expected.tolist()
    warm = GnssRawStream(receiver, "ubx")
    warm.bytes_of(0)
    assert warm.counters["subframes"] == 4 * gps + 3 * others + 10 * geo
