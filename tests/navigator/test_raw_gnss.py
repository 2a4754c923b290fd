"""From raw epochs to measurements, health and verdicts: one receiver in the navigator and in
`process`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.measurements import MonotonicStamp, PositionFix
from drivers.raw.messages import SPEED_OF_LIGHT_M_S, RawGnssEpoch
from fusiond.aiding.initialisation_candidates import PositionCandidate, VelocityCandidate
from fusiond.aiding.pseudorange import RANGE_BIAS, epoch_values
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.schema import Config, Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.update_with_exclusion import GATED, KEPT, RESIDUAL
from fusiond.files.measurement_csv import read_solution, read_truth
from fusiond.gnss.ecef import ned_axes, to_ecef
from fusiond.models.blocks import CLOCK_OFFSET
from fusiond.models.catalogue import make_model
from fusiond.navigator.intake import Intake
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.raw_gnss import RawGnss
from fusiond.offline.compare import compare
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.gnss.raw import GnssRaw, GnssRawOptions
from fusiond.simulation.scenarios import CAR_IMU, SCENARIOS
from tests.runs import level_nav

LEVER = (0.0, 0.0, -1.0)
TRUTH = SCENARIOS["drive"].truth(20.0)


def receiver(**options: Any) -> GnssRaw:
    return GnssRaw(TRUTH, GnssRawOptions(rate_hz=1.0, **options), np.random.default_rng(4))


def informed(section: RawAiding | None = None, sim: GnssRaw | None = None) -> RawGnss:
    """A receiver's room that knows all ephemerides in view."""
    sim = sim or receiver()
    raw = RawGnss("raw", section or RawAiding())
    seen = {(s.system, s.prn) for s in sim.epoch(0).signals}
    for message in (*sim.broadcast(0.0, seen), *sim.ionosphere):
        raw.learn(message)
    return raw


def place(k: int) -> Any:
    return TRUTH.at(np.array([k + 1.0])).position[0]


def started(section: RawAiding) -> KalmanEstimator:
    """A filter at rest at the true place of epoch 0."""
    model = make_model("ins15", imu_noise(Imu()), *Intake({"raw": section}).extra_blocks())
    estimator = KalmanEstimator(model, Imu().gap_s)
    sigma = model.initial.copy()
    sigma[:9] = [0.01] * 2 + [0.05] + [0.1] * 3 + [5.0] * 3
    lat, lon, height = place(0)
    nav = level_nav((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    nav[:3] = lat, lon, height
    estimator.initialise(0, 0, nav, np.zeros(model.size), np.diag(sigma**2))
    return estimator


def off(estimator: KalmanEstimator) -> float:
    """Horizontal distance to the true place, m."""
    d = (estimator.nav[:2] - place(0)[:2]) * 6.37e6
    return float(np.hypot(d[0], d[1] * np.cos(place(0)[0])))


# --------------------------------------------------------------------------- epochs to measurements


def test_without_ephemerides_an_epoch_does_not_apply_and_says_why() -> None:
    epoch = receiver().epoch(0)
    deaf = RawGnss("raw", RawAiding())
    measurement = deaf.measurement(epoch, 0)
    outcome = started(RawAiding()).update(measurement.at(place(0)))
    assert outcome.name == "no_satellites"
    for _ in range(2):  # a rewind brings it again
        measurement.judged(outcome.rows, outcome.whitened)
    assert sum(deaf.refused.values()) == len(epoch.signals)
    assert set(deaf.refused) == {"G_no_ephemeris", "C_no_ephemeris"}
    assert set(deaf.sky().refused.values()) == {"no_ephemeris"}


def test_an_epoch_alone_starts_the_alignment() -> None:
    raw, sim = informed(), receiver()
    position, velocity = raw.measurement(sim.epoch(0), 7).candidates()
    assert isinstance(position, PositionCandidate)
    assert isinstance(velocity, VelocityCandidate)
    assert (position.t_ns, velocity.t_ns) == (7, 7)
    lat, lon, height = place(0)
    assert abs(position.lat_rad - lat) * 6.37e6 < 5.0 * position.sd[0]
    assert abs(position.lon_rad - lon) * 6.37e6 < 5.0 * position.sd[1]
    assert position.height_m is not None
    assert abs(position.height_m - height) < 5.0 * position.sd[2]
    # Its errors last: the ranges that follow displace by the same.
    ranges = raw.measurement(sim.epoch(0), 9).at(place(0))
    assert position.bias == RANGE_BIAS
    assert np.array(position.bias_share) == pytest.approx(ranges.shape, abs=0.05)
    few = replace(sim.epoch(1), signals=sim.epoch(1).signals[:3])
    assert raw.measurement(few, 8).candidates() == []
    assert raw.refused["too_few"] == 1


def test_options() -> None:
    epoch = receiver().epoch(0)
    usual = informed().measurement(epoch, 0).at(place(0))
    wide = informed(RawAiding(sigma_scale=2.0)).measurement(epoch, 0).at(place(0))
    four = informed(RawAiding(best_four=True)).measurement(epoch, 0).at(place(0))
    gps = informed(RawAiding(systems=("G",))).measurement(epoch, 0).at(place(0))
    high = informed(RawAiding(elevation_mask_deg=40.0)).measurement(epoch, 0).at(place(0))
    assert wide.range_variance == pytest.approx(4.0 * usual.range_variance)
    assert wide.rate_variance == pytest.approx(4.0 * usual.rate_variance)
    assert len(four.satellites) == 4
    assert {s[0] for s in gps.satellites} == {"G"}
    assert 0 < len(high.satellites) < len(usual.satellites)


# --------------------------------------------------------------------------- health and verdicts


def test_sky_names_every_satellite() -> None:
    sim = receiver()
    raw = informed(sim=sim)
    epoch = sim.epoch(0)
    epoch_measurement = raw.measurement(epoch, 0)
    measurement = epoch_measurement.at(place(0))
    n = len(measurement.satellites)
    codes = [KEPT] * (2 * n)
    codes[0], codes[1], codes[n + 2] = GATED, RESIDUAL, GATED
    epoch_measurement.judged(codes, (0.5,) * (2 * n))
    sky = raw.sky()
    assert set(sky.used) | set(sky.refused) == {s.satellite for s in epoch.signals}
    assert not set(sky.used) & set(sky.refused)
    first, second, third = measurement.satellites[:3]
    assert (sky.refused[first], sky.refused[second]) == ("gated", "residual")
    assert third in sky.used, "its range is used, its rate is not"
    assert sky.innovation_rms == pytest.approx(0.5)
    assert sky.dops is not None
    assert 0.4 < sky.dops.hdop < 3.0
    assert sky.seen.keys() == {s.satellite for s in epoch.signals}
    strongest = max(s.cno_db_hz or 0.0 for s in epoch.signals if s.satellite == first)
    mask_rad = math.radians(RawAiding().elevation_mask_deg)
    azimuth, elevation, cno = sky.seen[first]
    assert azimuth is not None
    assert elevation is not None
    assert mask_rad <= elevation <= 0.5 * math.pi
    assert cno == strongest
    # East and up of the line to it, from the receiver that was assumed.
    sight = measurement.position[0] - np.array(to_ecef(*place(0)[:3]))
    axes = ned_axes(*place(0)[:2])
    north, east, down = axes.T @ (sight / np.linalg.norm(sight))
    assert math.atan2(east, north) == pytest.approx(azimuth, abs=1e-3)
    assert -down == pytest.approx(math.sin(elevation), abs=1e-3)
    assert raw.refused[f"{first[0]}_range_gated"] == 1
    assert raw.refused[f"{second[0]}_range_residual"] == 1
    assert raw.refused[f"{third[0]}_rate_gated"] == 1


def test_an_epoch_refused_as_a_whole_names_its_satellites() -> None:
    raw = informed()
    epoch_measurement = raw.measurement(receiver().epoch(0), 0)
    measurement = epoch_measurement.at(place(0))
    epoch_measurement.judged((GATED,) * (2 * len(measurement.satellites)), ())
    sky = raw.sky()
    assert sky.used == ()
    assert {sky.refused[s] for s in measurement.satellites} == {"gated"}


def test_figures_of_a_system_are_standard_normal() -> None:
    rng = np.random.default_rng(2)
    raw = informed()
    measurement = raw.measurement(receiver().epoch(0), 0).at(place(0))
    rows = 2 * len(measurement.satellites)
    figures = []
    for _ in range(4000):
        codes = np.where(rng.random(rows) < 0.05, GATED, KEPT)
        whitened = np.where(codes == KEPT, rng.standard_normal(rows), 0.0)
        found = measurement.series(whitened.tolist(), codes.tolist())
        figures.append([*found["G"], *found["C"]])
    covariance = np.cov(np.array(figures).T)
    assert covariance == pytest.approx(np.eye(4), abs=0.1)


def test_a_system_without_rates_has_no_figure() -> None:
    raw = informed()
    measurement = raw.measurement(receiver().epoch(0), 0).at(place(0))
    rates = np.where([s[0] == "G" for s in measurement.satellites], np.nan, measurement.rates)
    variances = measurement.range_variance, measurement.rate_variance
    values = epoch_values(
        measurement.position, measurement.velocity, measurement.ranges, rates, *variances
    )
    silent = replace(measurement, values=values)
    rows = len(silent.labels)
    found = silent.series((1.0,) * rows, (0,) * rows)
    assert set(found) == {"C"}


# --------------------------------------------------------------------------- in the filter


def moved(epoch: RawGnssEpoch, metres: float, satellites: set[str] | None = None) -> RawGnssEpoch:
    signals = tuple(
        replace(s, pseudorange_m=s.pseudorange_m + metres)
        if satellites is None or s.satellite in satellites
        else s
        for s in epoch.signals
    )
    return replace(epoch, signals=signals)


def test_a_clock_set_by_a_millisecond_moves_nothing_but_the_clock() -> None:
    sim, section = receiver(clock_drift_constant_sd_m_s=0.0, clock_drift_sd_m_s=1e-3), RawAiding()
    for flagged in (True, False):
        raw, estimator = informed(section, sim), started(section)
        epoch = sim.epoch(0)
        for _ in range(3):
            measurement = raw.measurement(epoch, 0).at(estimator.nav)
            assert estimator.update(measurement).name == "fused"
        offset = estimator.xi[estimator.model.slots_of(CLOCK_OFFSET)].copy()
        before = off(estimator)
        jump = SPEED_OF_LIGHT_M_S * 1e-3
        set_clock = replace(moved(epoch, jump), clock_reset=flagged)
        measurement = raw.measurement(set_clock, 0).at(estimator.nav)
        outcome = estimator.update(measurement)
        assert outcome.name == "fused"
        assert set(outcome.rows) == {KEPT}
        assert off(estimator) == pytest.approx(before, abs=0.5)
        heard = [0, 2]  # GPS and BeiDou of G, E, C
        after = estimator.xi[estimator.model.slots_of(CLOCK_OFFSET)]
        assert (after - offset)[heard] == pytest.approx([jump, jump], abs=5.0)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_fewer_than_four_satellites_help(count: int) -> None:
    """Each takes off variance along its line, none makes the place worse."""
    sim, section = receiver(), RawAiding()
    raw, estimator = informed(section, sim), started(section)
    epoch = sim.epoch(0)
    for _ in range(3):  # clocks are known from a fuller sky
        measurement = raw.measurement(epoch, 0).at(estimator.nav)
        estimator.update(measurement)
    for slot in range(6, 9):
        estimator.covariance[slot, slot] += 20.0**2
    before = estimator.sigmas()[:3].copy()
    measurement = raw.measurement(replace(epoch, signals=epoch.signals[:count]), 0).at(
        estimator.nav
    )
    outcome = estimator.update(measurement)
    assert (outcome.name, outcome.degrees) == ("fused", 2 * count)
    after = estimator.sigmas()[:3]
    assert (after < before).all()
    assert (after**2).sum() < (before**2).sum() - count * 10.0**2
    assert off(estimator) < 5.0


def test_one_bad_satellite_is_refused_alone() -> None:
    sim, section = receiver(), RawAiding()
    raw, estimator = informed(section, sim), started(section)
    epoch = sim.epoch(0)
    for _ in range(3):
        measurement = raw.measurement(epoch, 0).at(estimator.nav)
        estimator.update(measurement)
    bad = epoch.signals[2].satellite
    epoch_measurement = raw.measurement(moved(epoch, 80.0, {bad}), 0)
    measurement = epoch_measurement.at(estimator.nav)
    outcome = estimator.update(measurement)
    left_out = [label for label, code in zip(measurement.labels, outcome.rows, strict=True) if code]
    assert left_out == [(bad, "range")]
    epoch_measurement.judged(outcome.rows, outcome.whitened)
    assert set(raw.sky().refused) >= {bad}


def test_fixes_or_ranges_of_a_receiver_never_both() -> None:
    """The one line: `kind` of the section."""
    fix = PositionFix("gnss", 0, MonotonicStamp(0), 0.5, 2.0, 30.0)
    epoch = replace(receiver().epoch(0), source="gnss")
    for kind, refused in (("raw", "raw_is_used"), ("gnss", "raw_not_used")):
        navigator = Navigator(Config.model_validate({"aiding": {"gnss": {"kind": kind}}}))
        navigator.add(fix, 0)
        navigator.add(epoch, 0)
        assert navigator.outcome_watch.refused["gnss"][refused] == 1


# --------------------------------------------------------------------------- through `process`


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of 150 s of a simulated drive, with UBX."""
    folder = tmp_path_factory.mktemp("drive")
    simulate(SCENARIOS["drive"], folder, seed=3, duration_s=150.0, gnss_raw="ubx")
    return folder


def run(
    folder: Path, out: Path, *kinds: str, **estimator: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Result of `process` and errors after 20 s of navigation."""
    aiding = {kind: {"lever_arm_m": LEVER} for kind in ("gnss", "rdss", "raw")}
    config = {"imu": CAR_IMU, "aiding": aiding, "estimator": estimator}
    names = {"gnss": "gnss.csv", "rdss": "rdss.csv", "raw": "gnss.ubx"}
    measurements = [(kind, folder / names[kind]) for kind in kinds]
    result = process(Config.model_validate(config), folder / "imu.csv", measurements, out=out)
    return result, compare(read_solution(out), read_truth(folder / "truth.csv"), after_s=20.0)


@pytest.mark.parametrize("name", ["kalman", "unscented", "federated", "multiscale"])
def test_every_estimator_takes_ranges(name: str, drive: Path, tmp_path: Path) -> None:
    result, errors = run(drive, tmp_path / "s.csv", "raw", filter=name)
    assert result["mode"] == "navigating"
    assert result["sources"]["raw"]["fused"] > 400
    assert errors["horizontal_rms_m"] < 2.0
    assert errors["horizontal_inside_3_sigma"] > 0.98
    assert {"raw_G", "raw_C"} <= set(result["consistency"])


def test_fixes_ranges_and_rdss_together(drive: Path, tmp_path: Path) -> None:
    result, errors = run(drive, tmp_path / "s.csv", "gnss", "raw", "rdss")
    for source, least in (("gnss", 800), ("raw", 400), ("rdss", 5)):
        assert result["sources"][source]["fused"] > least
    assert errors["horizontal_rms_m"] < 0.5
    assert errors["horizontal_inside_3_sigma"] > 0.9  # sigma is 8 cm; 16 such drives: NEES 1.6 of 2


def test_a_planar_model_holds_the_height_and_states_no_sigma_for_it(
    drive: Path, tmp_path: Path
) -> None:
    result, errors = run(drive, tmp_path / "s.csv", "raw", model="planar15")
    assert result["mode"] == "navigating"
    assert errors["horizontal_rms_m"] < 5.0
    assert errors["horizontal_nees"] is not None
    assert errors["position_nees"] is None
    assert np.isnan(read_solution(tmp_path / "s.csv").sd_position[:, 2]).all()
