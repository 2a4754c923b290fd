"""One run of a fault of wires, clocks or the host, and the rows of its matrix.

`aligning` begins at rest, before the first heading; `navigating` in town with all measurements;
`coasting` in an outage of receiver and terminal: faults of a receiver begin with its return, all
others in the midst of it.
"""

from __future__ import annotations

import asyncio
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fusiond.studies.faults.error_sigma_score import Course, row_figures
from tests.live.rig import REST_S, Rig, rig, under_way
from tests.live.wire_faults import FAULTS, Action, plugged

BEGINS_S = {"aligning": 4.0, "navigating": 32.0, "coasting": 44.0}
OUTAGE_S = 28.0
"""From then on nothing comes of receiver and terminal, in the phase `coasting`."""
WATCHED_S = 25.0
"""After the fault's end."""
JITTER_S = 3.0
"""By as much may the instants of a start differ from run to run."""
TOO_BUSY = "host too busy"
"""The verdict on a row in which the vehicle stood still: it says nothing."""


def missing(needs: str) -> bool:
    """Whether this machine does not have what a fault needs. A clock is set in a guest alone."""
    if needs == "guest":
        return "User Mode Linux" not in Path("/proc/cpuinfo").read_text()
    up = ["ip", "link", "show", "vcan0"]
    return needs == "vcan" and not subprocess.run(up, capture_output=True, check=False).stdout


@dataclass(frozen=True)
class Run:
    """A fault in a phase, as it went: `begin_s` and `end_s` of the drive; `stalled_s` is for how
    long the vehicle itself stood still at most, on a host that is too busy."""

    fault: str
    phase: str
    course: Course
    begin_s: float
    end_s: float
    stalled_s: float = 0.0


async def run(name: str, phase: str, folder: Path, seed: int) -> Run:
    """The daemon's course through one fault."""
    fault = FAULTS[name]
    begin_s = 0.0 if fault.first_byte else BEGINS_S[phase]
    planned_s = begin_s + fault.length_s
    last_s = planned_s + WATCHED_S + (REST_S if phase == "aligning" else 0.0)
    async with rig(folder, last_s + 30.0, seed, fault.settings) as made, under_way(made):
        outage = phase == "coasting"
        if outage:
            await made.until(OUTAGE_S)
            await _each(made, plugged("gnss", False), plugged("rdss", False))
        await made.until(begin_s)
        if outage and fault.of_fixes:
            await _each(made, plugged("gnss", True), plugged("rdss", True))
        begin_s = made.now_s
        await fault.begin(made)
        await made.until(planned_s)
        await fault.end(made)
        end_s = made.now_s
        if outage and not fault.of_fixes:
            await _each(made, plugged("gnss", True), plugged("rdss", True))
        await made.until(end_s + last_s - planned_s)
        return Run(name, phase, made.course(), begin_s, end_s)


async def _each(made: Rig, *actions: Action) -> None:
    for action in actions:
        await action(made)


def judged(found: Run, reference: Course) -> dict[str, Any]:
    """The figures of a row, against a run of the same phase without a fault."""
    usual: dict[float, set[str]] = {}
    for s in reference.samples:
        for k in range(-int(JITTER_S), int(JITTER_S) + 1):
            usual.setdefault(s.t_s + k, set()).add(s.mode)
    modes = {s.t_s: s.mode for s in reference.samples}
    like = [
        replace(s, mode=s.mode if s.mode in usual.get(s.t_s, {s.mode}) else modes.get(s.t_s, ""))
        for s in found.course.samples
    ]
    row = row_figures(found.course, replace(reference, samples=like), found.begin_s, found.end_s)
    return {
        "fault": found.fault,
        "phase": found.phase,
        "begin_s": round(found.begin_s, 3),
        "end_s": round(found.end_s, 3),
        **row,
        "stalled_s": round(found.stalled_s, 3),
    } | ({"verdict": TOO_BUSY} if found.stalled_s else {})


def rows(only: str | None = None, phase: str | None = None) -> list[tuple[str, str]]:
    """The matrix, or a part of it, without what this machine cannot do."""
    return [
        (name, p)
        for name, fault in FAULTS.items()
        for p in fault.phases
        if only in (None, name) and phase in (None, p) and not missing(fault.needs)
    ]


def run_row(row: tuple[str, str], folder: Path, seed: int) -> Run:
    """`run` in a process of its own."""
    name, phase = row
    place = folder / f"{name}-{phase}"
    place.mkdir()
    return asyncio.run(run(name, phase, place, seed))
