"""`fusiond process`: the daemon's navigator over recorded files, causal, a solution a sample.

Rows are handed over in order of arrival (`t_arrival_s`, or `t_s` where there is none); the
solution at each sample is what the daemon would have said then, before anything that arrived later.
"""

from __future__ import annotations

import gc
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import (
    Measurement,
    MonotonicStamp,
)
from drivers.raw.messages import Ephemeris, Klobuchar, RawEvent, RawGnssEpoch, System
from fusiond.configuration.aiding import GnssAiding, RawAiding
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import Rejection, counts
from fusiond.files.solution_csv import STATUS, SolutionWriter
from fusiond.files.tables import ImuTable, read_imu
from fusiond.navigator.navigator import Navigator
from fusiond.offline.aid_files import READERS, Arrival, source_of

Array = NDArray[np.float64]

# Samples handed over at once where no late aid arrives in between: the solution's mode is judged at
# this spacing, and memory stays bounded.
CHUNK = 512
_SHOWN = 20


def process(
    config: Config,
    imu_path: Path,
    aids: list[tuple[str, Path]],
    outages: list[tuple[float, float]] | None = None,
    out: Path | None = None,
    systems: tuple[System, ...] | None = None,
) -> dict[str, Any]:
    """Navigate through the files; returns rows, rejections, outcomes by source and the end state.

    `systems` are the satellite systems of raw data to use, instead of the configuration's. Raises
    `TableError` for a file that cannot be read as what it is said to be.
    """
    with _imports_left_alone():
        return _process(config, imu_path, aids, outages, out, systems)


@contextmanager
def _imports_left_alone() -> Iterator[None]:
    """Keep the garbage collector from looking through all that was imported, numba above all, each
    time that so many measurements have been made: a tenth of a second each."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _process(
    config: Config,
    imu_path: Path,
    aids: list[tuple[str, Path]],
    outages: list[tuple[float, float]] | None,
    out: Path | None,
    systems: tuple[System, ...] | None,
) -> dict[str, Any]:
    if any(kind == "raw" for kind, _ in aids):
        config = _with_raw(config, systems)
    imu = read_imu(imu_path)
    rows_read = len(imu.t_s) + len(imu.rejected)
    files: dict[str, Any] = {"imu": _account(rows_read, imu.rejected)}
    arrivals: list[Arrival] = []
    withheld: dict[str, int] = {}
    for kind, path in aids:
        rows, rejected = READERS[kind](path, imu, source_of(kind, config))
        name = kind if kind not in files else f"{kind}:{path.name}"
        files[name] = _account(len(rows) + len(rejected), rejected)
        kept = rows
        if outages:
            kept = [row for row in rows if not _withheld(row.measurement, outages)]
        withheld[kind] = withheld.get(kind, 0) + len(rows) - len(kept)
        arrivals += kept
    arrivals.sort(key=lambda a: a.t_arrival_ns)

    events: list[dict[str, str]] = []
    navigator = Navigator(
        config, on_event=lambda code, text: events.append({"code": code, "text": text})
    )
    written = _run(navigator, imu, arrivals, out)
    sources: dict[str, dict[str, int]] = {}
    for source, outcomes in navigator.timeline.counters.outcomes.items():
        sources[source] = {name: count for name, count in outcomes.items() if count}
    for source, refused in navigator.refused.items():
        sources.setdefault(source, {}).update(refused)
    for source, count in withheld.items():
        if count:
            sources.setdefault(source, {})["withheld"] = count
    if navigator.imu.counters:
        sources["imu"] = dict(navigator.imu.counters)
    return {
        "files": files,
        "sources": sources,
        "events": events,
        "solution_rows": written,
        "aligned": None if navigator.started is None else navigator.started.how,
        "mode": str(navigator.mode(navigator.imu.latest_ns)[0]),
        "reason": navigator.mode(navigator.imu.latest_ns)[1],
        "consistency": {
            name: asdict(report) for name, report in navigator.verdicts.reports().items()
        },
        "rewinds": navigator.timeline.counters.rewinds,
    }


def _with_raw(config: Config, systems: tuple[System, ...] | None) -> Config:
    """The configuration with a section for the raw data of a file, and the systems asked for."""
    name = source_of("raw", config)
    section = config.aiding.get(name)
    raw = section if isinstance(section, RawAiding) else RawAiding()
    if systems is not None:
        raw = raw.model_copy(update={"systems": systems})
    return config.model_copy(update={"aiding": {**config.aiding, name: raw}})


def _account(rows: int, rejected: list[Rejection]) -> dict[str, Any]:
    return {
        "rows": rows,
        "rejected": counts(rejected),
        "first_rejected": [str(r) for r in rejected[:_SHOWN]],
    }


def _withheld(m: Measurement | RawEvent, outages: Iterable[tuple[float, float]]) -> bool:
    if isinstance(m, Ephemeris | Klobuchar):
        return False
    t = _valid_ns(m) * 1e-9
    return any(start <= t < start + length for start, length in outages)


def _valid_ns(m: Measurement | RawGnssEpoch) -> int:
    """The instant of the IMU's clock that a recorded measurement is valid at."""
    stamp = getattr(m, "stamp", None)
    assert isinstance(stamp, MonotonicStamp)
    return stamp.t_ns


def _run(navigator: Navigator, imu: ImuTable, arrivals: list[Arrival], out: Path | None) -> int:
    times = np.rint(imu.t_s * 1e9).astype(np.int64)
    samples = np.hstack([imu.gyro, imu.accel])
    # A sample is there once its time has come; its own time offset shifts validity, not arrival.
    # So many samples have come when arrival k comes.
    breaks = np.searchsorted(times, [a.t_arrival_ns for a in arrivals], side="right").tolist()
    late = [_is_late(a, navigator.config) for a in arrivals]
    gap_ns = round(navigator.config.imu.gap_s * 1e9)
    writer = SolutionWriter(out) if out is not None else None
    recorder = _Recorder(navigator, writer)
    done = given = 0
    while done < len(times) or given < len(arrivals):
        # Samples up to the next arrival that must find the filter where it then stood. One that is
        # valid when it comes need not: the timeline keeps it until the samples reach it.
        ahead = given
        upto = min(len(times), done + CHUNK)
        alone = navigator.started is None or _has_gap(times[max(done - 1, 0) : upto], gap_ns)
        while ahead < len(arrivals) and breaks[ahead] <= upto:
            if alone or late[ahead]:
                upto = breaks[ahead]
                break
            ahead += 1
        for arrival in arrivals[given:ahead]:
            _give(navigator, arrival)
        if upto > done:
            navigator.add_imu(times[done:upto], samples[done:upto])
        navigator.advance(record=True)
        recorder.take()
        given, done = ahead, upto
        if given < len(arrivals) and breaks[given] <= done and (alone or late[given]):
            _give(navigator, arrivals[given])
            given += 1
            navigator.advance(record=True)
            recorder.take()
    if writer is not None:
        writer.close()
    return recorder.rows


def _give(navigator: Navigator, arrival: Arrival) -> None:
    m = arrival.measurement
    if isinstance(m, Ephemeris | Klobuchar):
        navigator.learn(m)
        return
    navigator.add(m, _valid_ns(m))


def _is_late(arrival: Arrival, config: Config) -> bool:
    """Whether samples of its validity, or of an aid that it holds, come before it does."""
    m = arrival.measurement
    if isinstance(m, Ephemeris | Klobuchar):
        return False
    if isinstance(m, RawGnssEpoch):
        return True  # corrected for the place where the filter has come to
    section = config.aiding.get(m.source)
    delayed = isinstance(section, GnssAiding) and section.velocity_delay_s > 0.0
    return delayed or config.imu.time_offset_s > 0.0 or _valid_ns(m) < arrival.t_arrival_ns


def _has_gap(times: NDArray[np.int64], gap_ns: int) -> bool:
    return bool((np.diff(times) > gap_ns).any())


class _Recorder:
    """Takes each sample's solution as it was first known."""

    def __init__(self, navigator: Navigator, writer: SolutionWriter | None) -> None:
        self._navigator = navigator
        self._writer = writer
        self._next = 0
        self.rows = 0

    def take(self) -> None:
        navigator = self._navigator
        if navigator.started is None:
            return
        imu, passed = navigator.imu, navigator.estimator.sample
        first = max(self._next, imu.index_after(navigator.started.t_ns) + imu.start)
        if passed <= first:
            return
        rows = slice(first - imu.start, passed - imu.start)
        nav, count = imu.nav[rows], passed - first
        self._next = passed
        self.rows += count
        if self._writer is None:
            return
        mode, _ = navigator.mode(int(imu.times[rows.stop - 1]))
        self._writer.rows(
            np.asarray(imu.times[rows] * 1e-9, dtype=np.float64),
            nav[:, 0],
            (nav[:, 1] + np.pi) % (2.0 * np.pi) - np.pi,
            nav[:, 2],
            nav[:, 3:6],
            _rpy(nav[:, 6:]),
            np.where(navigator.model.stated, imu.sigmas[rows], np.nan),
            np.full(count, STATUS.index(mode), dtype=np.int64),
        )


def _rpy(q: Array) -> Array:
    """Roll, pitch, yaw (n, 3) of quaternions (n, 4)."""
    w, x, y, z = q.T
    roll = np.arctan2(2.0 * (y * z + w * x), w * w - x * x - y * y + z * z)
    pitch = np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z)
    return np.column_stack([roll, pitch, yaw])
