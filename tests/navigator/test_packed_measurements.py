"""Measurements that a kernel takes by the row, against the same one by one: to the bit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fusiond.bench.delayed_fix import Drive
from fusiond.estimators.invariant import InvariantFilter
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.navigator.timeline import Entry

SECOND_ROWS = 10
"""Epochs of the drive's receiver a second."""
Alter = Callable[[Drive], None]


def sound(_: Drive) -> None:
    """Nothing is wrong."""


def off(drive: Drive) -> None:
    """Positions are 60 m off for five seconds, velocities by 2 m/s for five others."""
    drive.receiver.position[80 * SECOND_ROWS : 85 * SECOND_ROWS, 0] += 1e-5
    drive.receiver.v_ned[95 * SECOND_ROWS : 100 * SECOND_ROWS, 1] += 2.0


def repeated(drive: Drive) -> None:
    """Positions and velocities repeat themselves for three seconds."""
    for values in (drive.receiver.position, drive.receiver.v_ned):
        values[90 * SECOND_ROWS : 93 * SECOND_ROWS] = values[90 * SECOND_ROWS]


def driven(
    monkeypatch: pytest.MonkeyPatch, alter: Alter, *, packs: bool, raw: bool = False
) -> tuple[Drive, list[Entry]]:
    """A drive with two fixes that are ten seconds late, and its measurements."""
    monkeypatch.setattr(KalmanEstimator, "packs", packs)
    drive, entries = Drive(2), []
    drive.navigator.timeline.keeps_raw = raw
    insert = drive.navigator.timeline.insert

    def inserted(*given: object) -> Entry:
        entries.append(insert(*given))  # type: ignore[arg-type]
        return entries[-1]

    monkeypatch.setattr(drive.navigator.timeline, "insert", inserted)
    alter(drive)
    for number in range(2):
        drive.delayed(number)()
    return drive, entries


@pytest.mark.parametrize("alter", [sound, off, repeated])
def test_rows_are_what_measurements_are_one_by_one(
    monkeypatch: pytest.MonkeyPatch, alter: Alter
) -> None:
    by_rows, entries = driven(monkeypatch, alter, packs=True)
    singly, others = driven(monkeypatch, alter, packs=False)
    one, other = by_rows.navigator.estimator, singly.navigator.estimator
    assert isinstance(one, InvariantFilter)
    assert isinstance(other, InvariantFilter)
    assert one.runs
    assert not other.runs
    assert [str(entry.outcome) for entry in entries] == [str(entry.outcome) for entry in others]
    assert one.snapshot().kept.tobytes() == other.snapshot().kept.tobytes()
    diagnosis, reference = by_rows.navigator.timeline.diagnosis, singly.navigator.timeline.diagnosis
    assert diagnosis.findings == reference.findings
    names = {entry.outcome.name for entry in entries if entry.outcome is not None}
    assert ("isolated" in names) == (alter is not sound)
    assert ("repeated" in names) == (alter is repeated)
    for name, series in reference.series.items():
        assert np.array_equal(diagnosis.series[name].noise, series.noise)
        assert diagnosis.series[name].repeating == series.repeating
        assert diagnosis.series[name].state is series.state
    outcomes = by_rows.navigator.timeline.counters.outcomes
    assert outcomes == singly.navigator.timeline.counters.outcomes


def test_raw_innovations_are_those_of_the_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    _, entries = driven(monkeypatch, sound, packs=True, raw=True)
    _, others = driven(monkeypatch, sound, packs=False, raw=True)
    units = {entry.raw.unit for entry in entries if entry.raw is not None}
    assert units == {"m", "m/s"}
    assert [entry.raw for entry in entries] == [entry.raw for entry in others]
