"""What becomes of a star tracker's attitude and of a bearing at the navigator's door."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.measurements import Attitude, Bearing, MonotonicStamp, PositionFix
from fusiond.aiding.attitude import STAR_BLOCK, AttitudeMeasurement
from fusiond.aiding.landmark_bearing import SAR_BLOCK, BearingMeasurement
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.rdss_position import BIAS_BLOCK
from fusiond.configuration.aiding import (
    AnyAiding,
    AttitudeAiding,
    GnssAiding,
    RdssAiding,
    SarAiding,
)
from fusiond.configuration.aiding import StarTrackerAiding as Star
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import ARCSEC, DEG
from fusiond.navigator.intake import Intake
from fusiond.navigator.navigator import Navigator

NAN3 = (math.nan,) * 3
STAMP = MonotonicStamp(7)
POINTS = {"12": (30.6, 114.5, 60.0)}


def attitude(source: str, sd: tuple[float, float, float] = NAN3) -> Attitude:
    return Attitude(source, 0, STAMP, (0.1, 0.2, 0.3), sd)


def bearing(source: str = "sar", target: str = "12", **other: object) -> Bearing:
    given = {"azimuth_rad": 0.5, "elevation_rad": -0.1, "sd_rad": None, **other}
    return Bearing(source, 0, STAMP, target=target, **given)  # type: ignore[arg-type]


def one(
    aiding: dict[str, AnyAiding], m: Attitude | Bearing
) -> AttitudeMeasurement | BearingMeasurement:
    measurements = Intake(aiding).measurements_of(m, 7, 0.001)
    assert isinstance(measurements, list)
    (measurement,) = measurements
    assert isinstance(measurement, AttitudeMeasurement | BearingMeasurement)
    return measurement


def test_sigma_is_the_devices_or_the_configurations() -> None:
    star = Star(sd_arcsec=100.0, sigma_scale=2.0)
    assert one({"star_tracker": star}, attitude("star_tracker")).sd == (200.0 * ARCSEC,) * 3
    given = one({"star_tracker": star}, attitude("star_tracker", (1e-3, math.nan, 2e-3)))
    assert given.sd == (2e-3, 200.0 * ARCSEC, 4e-3)
    assert one({}, attitude("star_tracker")).sd == (200.0 * ARCSEC,) * 3
    sar = SarAiding(targets_deg_m=POINTS, sd_arcsec=50.0)
    assert one({"sar": sar}, bearing()).sd == (50.0 * ARCSEC,) * 2
    assert one({"sar": sar}, bearing(sd_rad=(1e-3, 2e-3))).sd == (1e-3, 2e-3)
    # An attitude that is no star tracker's has no default: its device must say.
    assert Intake({}).measurements_of(attitude("attitude"), 7, 0.0) == "no_sigma"
    assert Intake({"star_tracker": AttitudeAiding()}).measurements_of(
        attitude("star_tracker"), 7, 0.0
    ) == ("no_sigma")


def test_refusals_of_bearings() -> None:
    intake = Intake({"sar": SarAiding(targets_deg_m=POINTS)})
    assert intake.measurements_of(bearing(target="13"), 7, 0.0) == "unknown_target"
    assert intake.measurements_of(bearing(azimuth_rad=math.nan), 7, 0.0) == "not_finite"
    assert intake.measurements_of(bearing(sd_rad=(0.0, 1e-3)), 7, 0.0) == "no_sigma"
    known = one({"sar": SarAiding(targets_deg_m=POINTS)}, bearing())
    assert isinstance(known, BearingMeasurement)
    assert known.point == (30.6 * DEG, 114.5 * DEG, 60.0)
    told = one({}, bearing(target="13", point=(0.5, 1.9, 10.0)))
    assert isinstance(told, BearingMeasurement)
    assert told.point == (0.5, 1.9, 10.0)


def test_blocks_of_the_model() -> None:
    aiding: dict[str, AnyAiding] = {
        "rdss": RdssAiding(),
        "star_tracker": Star(misalignment_sd_arcsec=180.0),
        "port": Star(misalignment_sd_arcsec=60.0, misalignment_correlation_s=600.0),
        "calibrated": Star(misalignment_sd_arcsec=0.0),
        "sar": SarAiding(),
    }
    intake = Intake(aiding)
    blocks = {b.name: b for b in intake.extra_blocks()}
    assert list(blocks) == [BIAS_BLOCK, STAR_BLOCK, f"{STAR_BLOCK}_port", SAR_BLOCK]
    star, port = blocks[STAR_BLOCK], blocks[f"{STAR_BLOCK}_port"]
    assert (star.initial, star.steady, star.tau_s) == (180.0 * ARCSEC, 0.0, math.inf)
    assert (port.initial, port.steady, port.tau_s) == (60.0 * ARCSEC, 60.0 * ARCSEC, 600.0)
    # Each measurement names the block that the model has for it.
    for source, block in {
        "star_tracker": STAR_BLOCK,
        "port": f"{STAR_BLOCK}_port",
        "calibrated": "",
    }.items():
        assert one(aiding, attitude(source)).block == block
    assert one(aiding, bearing(sd_rad=None, point=(0.5, 1.9, 1.0))).block == SAR_BLOCK
    assert one(aiding, bearing("radar", point=(0.5, 1.9, 1.0))).block == SAR_BLOCK


def test_fixes_share_an_error_of_which_those_by_phase_have_a_part() -> None:
    aiding: dict[str, AnyAiding] = {
        "gnss": GnssAiding(bias_sd_m=1.5, bias_down_sd_m=4.0, bias_correlation_s=900.0),
        "front": GnssAiding(bias_sd_m=0.5),
        "white": GnssAiding(bias_sd_m=0.0),
    }
    intake = Intake(aiding)
    shared = (b for b in intake.extra_blocks() if "time" not in b.name and "skew" not in b.name)
    blocks = {b.name: b for b in shared}
    level, down = blocks["gnss_bias"], blocks["gnss_bias_down"]
    assert (level.states, level.steady, level.tau_s) == (("n", "e"), 1.5, 900.0)
    assert (down.states, down.steady, down.tau_s) == (("d",), 4.0, 900.0)
    assert set(blocks) == {
        *(f"gnss_bias{n}" for n in ("", "_down", "_front", "_front_down")),
        *(f"gnss_wander{n}" for n in ("", "_front")),
    }
    fix = PositionFix("gnss", 0, MonotonicStamp(7), 0.5, 1.9, 10.0, sd_ned_m=(1.0, 1.0, 2.0))
    for source, quality, names in (
        ("gnss", 1, ("gnss_bias", "gnss_bias_down")),
        ("gnss", 2, ("gnss_bias", "gnss_bias_down")),
        ("gnss", 4, ("gnss_bias", "gnss_bias_down")),
        ("gnss", 5, ("gnss_bias", "gnss_bias_down")),
        ("front", 1, ("gnss_bias_front", "gnss_bias_front_down")),
        ("other", 1, ("gnss_bias", "gnss_bias_down")),  # the section named after its kind
        ("white", 1, ()),
        ("white", 4, ()),
    ):
        (measurement,) = intake.measurements_of(
            replace(fix, source=source, quality=quality), 7, 0.0
        )
        assert isinstance(measurement, PositionMeasurement)
        assert measurement.bias == names, (source, quality)
        by_phase = math.sqrt(0.5)
        part = (by_phase / 1.5, by_phase / 1.5, by_phase * 2.0 / 4.0)
        shares = part if names and quality >= 4 else (1.0, 1.0, 1.0)
        assert measurement.bias_share == pytest.approx(shares)


def _bias_share(intake: Intake, sd_m: float, quality: int, source: str = "gnss") -> float:
    sd = (sd_m, sd_m, sd_m)
    stamp = MonotonicStamp(7)
    fix = PositionFix(source, 0, stamp, 0.5, 1.9, 10.0, quality=quality, sd_ned_m=sd)
    (measurement,) = intake.measurements_of(fix, 7, 0.0)
    assert isinstance(measurement, PositionMeasurement)
    return measurement.bias_share[0]


def test_a_stated_sigma_that_collapses_makes_no_fix_one_by_carrier_phase() -> None:
    """A receiver of code that suddenly states a centimetre is as wrong as before by what its fixes
    share. One that says by its quality that it is by phase is believed, and one whose quality says
    nothing as long as no sigma of code has come with it."""
    intake = Intake({"gnss": GnssAiding(), "post": GnssAiding()})
    by_phase = math.sqrt(0.5) * 0.3
    assert _bias_share(intake, 0.01, 1, "post") == pytest.approx(by_phase)
    assert _bias_share(intake, 0.2, 1, "post") == 1.0
    assert _bias_share(intake, 0.01, 1, "post") == pytest.approx(by_phase)
    assert _bias_share(intake, 1.5, 1) == 1.0
    assert _bias_share(intake, 0.01, 1) == 1.0
    assert _bias_share(intake, 0.01, 2) == pytest.approx(by_phase)
    assert _bias_share(intake, 0.01, 4) == pytest.approx(math.sqrt(0.5) * 0.02)
    assert _bias_share(intake, 0.01, 1) == 1.0


def test_the_navigators_model_has_the_states() -> None:
    config = Config.model_validate(
        {"estimator": {"model": "ins15"}, "aiding": {"star_tracker": {}, "sar": {}}}
    )
    model = Navigator(config).model
    slots = [*model.slots_of(STAR_BLOCK), *model.slots_of(SAR_BLOCK)]
    assert slots == [15, 16, 17, 18, 19, 20]
    assert model.initial[slots] == pytest.approx(np.full(6, 200.0 * ARCSEC))


def test_a_start_does_not_take_its_heading_from_a_tracker_that_is_mounted_askew() -> None:
    """The start would have the misalignment for its own error, and the filter find them to agree:
    a heading of 0.1 deg sigma that is off by the mount."""
    for sd, taken in ((200.0, False), (0.0, True)):
        config = Config.model_validate({"aiding": {"star_tracker": {"misalignment_sd_arcsec": sd}}})
        navigator = Navigator(config)
        assert navigator.add(attitude("star_tracker"), 7) == "accepted"
        assert (navigator._aligner.known.heading is not None) is taken
