"""The models of paper 002 on `flight-sar`, through the navigator: `ins17` beside `ins23`.

The simulated receiver is white, and the configuration says so: no error that fixes share, no offset
in time, a lever arm as measured.
"""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fusiond.configuration.schema import Config
from fusiond.files.measurement_csv import read_solution, read_truth
from fusiond.offline.compare import compare
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import SCENARIOS
from tests.places import REPOSITORY

SHIPPED = tomllib.loads((REPOSITORY / "config" / "flight_sar.toml").read_text())
WHITE = {"bias_sd_m": 0.0, "time_offset_sd_s": 0.0, "lever_arm_sd_m": 0.0}
SEED, SECONDS, AFTER_S = 3, 300.0, 60.0
PLAIN = {"filter": "multiscale", "multiscale": {"scales": 1}}
"""The filter `kalman` without a bank of hypotheses, to rounding."""


@cache
def flown(model: str, bank: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """What came of each source's measurements, and the comparison with the truth."""
    estimator = {"model": model, **({} if bank else PLAIN)}
    aiding = {**SHIPPED["aiding"], "gnss": SHIPPED["aiding"]["gnss"] | WHITE}
    config = Config.model_validate(
        {**SHIPPED, "sources": {}, "aiding": aiding, "estimator": estimator}
    )
    with TemporaryDirectory() as folder:
        path = Path(folder)
        files = simulate(SCENARIOS["flight-sar"], path, seed=SEED, duration_s=SECONDS).files
        measurements = [(kind, files[kind]) for kind in ("gnss", "attitude", "bearing")]
        found = process(config, files["imu"], measurements, out=path / "nav.csv")
        report = compare(
            read_solution(path / "nav.csv"), read_truth(files["truth"]), after_s=AFTER_S
        )
    return found["sources"], dict(report)


def check(bank: bool) -> None:
    full = flown("ins23", True)[1]
    sources, report = flown("ins17", bank)
    assert 0.7 < report["position_nees"] / 3.0 < 1.4
    assert report["horizontal_rms_m"] < 1.2 * full["horizontal_rms_m"]
    assert sources["gnss"].get("isolated", 0) == 0


def test_ins23_is_honest() -> None:
    assert 0.7 < flown("ins23", True)[1]["position_nees"] / 3.0 < 1.4


def test_ins17_is_honest_and_nearly_as_good() -> None:
    check(bank=False)


def test_ins17_is_so_with_the_bank_of_hypotheses() -> None:
    check(bank=True)
