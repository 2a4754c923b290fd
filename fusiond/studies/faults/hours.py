"""Fault-free hours: the rate of false reports.

Vehicles of `KINDS`, each hour with its own noise of the configuration: IMU at 50 Hz, receivers at
1 Hz, RDSS every 11 s. What is told once the mode has been `navigating` is a false alarm, and stands
beside what the test's own statement allows in so many tests:

isolated              a fault of a source is identified at odds of a thousand to one: so often as
                      such faults are taken to begin (`fusiond.integrity.catalogue`), a thousandth.
                      Three gates of 0.9999 that fail in a row are nothing beside it
corrected             likewise of the inertial unit and of stamps, and that a source's fault is
                      over, as often as one begins
verdict               alpha, begun: `STARTED_RATE`, as study `consistency` counts them
protection            `false_alarm_per_hour` of `[integrity]`

Wheels have the drift that the filter allows for. RDSS is no matched
source: it is simulated with less than its configured bias and height error, so that `cannot_tell`
is true of it; what is told of its innovations is not counted as an alarm.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as File
from typing import Any

import numpy as np
from scipy.stats import chi2

from drivers.measurements import PositionFix, WheelSpeed
from fusiond.configuration.aiding import WheelAiding
from fusiond.configuration.schema import Config
from fusiond.estimators.fault_bank import DECIDED
from fusiond.integrity.catalogue import OVER
from fusiond.navigator.assembly import kinds_of_config
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.markov import gauss_markov
from fusiond.simulation.trajectories import Leg, Path, follow
from fusiond.studies.faults.error_sigma_score import (
    MOST_SIGMA,
    NAVIGATING,
    QUANTITIES,
    longest_lie_s,
)
from fusiond.studies.faults.library import with_second, with_wheels
from fusiond.studies.faults.runs import VEHICLE, navigate
from fusiond.studies.faults.sensor_data import (
    REST_S,
    TOWN_LEGS,
    WHEEL_EVERY_S,
    Drive,
    Received,
    Recording,
)

FALSE = 1.0 / (1.0 + math.exp(DECIDED))
"""Probability that an identified fault is false."""
HOUR_S = 3600.0
RATE_HZ, GNSS_HZ = 50.0, 1.0
LIMITS_M = (40.0, 40.0)
"""Alert limits, as in study `protection`."""
STARTED_RATE = 0.015e-3
"""False verdicts an innovation with a window of 100 (docs/consistency.md)."""
CONFIDENCE = 0.99
CORRECTED = ("sensor_fault", "fault_over")
"""Events of faults that are taken out of the state."""
USUAL = (
    *("aligned", "calibrated", "readmitted", "protection_restored", "verdict_consistent"),
    *("imu_sound", "imu_units_well"),
)
"""Events without a fault, or at its end."""
MOTORWAY_LEGS = (
    Leg(60),
    Leg(20, turn_deg=25.0),
    Leg(90),
    Leg(15, speed_m_s=24.0),
    Leg(30, turn_deg=-40.0),
    Leg(15, speed_m_s=33.0),
    Leg(60),
    Leg(25, turn_deg=15.0),
)


def circuit_legs(legs: tuple[Leg, ...], duration_s: float) -> Path:
    """Legs of the circuit, repeated."""
    rounds = int(duration_s / sum(leg.duration_s for leg in legs)) + 1
    return follow((Leg(REST_S), *legs * rounds), duration_s, course_deg=40.0, bank_ratio=-0.08)


def around_town(duration_s: float) -> Path:
    """Drive around the town of the matrix."""
    return circuit_legs(TOWN_LEGS, duration_s)


def on_motorway(duration_s: float) -> Path:
    """Drive with a bend to find the heading, then at 24 to 33 m/s."""
    off = (Leg(8, speed_m_s=14.0), Leg(12), Leg(8, turn_deg=90.0), Leg(15, speed_m_s=33.0))
    rounds = int(duration_s / sum(leg.duration_s for leg in MOTORWAY_LEGS)) + 1
    legs = (Leg(REST_S), *off, *MOTORWAY_LEGS * rounds)
    return follow(legs, duration_s, course_deg=40.0, bank_ratio=-0.08)


def parked(duration_s: float) -> Path:
    """Drive once around the town, then parked with the engine off."""
    legs = (Leg(REST_S), *TOWN_LEGS, Leg(8, speed_m_s=0.0), Leg(duration_s))
    return follow(legs, duration_s, course_deg=40.0, bank_ratio=-0.08)


@dataclass(frozen=True, slots=True)
class Kind:
    """Vehicle and its hour; one of two receivers has alert limits, too."""

    drive: Drive

    def config(self) -> Config:
        """Configuration of the navigator."""
        settings = VEHICLE.model_dump(exclude_unset=True)
        settings["imu"]["rate_hz"] = RATE_HZ
        if self.drive.second:
            settings["integrity"] = {
                "horizontal_alert_limit_m": LIMITS_M[0],
                "vertical_alert_limit_m": LIMITS_M[1],
            }
        config = Config.model_validate(settings)
        config = with_second(config) if self.drive.second else config
        return with_wheels(config) if self.drive.wheels else config

    def recorded(self, config: Config, seed: int, duration_s: float) -> tuple[Truth, Recording]:
        """Truth and simulated sensor data."""
        truth, recording = replace(self.drive, duration_s=duration_s).recorded(config, seed)
        if self.drive.wheels:
            return truth, _drifting(recording, config, np.random.default_rng([seed, 2]))
        return truth, recording


def _drifting(recording: Recording, config: Config, rng: np.random.Generator) -> Recording:
    """Add the drift of wheel speeds that the filter has as a state."""
    section = config.aiding["wheel"]
    assert isinstance(section, WheelAiding)
    speeds = [r for r in recording.received if isinstance(r.measurement, WheelSpeed)]
    drift = gauss_markov(
        rng,
        (len(speeds), 1),
        step_s=WHEEL_EVERY_S,
        correlation_s=section.drift_s,
        sigma=section.drift_sd_m_s,
    )
    others = [r for r in recording.received if not isinstance(r.measurement, WheelSpeed)]
    for item, off in zip(speeds, drift[:, 0].tolist(), strict=True):
        m = item.measurement
        assert isinstance(m, WheelSpeed)
        others.append(replace(item, measurement=replace(m, speed_m_s=m.speed_m_s + off)))
    return recording.with_received(others)


KINDS = {
    "town": Kind(Drive(around_town, gnss_rate_hz=GNSS_HZ)),
    "wheels": Kind(Drive(around_town, wheels=True, gnss_rate_hz=GNSS_HZ)),
    "motorway": Kind(Drive(on_motorway, gnss_rate_hz=GNSS_HZ)),
    "parked": Kind(Drive(parked, gnss_rate_hz=GNSS_HZ)),
    "two receivers": Kind(Drive(around_town, second=True, gnss_rate_hz=GNSS_HZ)),
}


def hour_of(seed: int, duration_s: float = HOUR_S) -> dict[str, Any]:
    """Figures of an hour, whose kind follows from the seed: events by code and source, their
    allowed number an hour, tests, seconds beyond five sigma by quantity, resident memory."""
    name = tuple(KINDS)[seed % len(KINDS)]
    kind = KINDS[name]
    config = kind.config()
    truth, recording = kind.recorded(config, seed, duration_s)
    course = navigate(config, recording, truth)
    since_s = next((s.t_s for s in course.samples if s.mode == NAVIGATING), duration_s)
    reported = Counter(
        event_name(e.code, e.text) for e in course.events if e.t_s > since_s and e.code not in USUAL
    )
    after = [s for s in course.samples if s.t_s > since_s]
    stated = [s.ratios for s in after if s.ratios]
    return {
        "kind": name,
        "seed": seed,
        "hours": duration_s / 3600.0,
        "told": dict(reported),
        "stated_per_h": stated_per_h(config),
        "tests": tests_by_series(recording.received),
        "limits": kind.drive.second,
        "not_navigating_s": sum(s.mode != NAVIGATING for s in after),
        "beyond_s": beyond_s(stated),
        "rms": np.sqrt(np.mean(np.square(stated), axis=0)).round(3).tolist() if stated else [],
        "longest_lie_s": longest_lie_s(course.samples),
        "resident_mb": resident_mb(),
        "crash": course.crash,
    }


def stated_per_h(config: Config) -> dict[str, float]:
    """False decisions an hour that odds and rates of the catalogue allow."""
    kinds = kinds_of_config(config, Navigator(config).model)
    # What only opens sigma decides nothing.
    of_sources = sum(kind.per_hour for kind in kinds if not (kind.corrected or kind.opens))
    of_unit = sum(kind.per_hour for kind in kinds if kind.corrected and kind.of != OVER)
    return {"isolated": FALSE * of_sources, "corrected": FALSE * (of_unit + of_sources)}


def beyond_s(stated: Sequence[Sequence[float]]) -> dict[str, int]:
    """Seconds beyond five sigma by quantity, of the ratios of each second."""
    return {q: sum(not r[k] <= MOST_SIGMA for r in stated) for k, q in enumerate(QUANTITIES)}


def resident_mb() -> float:
    """Resident memory of this process, MB of 10^6 bytes."""
    pages = int(File("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6


def event_name(code: str, text: str) -> str:
    """Name of an event with its source."""
    if code.startswith("verdict_"):
        return f"{code} {text.rpartition(' ')[2]}"
    return f"{code} {text.partition(' ')[0]}" if code == "isolated" else code


def tests_by_series(received: Iterable[Received]) -> dict[str, int]:
    """Innovations by series; those of constraints are not counted."""
    found: Counter[str] = Counter()
    for item in received:
        m = item.measurement
        match m:
            case PositionFix():
                found[m.source] += 1
                found[f"{m.source}_velocity"] += 1
            case WheelSpeed():
                found[m.source] += 1
    return dict(found)


def rates(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rates by kind and alarm: occurrences in 24 hours with the exact interval of a Poisson count
    at 99 %, and the stated rate for so many tests; for verdicts the tests are in `judged`, if
    present."""
    lines = []
    for name in dict.fromkeys(row["kind"] for row in found):
        rows = [row for row in found if row["kind"] == name]
        if not (hours := sum(row["hours"] for row in rows)):
            continue
        reported: Counter[str] = sum((Counter(row["told"]) for row in rows), Counter())
        tests: Counter[str] = sum((Counter(row["tests"]) for row in rows), Counter())
        judged: Counter[str] = sum(
            (Counter(row.get("judged", row["tests"])) for row in rows), Counter()
        )
        alarms = {
            **{
                what: (
                    _starting(reported, *codes),
                    sum(row["hours"] * row["stated_per_h"][what] for row in rows),
                    hours,
                )
                for what, codes in (("isolated", ("isolated",)), ("corrected", CORRECTED))
            },
            **{
                f"verdict of {series}": (
                    sum(k for what, k in reported.items() if _verdict_of(what) == series),
                    STARTED_RATE * count,
                    hours * count / tests[series],
                )
                for series, count in judged.items()
            },
        }
        if rows[0]["limits"]:
            limit = Config().integrity.false_alarm_per_hour * hours
            alarms["protection"] = _starting(reported, "protection"), limit, hours
        known = ("isolated", "verdict_", "protection", *CORRECTED)
        other = sum(k for what, k in reported.items() if not what.startswith(known))
        alarms["anything else"] = other, 0.0, hours
        for what, (times, stated, observed_h) in alarms.items():
            low = chi2.ppf(0.5 - CONFIDENCE / 2, 2 * times) / 2 if times else 0.0
            high = chi2.ppf(0.5 + CONFIDENCE / 2, 2 * times + 2) / 2
            a_day = 24.0 / observed_h
            lines.append(
                {
                    "kind": name,
                    "hours": observed_h,
                    "what": what,
                    "times": times,
                    "per_24_h": times * a_day,
                    "interval": (float(low) * a_day, float(high) * a_day),
                    "stated_per_24_h": stated * a_day,
                }
            )
    return lines


def _starting(reported: Counter[str], *words: str) -> int:
    return sum(k for what, k in reported.items() if what.startswith(words))


def _verdict_of(what: str) -> str:
    return what.partition(" ")[2] if what.startswith("verdict_") else ""
