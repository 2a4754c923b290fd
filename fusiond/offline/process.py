"""`fusiond process`: the daemon's navigator over recorded files, causal, with a solution at each
sample.

Samples come from a table or a recorded CAN bus, measurements from that bus and from files, in order
of arrival (`t_arrival_s`, or `t_s` without it). The solution at each sample is the daemon's at that
instant, before anything that arrived later.
"""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import Measurement, UtcStamp
from drivers.raw.messages import RawEvent, RawGnssEpoch, System
from fusiond.configuration.aiding import GnssAiding, WheelAiding
from fusiond.configuration.schema import Config
from fusiond.estimators.base import Estimator
from fusiond.files.csv_tables import rejection_counts
from fusiond.files.measurement_csv import ImuTable
from fusiond.files.solution_csv import STATUS
from fusiond.integrity.catalogue import Kind
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import longest_step
from fusiond.navigator.assembly import estimator_of
from fusiond.navigator.imu_choice import ImuChoice
from fusiond.navigator.navigator import Navigator
from fusiond.offline.failure_reasons import (
    FileRead,
    nothing_navigated,
    without_overlap,
    wrong_units,
)
from fusiond.offline.measurement_files import Arrival
from fusiond.offline.outages import Outage
from fusiond.offline.run_input import BROADCAST, Recorded, read_recorded, valid_ns
from fusiond.offline.solution_rows import Rows, RowsWriter

if TYPE_CHECKING:
    from fusiond.offline.smooth import SmoothedRows

# Samples handed over at once if no delayed measurement arrives in between: half a second at 100 Hz.
# The mode, and an end of the navigation, are noticed only at this spacing, after later measurements
# have been handed over. Ten times as many would save a seventh of the time.
CHUNK = 50
# New objects, some 10 MB, after which the garbage collector runs.
YOUNG = 50_000
_SHOWN = 20
_REPORT_EVERY = 2000
"""Samples between two reports of progress: some tenths of a second of work."""


def process(
    config: Config,
    imu_path: Path | None,
    measurements: list[tuple[str, Path]],
    outages: Sequence[Outage] | None = None,
    out: Path | None = None,
    systems: tuple[System, ...] | None = None,
    can_log: Path | None = None,
    watch: Callable[[Navigator], None] = lambda navigator: None,
    smooth: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Navigate through the files; returns rows, rejections, outcomes by source and the end state.

    The result has the number of the solution's rows, in all and by mode, its start, and a sentence
    `why` if there is none. Samples whose units contradict their columns are not navigated, and no
    `out` is written. `systems` are the satellite systems of raw data to use, instead of the
    configuration's. `can_log` is the bus of the sources on CAN, in place of `imu_path`. `watch`
    receives the navigator after each advance; `progress(done, total)` counts samples. With `smooth`
    the solution at each sample uses all measurements, later ones too. Raises `TableError` for a
    file that is not of its stated kind, and for an outage of an unknown source; `ConfigError` for a
    filter that cannot be smoothed; `MissingPackageError` for a format whose package is not
    installed.
    """
    with _imports_left_alone():
        read = read_recorded(config, imu_path, measurements, outages or (), systems, can_log)
        return _process(read, out, watch, smooth, progress)


@contextmanager
def _imports_left_alone() -> Iterator[None]:
    """Exempt imported objects, above all numba's, from garbage collection: each collection would
    take a tenth of a second longer. New objects are collected less often than by default, since
    nearly all of them stay in use."""
    thresholds = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(YOUNG, *thresholds[1:])
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()


def _process(
    read: Recorded,
    out: Path | None,
    watch: Callable[[Navigator], None],
    smooth: bool,
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    config, imu, arrivals, events = read.config, read.imu, read.arrivals, read.events
    navigator = Navigator(
        config,
        on_event=lambda code, text: events.append({"code": code, "text": text}),
        estimator=_taped if smooth else estimator_of,
    )
    why = wrong_units(imu, config.imu, arrivals)
    writer = RowsWriter(out, navigator.model.stated) if out and why is None else None
    smoothed = _smoothed(navigator, writer) if smooth and writer is not None else None
    recorder = _Recorder(navigator, writer, smoothed, watch)
    if why is None:
        if read.units:
            _run_units(navigator, read, recorder, progress)
        else:
            _run(navigator, imu, arrivals, recorder, progress)
        recorder.close()
    mode, reason = navigator.mode(navigator.imu.latest_ns)
    if why is None and not recorder.rows:
        why = nothing_navigated(read.files, refusals_of(navigator), reason)
    return {
        **({} if smoothed is None else {"smoothed": smoothed.counts()}),
        "files": {name: _account(file) for name, file in read.files.items()},
        "sources": outcomes_of(navigator, read.withheld),
        "events": events,
        "solution_rows": recorder.rows,
        "solution_modes": dict(recorder.modes),
        "solution_from_s": recorder.first_s,
        "why": why,
        "apart": without_overlap(read.files),
        "aligned": None if navigator.started is None else navigator.started.how,
        "mode": str(mode),
        "reason": reason,
        "consistency": {
            name: asdict(report) for name, report in navigator.verdicts.reports().items()
        },
        "rewinds": navigator.timeline.counters.rewinds,
    }


# Load the smoother's kernels only when used.


def _taped(config: Config, model: Model, kinds: Sequence[Kind]) -> Estimator:
    from fusiond.offline.smooth import taped  # noqa: PLC0415

    return taped(config, model, kinds)


def _smoothed(navigator: Navigator, writer: RowsWriter) -> SmoothedRows:
    from fusiond.offline.smooth import SmoothedRows  # noqa: PLC0415

    return SmoothedRows(navigator, writer)


def refusals_of(navigator: Navigator) -> dict[str, Counter[str]]:
    """Rejections by source and name, including satellites of raw epochs."""
    found = {
        source: Counter(refused) for source, refused in navigator.outcome_watch.refused.items()
    }
    for source, receiver in navigator.raw.items():
        if receiver.refused:
            found.setdefault(source, Counter()).update(receiver.refused)
    return found


def outcomes_of(navigator: Navigator, withheld: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """Outcomes of each source's measurements, by name."""
    sources: dict[str, dict[str, int]] = {}
    for source, outcomes in navigator.timeline.counters.outcomes.items():
        sources[source] = {name: count for name, count in outcomes.items() if count}
    for source, refused in refusals_of(navigator).items():
        sources.setdefault(source, {}).update(refused)
    for source, count in withheld.items():
        if count:
            sources.setdefault(source, {})["withheld"] = count
    if navigator.imu.counters:
        sources["imu"] = dict(navigator.imu.counters)
    return sources


def _account(file: FileRead) -> dict[str, Any]:
    return {
        "rows": file.rows,
        "rejected": rejection_counts(file.rejected),
        "first_rejected": [str(r) for r in file.rejected[:_SHOWN]],
    }


def _run(
    navigator: Navigator,
    imu: ImuTable,
    arrivals: list[Arrival],
    recorder: _Recorder,
    progress: Callable[[int, int], None],
) -> None:
    times = np.rint(imu.t_s * 1e9).astype(np.int64)
    # A sample arrives at its stamp; the IMU's time offset shifts validity, not arrival. A sample
    # whose stamp goes back arrives after the previous one.
    came = np.maximum.accumulate(times)
    # Number of samples that have arrived before arrival k.
    breaks = np.searchsorted(came, [a.t_arrival_ns for a in arrivals], side="right").tolist()
    waits = _waits(arrivals, navigator.config)
    gap_ns = round(navigator.config.imu.gap_s * 1e9)
    tick_ns = round(1e9 / navigator.config.scheduler.rate_hz)
    done = given = reported = 0
    while done < len(times) or given < len(arrivals):
        if done - reported >= _REPORT_EVERY:
            reported = done
            progress(done, len(times))
        if navigator.started is None:
            # The daemon tries to align at each tick, with all input until then.
            begin = [int(t) for t in came[done : done + 1]]
            begin += [a.t_arrival_ns for a in arrivals[given : given + 1]]
            now_ns = -(-min(begin) // tick_ns) * tick_ns
            while given < len(arrivals) and arrivals[given].t_arrival_ns <= now_ns:
                _give(navigator, arrivals[given])
                given += 1
            upto = done + int(np.searchsorted(came[done : done + CHUNK], now_ns, side="right"))
            if upto > done:
                navigator.add_imu(times[done:upto], imu.samples[done:upto])
            navigator.advance(record=True)
            recorder.take()
            done = upto
            continue
        # Samples up to the next delayed arrival, which must find the filter at its arrival. An
        # arrival that is valid at once need not: the timeline keeps it until the samples reach it.
        ahead = given
        upto = min(len(times), done + CHUNK)
        alone = _has_gap(times[max(done - 1, 0) : upto], gap_ns)
        while ahead < len(arrivals) and breaks[ahead] <= upto:
            if alone or waits[ahead]:
                upto = breaks[ahead]
                break
            ahead += 1
        for arrival in arrivals[given:ahead]:
            _give(navigator, arrival)
        if upto > done:
            navigator.add_imu(times[done:upto], imu.samples[done:upto])
        navigator.advance(record=True)
        recorder.take()
        given, done = ahead, upto
        if given < len(arrivals) and breaks[given] <= done and (alone or waits[given]):
            _give(navigator, arrivals[given])
            given += 1
            navigator.advance(record=True)
            recorder.take()


def _run_units(
    navigator: Navigator,
    read: Recorded,
    recorder: _Recorder,
    progress: Callable[[int, int], None],
) -> None:
    """Run two inertial units tick by tick, as in the daemon."""
    units, arrivals = read.units, read.arrivals
    choice = ImuChoice(
        read.config.imu, lambda _, code, text: read.events.append({"code": code, "text": text})
    )
    tick_ns = round(1e9 / read.config.scheduler.rate_hz)
    seen = [units[k][1].t_seen_ns for k in (0, -1)] + [a.t_arrival_ns for a in arrivals[-1:]]
    taken = given = 0
    for k in range(seen[0] // tick_ns, max(seen) // tick_ns + 2):
        now_ns = k * tick_ns
        while given < len(arrivals) and arrivals[given].t_arrival_ns <= now_ns:
            _give(navigator, arrivals[given])
            given += 1
        while taken < len(units) and units[taken][1].t_seen_ns <= now_ns:
            choice.take(units[taken][1], units[taken][0])
            taken += 1
        if choice.changes(now_ns, navigator.imu.latest_ns if navigator.imu.end else None):
            navigator.change_imu()
        if (arrived := choice.samples()) is not None:
            navigator.add_imu(*arrived)
        navigator.advance(record=True)
        recorder.take()
        if taken % _REPORT_EVERY < 2:
            progress(taken, len(units))


def _give(navigator: Navigator, arrival: Arrival) -> None:
    m: Any = arrival.measurement
    if isinstance(m, BROADCAST):
        navigator.learn(m)
        return
    t_ns = valid_ns(m)
    if arrival.utc_ns is not None:  # a compass's declination depends on the date
        m = replace(m, stamp=UtcStamp(arrival.utc_ns))
    navigator.add(m, t_ns, arrival.sd_time_s, arrival.t_arrival_ns)


def _waits(arrivals: Sequence[Arrival], config: Config) -> list[bool]:
    """True for each arrival that is preceded by samples later than its validity, or than that of a
    measurement in it."""
    ahead = config.imu.time_offset_s > 0.0
    delayed = {
        source
        for source, section in config.aiding.items()
        if (isinstance(section, GnssAiding) and section.velocity_delay_s > 0.0)
        or (isinstance(section, WheelAiding) and section.latency_s > 0.0)
    }

    def is_delayed(t_ns: int, m: Measurement | RawEvent) -> bool:
        if isinstance(m, BROADCAST):
            return False
        if isinstance(m, RawGnssEpoch):
            return True  # corrected for the filter's present position
        return ahead or m.source in delayed or valid_ns(m) < t_ns

    return [is_delayed(arrival.t_arrival_ns, arrival.measurement) for arrival in arrivals]


def _has_gap(times: NDArray[np.int64], gap_ns: int) -> bool:
    return len(times) > 0 and longest_step(times, int(times[0]))[0] > gap_ns


class _Recorder:
    """Recorder of each sample's first solution, with counts, modes and start."""

    def __init__(
        self,
        navigator: Navigator,
        writer: RowsWriter | None,
        smoothed: SmoothedRows | None,
        watch: Callable[[Navigator], None],
    ) -> None:
        self._navigator = navigator
        self._writer = writer
        self.smoothed = smoothed
        self._watch = watch
        self._next = 0
        self.rows = 0
        self.modes: Counter[str] = Counter()
        self.first_s: float | None = None

    def take(self) -> None:
        navigator = self._navigator
        self._watch(navigator)
        if self.smoothed is not None:
            self.smoothed.follow()
        if navigator.started is None:
            return
        imu, passed = navigator.imu, navigator.estimator.sample
        first = max(self._next, imu.index_after(navigator.started.t_ns) + imu.start)
        if passed <= first:
            return
        rows = slice(first - imu.start, passed - imu.start)
        count = passed - first
        self._next = passed
        mode, _ = navigator.mode(int(imu.times[rows.stop - 1]))
        self.rows += count
        self.modes[str(mode)] += count
        if self.first_s is None:
            self.first_s = float(imu.times[rows.start] * 1e-9)
        if self._writer is None:
            return
        status = np.full(count, STATUS.index(mode), dtype=np.int64)
        taken = Rows(imu.times[rows], imu.nav[rows], imu.sigmas[rows], status)
        if self.smoothed is None:
            self._writer.write(taken)
        else:
            self.smoothed.take(first, taken)

    def close(self) -> None:
        """Write the remaining rows."""
        if self.smoothed is not None:
            self.smoothed.close()
        if self._writer is not None:
            self._writer.close()
