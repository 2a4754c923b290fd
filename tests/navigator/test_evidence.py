"""What an alignment is told by positions and velocities of one receiver: do they go together?"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.initialisation_candidates import PositionCandidate, VelocityCandidate
from fusiond.aiding.position import PositionMeasurement
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import imu_noise
from fusiond.navigator.alignment.evidence import AlignmentEvidence, Fix, Standstill
from fusiond.navigator.alignment.options import alignment_options

CONFIG = Config.model_validate({"imu": {"rate_hz": 100.0}})
SD_M, SD_M_S, SPEED_M_S, EVERY_S, FIXES = 0.8, 0.05, 15.0, 0.1, 40
METRES = np.array([6_378_137.0, 6_378_137.0])  # a radian at the equator, near enough


def _looked_at(
    rng: np.random.Generator, wrong: NDArray[np.float64], strayed_m: float = 0.0
) -> tuple[AlignmentEvidence, bool]:
    """Straight on to the north; the velocity of each fix is `wrong` (n, 2) by so much (m/s), the
    tenth position off by `strayed_m`. A look at each fix, as an alignment that waits has it; and
    what it saw at the last."""
    known = AlignmentEvidence(
        alignment_options(CONFIG), imu_noise(CONFIG.imu), None, lambda code, text: None
    )
    confirmed = False
    for k in range(FIXES):
        t_ns = round((k + 1) * EVERY_S * 1e9)
        place = rng.normal(0.0, SD_M, 2)
        place[0] += SPEED_M_S * k * EVERY_S
        place[1] += strayed_m * (k == 10)
        lat, lon = place / METRES
        north, east = rng.normal(0.0, SD_M_S, 2) + wrong[k]
        velocity = VelocityCandidate(t_ns, (SPEED_M_S + north, east, 0.0), (SD_M_S, SD_M_S, SD_M_S))
        sd = (SD_M, SD_M, SD_M)
        position = PositionCandidate(t_ns, float(lat), float(lon), 0.0, sd, (0.0, 0.0, 0.0))
        known.fixes.append(Fix(velocity, position, "gnss"))
        confirmed = known.position_confirms(known.fixes[-1])
    return known, confirmed


def test_a_fix_at_the_edge_of_its_noise_makes_no_velocity_suspect() -> None:
    """4.5 sigma of the way between two fixes: a start waits for a fix or two. It must not be one
    that has to prove itself for half a minute."""
    rng, honest = np.random.default_rng(1), np.zeros((FIXES, 2))
    sigma_m = math.hypot(SD_M, SD_M, 0.05 * SPEED_M_S * 10 * EVERY_S)
    looked = [_looked_at(rng, honest, 4.5 * sigma_m) for _ in range(50)]
    suspect = [known.contradicted_ns for known, _ in looked if known.contradicted_ns]
    assert len(suspect) < 25  # the noise of the two comes on top
    assert all(confirmed for _, confirmed in looked)


def test_velocities_that_run_away_are_suspect_even_when_they_agree_again() -> None:
    """6 m/s off for the first two seconds of four."""
    rng, wrong = np.random.default_rng(2), np.zeros((FIXES, 2))
    for turn in range(50):
        angle = 2.0 * math.pi * turn / 50
        wrong[: FIXES // 2] = 6.0 * np.array([math.cos(angle), math.sin(angle)])
        known, _ = _looked_at(rng, wrong)
        assert known.contradicted_ns["gnss"] > 1_000_000_000


def test_a_position_that_an_operator_corrects_is_no_motion() -> None:
    """Typed 300 km off and put right a second later: it would never be level. A receiver's two
    positions that far apart are another matter."""
    for source, rested in (("operator", True), ("rdss", False)):
        known = AlignmentEvidence(
            alignment_options(CONFIG), imu_noise(CONFIG.imu), None, lambda code, text: None
        )
        for t_ns, lat in ((1, 0.55), (10**9, 0.5)):
            where, sd, lever = (lat, 2.0, 40.0), (5.0,) * 3, (0.0,) * 3
            known.receive([PositionMeasurement(source, t_ns, 0.999, *where, sd, lever)])
        assert known.rested(Standstill(0, 5 * 10**9, 5.0)) is rested
