r"""Bounds of detection: earliest possible instant for a fault, and largest error before it.

All of a filter's information on a fault is in its whitened innovations y. A fault adds a signature
s_k to them: the difference of the innovations of two runs with the same noise, with the fault and
without it, without gates and exclusions. The best possible test knows the signature, and it has

    d^2(t) = sum_k |s_k|^2          e^T L^-1 e ~ noncentral chi-square with d^2

    detected  d^2 >= 5.25^2: it is beyond one false alarm in a million in half of the cases
    open      d^2 >= 2 log(3600 s / 24) = 10.0: a fault that begins once an hour, whose onset is
              known to a second, has a posterior probability of 1 / 25 in half of the cases, and
              what is published covers its error by five sigma
    beyond    the error that the fault makes is five sigma of the filter with nothing wrong

Who knows neither kind nor size nor onset is later. Where `open` is more than two seconds behind
`beyond` no honest sigma keeps from a lie of that length, and `least_m` is the error that is made
until `detected`: the least that any test leaves.

Source: Basseville, Nikiforov, Detection of abrupt changes (1993), section 7.2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.schema import Config
from fusiond.estimators.base import Outcome
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import Truth
from fusiond.studies.faults.error_sigma_score import LIE_S, MOST_SIGMA
from fusiond.studies.faults.library import FAULTS as MATRIX
from fusiond.studies.faults.library import PHASES, PhaseName
from fusiond.studies.faults.matched_noise_drives import Share, Vehicle, part_generator, scene
from fusiond.studies.faults.runs import TICKS_PER_S, VEHICLE, on_random_drive
from fusiond.studies.faults.sensor_data import Recording
from fusiond.studies.faults.service import BEGINS_S, DURATION_S, FAULTS, LASTS_S, RECEIVERS
from fusiond.studies.faults.solution_errors import (
    JUDGED,
    STEP_S,
    Published,
    errors_against,
    longest_s,
)
from fusiond.studies.timeline_without_diagnosis import WithoutDiagnosis

Array = NDArray[np.float64]

DETECTED = 5.25**2
OPEN = 2.0 * math.log(3600.0 / (MOST_SIGMA**2 - 1.0))
ROWS: tuple[tuple[str, PhaseName, int], ...] = (
    ("fixes_late_0.8s", "coasting", 87),
    ("drift_0.1_m_s", "navigating", 62),
    ("drift_0.1_m_s", "coasting", 83),
)
"""Rows of the matrix on random drives whose verdict is a lie: fault, phase, drive."""


@dataclass(frozen=True, slots=True)
class Job:
    """Fault on a drive: of the service study, with a receiver, or of the matrix, in a phase."""

    fault: str
    where: str
    drive: int


@dataclass(frozen=True, slots=True)
class UngatedRun:
    """Solution of a filter without gates, and its innovations by instant (ns) and source."""

    run: Published
    whitened: Mapping[tuple[int, str], tuple[float, ...]]


def jobs(drives: int) -> list[Job]:
    """Jobs: all faults of the service study, and the rows with lies."""
    found = [Job(f, r, k) for k in range(drives) for r in RECEIVERS for f in FAULTS]
    return found + [Job(fault, phase, drive) for fault, phase, drive in ROWS]


def bound_run(job: Job, share: Share) -> dict[str, Any]:
    """Run a job and return its figures."""
    if job.where in RECEIVERS:
        config, truth, recording = _drive(job.where, job.drive, share)
        draws = part_generator(share, job.drive, 4, ["", *FAULTS].index(job.fault))
        begin_s = round(float(draws.uniform(*BEGINS_S)), 1)
        altered = FAULTS[job.fault][1](recording, begin_s, LASTS_S)
        end_s, sound = BEGINS_S[1] + LASTS_S, _sound(job.where, job.drive, share)
    else:
        config, truth, recording = _row(job)
        fault = on_random_drive(MATRIX[job.fault], job.drive)
        begin_s = fault.begins_s(job.where)  # type: ignore[arg-type]
        assert fault.alter is not None
        altered = fault.alter(recording, begin_s, fault.length_s)
        end_s = min(begin_s + LASTS_S, truth.duration_s)
        sound = ungated_run(config, recording, truth, end_s)
    faulty = ungated_run(config, altered, truth, end_s)
    return {
        "fault": job.fault,
        "where": job.where,
        "drive": job.drive,
        "begin_s": begin_s,
        **bound(sound, faulty, begin_s, begin_s + LASTS_S),
    }


@lru_cache(maxsize=1)
def _drive(receiver: str, number: int, share: Share) -> tuple[Config, Truth, Recording]:
    """A drive of the service study."""
    vehicle = Vehicle("data sheet", RECEIVERS[receiver], True, "noise")
    on = scene(vehicle, share, number, DURATION_S)
    return on.config, on.truth, on.recording


@lru_cache(maxsize=1)
def _sound(receiver: str, number: int, share: Share) -> UngatedRun:
    """Fault-free run over the longest duration of a fault."""
    config, truth, recording = _drive(receiver, number, share)
    return ungated_run(config, recording, truth, BEGINS_S[1] + LASTS_S)


def _row(job: Job) -> tuple[Config, Truth, Recording]:
    """Row of the matrix for a drive, in its phase."""
    fault = on_random_drive(MATRIX[job.fault], job.drive)
    truth, recording = fault.drive.recorded(VEHICLE, 0)
    outage = PHASES[job.where].outage_s  # type: ignore[index]
    return VEHICLE, truth, recording if outage is None else recording.withheld(*outage)


def ungated_run(config: Config, recording: Recording, truth: Truth, end_s: float) -> UngatedRun:
    """Run until `end_s` of a filter that accepts all measurements."""
    found: dict[tuple[int, str], tuple[float, ...]] = {}

    def trust(navigator: Navigator) -> None:
        timeline = navigator.timeline
        if isinstance(timeline.diagnosis, WithoutDiagnosis):
            return
        estimator, timeline.diagnosis = timeline.estimator, WithoutDiagnosis()
        fold_in = estimator.update

        def update(measured: Any, noise: Array) -> Outcome:
            outcome = fold_in(replace(measured, gate=1.0), noise)
            found[measured.t_ns, measured.source] = outcome.whitened
            return outcome

        estimator.update = update  # type: ignore[method-assign, assignment]
        estimator.hypotheses = None

    ticks = np.arange(1.0, math.floor(end_s * TICKS_PER_S) + 0.5)
    return UngatedRun(
        errors_against(config, recording, truth.at(ticks * STEP_S), watch=trust), found
    )


def bound(sound: UngatedRun, faulty: UngatedRun, begin_s: float, end_s: float) -> dict[str, Any]:
    """Bound from two runs with the same noise, one with a fault from `begin_s` to `end_s`."""
    times, gained = detection_information(sound, faulty, begin_s)
    run = sound.run
    difference = np.abs(faulty.run.errors - run.errors)
    difference[:, 6:9] = np.minimum(difference[:, 6:9], 2.0 * math.pi - difference[:, 6:9])
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.nan_to_num((difference / run.sigmas)[:, JUDGED]).max(axis=1)
    since, lasts = run.t_s - begin_s, (run.t_s > begin_s + 1e-6) & (run.t_s <= end_s)
    far = np.flatnonzero((ratio > MOST_SIGMA) & lasts)
    beyond_s = float(since[far[0]]) if far.size else None
    detected_s, open_s = (_first(times, gained, least) for least in (DETECTED, OPEN))
    until = lasts & (since <= (math.inf if detected_s is None else detected_s))
    hidden = lasts & (since <= (math.inf if open_s is None else open_s))
    lie_s = longest_s((ratio > MOST_SIGMA) & hidden)
    return {
        "beyond_s": beyond_s,
        "open_s": open_s,
        "detected_s": detected_s,
        "information": [round(float(np.interp(s, times, gained)), 1) for s in (10, 20, 40, 60)],
        "least_m": float(np.hypot(difference[until, 0], difference[until, 1]).max(initial=0.0)),
        "lie_s": lie_s,
        "lies": lie_s > LIE_S,
    }


def detection_information(
    sound: UngatedRun, faulty: UngatedRun, begin_s: float
) -> tuple[Array, Array]:
    """Instants after the fault's begin (s), and d^2 until each."""
    times, squares = [0.0], [0.0]
    for t_ns, source in sorted(sound.whitened):
        one, other = sound.whitened[t_ns, source], faulty.whitened.get((t_ns, source), ())
        if t_ns * 1e-9 > begin_s - 1e-6 and len(one) == len(other):
            times.append(t_ns * 1e-9 - begin_s)
            squares.append(sum((a - b) ** 2 for a, b in zip(one, other, strict=True)))
    return np.array(times), np.cumsum(squares)


def _first(times: Array, gained: Array, least: float) -> float | None:
    """First instant with the required information."""
    at = int(np.searchsorted(gained, least))
    return float(times[at]) if at < len(times) else None
