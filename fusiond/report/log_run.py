"""Run from a log: data of its channels, and statistics of its input."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from math import isnan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fusiond.clock.host import MILLISECOND_NS, SECOND_NS
from fusiond.files.csv_tables import Floats
from fusiond.files.measurement_csv import TrajectoryTable
from fusiond.recording.channels import INNOVATION, STATE
from fusiond.recording.info import info
from fusiond.recording.log_metadata import CONFIG
from fusiond.recording.reader import Log, LogMessage
from fusiond.recording.records import Record
from fusiond.report.bias_states import Biases
from fusiond.report.channel_arrays import (
    Calibrations,
    FaultLists,
    Healths,
    InnovationLists,
    VerdictLists,
    number,
)
from fusiond.report.input_timing_and_spectrum import InputStatistics
from fusiond.report.run import Event, LogParts, Problem, Run
from fusiond.report.settings import changed_settings

_POSITION = ("lat_deg", "lon_deg", "height_m")
_VELOCITY = ("v_n_m_s", "v_e_m_s", "v_d_m_s")
_ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
_SD = (
    *("sd_n_m", "sd_e_m", "sd_d_m"),
    *("sd_vn_m_s", "sd_ve_m_s", "sd_vd_m_s"),
    *("sd_roll_deg", "sd_pitch_deg", "sd_yaw_deg"),
)
_MOST_NAMED = 5
"""Gaps and steps that the banner names one by one."""


class _TappedLog(Log):
    """Log whose messages and records are also passed to a listener while another reader reads
    it."""

    def __init__(self, paths: Sequence[Path]) -> None:
        super().__init__(paths)
        self.on_message: Callable[[LogMessage], None] = lambda message: None
        self.on_record: Callable[[Record], None] = lambda record: None

    def messages(self, *topics: str) -> Iterator[LogMessage]:
        for message in super().messages(*topics):
            if not topics:
                self.on_message(message)
            yield message

    def records(self) -> Iterator[Record]:
        for record in super().records():
            self.on_record(record)
            yield record


def run_from_log(paths: Sequence[Path]) -> Run:
    """Raises `LogError`, OSError."""
    log = _TappedLog(paths)
    reader = _Channels(log)
    log.on_message = reader.read
    with TemporaryDirectory(prefix="fusiond-report-") as folder:
        look = InputStatistics(log.about, Path(folder))
        log.on_record = look.read
        known = info(log)  # reads all messages, then all records
    problems = [Problem("error", text) for text in known["problems"]]
    problems += _log_problems(known)
    parts = reader.parts()
    parts.tick_delay_ms, parts.imu = look.tick_delay_ms(), look.imu()
    run = Run(log.paths[0].name, reader.solution(), posix=True, log=parts)
    run.events = reader.events
    run.truth_offset_s = reader.utc_ahead_s()
    run.facts = _facts(log, known)
    run.differs = changed_settings(log.about.attachments.get(CONFIG))
    if reader.unreadable:
        problems.append(Problem("error", f"{reader.unreadable} messages are no JSON objects"))
    if reader.dropped:
        text = f"the disk was too slow for {reader.dropped} messages, which are not in the log"
        problems.append(Problem("error", text))
    if not len(run.solution.t_s):
        problems.append(Problem("error", "it holds no solution (/nav)"))
    run.problems = problems
    return run


def _log_problems(known: dict[str, Any]) -> list[Problem]:
    problems = []
    if not known["from_the_daemons_start"]:
        text = "it begins on the way: counters of `health` are since the daemon's start, before it"
        problems.append(Problem("warning", text))
    for what, name, unit in (("gaps", "no tick for", "length_s"), ("clock_steps", "", "step_s")):
        found = known[what]
        for one in found[:_MOST_NAMED]:
            text = f"{name} {one[unit]:.3f} s after" if name else f"{one[unit]:+.3f} s at"
            head = "" if name else "the system clock stepped by "
            problems.append(Problem("warning", f"{head}{text} {one['t_utc']}"))
        if len(found) > _MOST_NAMED:
            problems.append(Problem("warning", f"and {len(found) - _MOST_NAMED} more such {what}"))
    return problems


def _facts(log: Log, known: dict[str, Any]) -> list[tuple[str, str]]:
    about = log.about.metadata
    packages = ("python", "numpy", "numba", "scipy", "mcap")
    overruns = f"{known['overruns']} of {known['ticks'] + known['overruns']}"
    return [
        ("files", ", ".join(path.name for path in log.paths)),
        ("size", f"{known['bytes'] * 1e-6:.1f} MB, {known['mb_per_hour'] or 0:.0f} MB an hour"),
        ("from", f"{known['begin_utc']} UTC"),
        ("to", f"{known['end_utc']} UTC"),
        ("vehicle", about["vehicle"]),
        ("fusiond", about.get("version", "")),
        ("packages", ", ".join(f"{name} {about.get(name, '?')}" for name in packages)),
        ("host", f"{about.get('host', '')}, {about.get('system', '')}"),
        ("processor", about.get("processor", "")),
        ("configuration", about.get("config_digest", "")),
        ("ticks left out (overruns)", overruns),
    ]


class _Channels:
    """Collector of the JSON channels' messages, in order."""

    def __init__(self, log: Log) -> None:
        self._epoch_ns = log.about.epoch_ns
        self._nav: list[tuple[float, ...]] = []
        self._modes: list[str] = []
        self._utc_ahead: list[float] = []
        self.events: list[Event] = []
        self.unreadable = self.dropped = 0
        self._innovations = InnovationLists(self._epoch_ns)
        self._verdicts = VerdictLists()
        self._health = Healths()
        self._faults = FaultLists()
        self._calibration = Calibrations()
        self._biases = Biases(log.about.attachments.get(CONFIG))
        self._readers: dict[str, Callable[[float, dict[str, Any]], None]] = {
            "/nav": self._nav_message,
            "/event": self._event,
            "/status": self._status,
            "/health": self._health.read,
            "/consistency": self._verdicts.read,
            "/calibration": self._calibration.read,
            STATE: self._biases.read,
            INNOVATION: self._innovations.read,
        }
        self._sources = log.about.sources

    def read(self, message: LogMessage) -> None:
        reader = self._readers.get(message.topic)
        if reader is None:
            return
        try:
            said = message.json()
        except ValueError:
            said = None
        if not isinstance(said, dict):
            self.unreadable += 1
            return
        reader(message.t_log_ns / SECOND_NS, said)

    def _nav_message(self, t_s: float, said: dict[str, Any]) -> None:
        if self._nav and t_s <= self._nav[-1][0]:
            return  # a table's times increase
        names = (*_POSITION, *_VELOCITY, *_ANGLES, *_SD)
        self._nav.append((t_s, *(number(said.get(name)) for name in names)))
        self._modes.append(str(said.get("mode", "")))
        t_ms = number(said.get("t_ms"))
        if not isnan(t_ms):
            self._utc_ahead.append(t_ms * MILLISECOND_NS / SECOND_NS - t_s)

    def _event(self, t_s: float, said: dict[str, Any]) -> None:
        level, code, source, text = (
            str(said.get(k, "")) for k in ("level", "code", "source", "text")
        )
        self.events.append(Event(t_s, level, code, source, text))

    def _status(self, t_s: float, said: dict[str, Any]) -> None:
        self._faults.read(t_s, said)
        dropped = number(said.get("recording_dropped"))
        self.dropped = self.dropped if isnan(dropped) else int(dropped)

    def utc_ahead_s(self) -> float:
        """Offset of the daemon's UTC from the log's own time."""
        return float(np.median(self._utc_ahead)) if self._utc_ahead else 0.0

    def solution(self) -> TrajectoryTable:
        rows: Floats = np.array(self._nav, dtype=np.float64).reshape(len(self._nav), 19)
        return TrajectoryTable(
            t_s=rows[:, 0],
            lat_rad=np.radians(rows[:, 1]),
            lon_rad=np.radians(rows[:, 2]),
            height_m=rows[:, 3],
            v=rows[:, 4:7],
            rpy=np.radians(rows[:, 7:10]),
            sd_position=rows[:, 10:13],
            sd_v=rows[:, 13:16],
            sd_rpy=np.radians(rows[:, 16:19]),
            status=self._modes,
            rejected=[],
        )

    def parts(self) -> LogParts:
        return LogParts(
            outcomes=self._health.outcomes,
            counters=self._health.counters,
            service=self._health.service,
            faults=self._faults.found,
            innovations=self._innovations.by_source(),
            verdicts=self._verdicts.by_source(),
            biases=self._biases.by_axis(),
            calibration=self._calibration.by_name(),
            sky=self._health.sky(),
            latency=self._health.latency(),
            usage=self._health.usage(),
            sources=self._sources,
        )
