"""`fusiond demo`: the real daemon against a simulated car, with a broker of its own.

The car stands for 8 s (levelling), drives off (heading from the GNSS course), and loses its GNSS
receiver for 12 s of every minute, with RDSS and inertial navigation continuing. The display shows
the broker's messages, as a dashboard would, beside the true error.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import aiomqtt
import numpy as np
from numpy.typing import NDArray

from drivers.base import monotonic_ns
from drivers.shipped_files import shipped
from fusiond.configuration.load import load_config
from fusiond.configuration.position_reports import PositionReports
from fusiond.configuration.recording import Recording
from fusiond.demo.broker import DemoBroker
from fusiond.demo.dashboard_process import DemoPage
from fusiond.demo.outage_report import outage_report
from fusiond.demo.papers import paper_setup
from fusiond.demo.scenario import DemoSetup, Unplugged
from fusiond.demo.terminal_view import HeadlessView, Live, LiveView
from fusiond.live.daemon import Daemon
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.papers import town
from fusiond.simulation.rdss.short_messages import ConvoyVehicle
from fusiond.simulation.scenarios import SCENARIOS

Array = NDArray[np.float64]

CONFIG = shipped("vehicle.toml")
VEHICLE = "demo"
OUTAGE_START_S, OUTAGE_S, OUTAGE_EVERY_S = 18.0, 12.0, 60.0
SERVICE_FREQUENCY_S = 5
"""Service interval of the simulated RDSS card: several fixes in an outage (a civil card has 60 s).
"""
REPORTS_S = 30.0
"""Interval of position reports to the convoy's other vehicle: every sixth turn of the card."""
_SCORE_NS = 100_000_000
"""Spacing of the solutions that the summary compares with the truth."""


def demo(
    duration_s: float,
    headless: bool,
    record: Path | None = None,
    dashboard: bool = False,
    paper: str | None = None,
) -> dict[str, Any]:
    """Run for `duration_s` or until Ctrl-C and return a summary. The folder `record` receives a
    recording. With `dashboard` the view shows the address of a page. `paper` is a number of
    `fusiond.simulation.papers`; the summary then begins with its number, filter and model.

    `horizontal_rms_m` and `yaw_rms_deg` compare each tenth of a second of navigation with the
    truth; `nees` is the mean horizontal normalised estimation error squared, e^T P^-1 e with the
    full 2x2 covariance: two degrees of freedom, 2 when sigma is honest (errors of one short run are
    correlated, so 0.5 to 5 is common). All three are None without navigation. `fused` and
    `rejected` count measurements (IMU samples are in `fused_by_source`). Raises `DemoError` if a
    package is missing.
    """
    with (
        DemoBroker() as broker,
        tempfile.TemporaryDirectory(prefix="fusiond-demo-") as folder,
        DemoPage(broker.port) if dashboard else contextlib.nullcontext() as page,
        _log_kept_out(headless),
    ):
        play = demo_setup(paper)
        live = Live(duration_s, broker.port, VEHICLE, page.address if page else None)
        live.aligning = play.aligning
        view = HeadlessView(sys.stderr) if headless else LiveView()
        return asyncio.run(_Run(play, live, view, Path(folder), record).drive())


def demo_setup(paper: str | None = None) -> DemoSetup:
    """Set up the shipped car in town streets, with its receiver unplugged once a minute, or the
    vehicle of a `paper` of `fusiond.simulation.papers`."""
    if paper is not None:
        return paper_setup(paper)
    reports = PositionReports(card=ConvoyVehicle.CARD, interval_s=REPORTS_S)
    config = load_config(CONFIG).model_copy(
        update={"vehicle": VEHICLE, "position_reports": reports}
    )
    scenario = replace(SCENARIOS["drive"].fitted(config), path=town)
    rdss = replace(scenario.rdss, service_frequency_s=SERVICE_FREQUENCY_S, convoy=True)
    pulled = Unplugged("gnss", OUTAGE_START_S, OUTAGE_S, OUTAGE_EVERY_S)
    return DemoSetup(config, replace(scenario, rdss=rdss), ("imu", "gnss", "rdss"), pulled)


class View(Protocol):
    """Display of messages that arrive from the broker."""

    async def show(self, live: Live) -> None:
        """Show until cancelled."""


class _Run:
    def __init__(
        self, play: DemoSetup, live: Live, view: View, folder: Path, record: Path | None
    ) -> None:
        self._play = play
        self._duration_s = duration_s = live.duration_s
        self._port = live.port
        config = play.served(live.port, folder)
        if record is not None:
            recording = Recording(directory=record.absolute())
            config = config.model_copy(update={"recording": recording})
        self._vehicle = play.vehicle(duration_s + 10.0, folder)
        self._score = Score()
        self._without_gnss: list[tuple[int, int]] = []
        self._daemon = Daemon(config, on_solution=self._on_solution)
        publisher = self._daemon.outputs["mqtt"]
        assert isinstance(publisher, MqttPublisher), "the demo's configuration has a broker"
        publisher.begin_with_3_1_1()  # amqtt says nothing to 5: a second in which `nav` is lost
        self._live = live
        self._view = view

    async def drive(self) -> dict[str, Any]:
        """Drive until the end, Ctrl-C or SIGTERM and return the summary."""
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stop.set)
        started = time.monotonic()
        daemon = asyncio.create_task(self._daemon.run(stop), name="daemon")
        others = [
            asyncio.create_task(self._vehicle.run(), name="vehicle"),
            asyncio.create_task(self._subscribe(), name="subscriber"),
            asyncio.create_task(self._outages(), name="outages"),
            asyncio.create_task(self._view.show(self._live), name="view"),
        ]
        ended = asyncio.create_task(stop.wait())
        try:
            done, _ = await asyncio.wait(
                [daemon, *others, ended],
                timeout=self._duration_s,
                return_when=asyncio.FIRST_COMPLETED,
            )
            duration_s = time.monotonic() - started
            for task in done:
                task.result()
        finally:
            stop.set()
            for task in (*others, ended):
                task.cancel()
            await asyncio.gather(*others, ended, return_exceptions=True)
            await asyncio.wait([daemon])
        daemon.result()
        self._print_outages()
        return self._summary(duration_s)

    def _on_solution(self, solution: Solution) -> None:
        self._score.add(solution, self._daemon.navigator.active_filter.covariance)

    async def _subscribe(self) -> None:
        """Subscribe to the vehicle's topics as a dashboard does."""
        base = f"fusiond/{VEHICLE}/"
        async with aiomqtt.Client(
            "127.0.0.1", self._port, identifier="fusiond-demo-view"
        ) as client:
            await client.subscribe(base + "#")
            async for message in client.messages:
                if isinstance(message.payload, bytes):
                    topic = message.topic.value.removeprefix(base)
                    self._live.message(topic, message.payload)
                    if topic == "nav":
                        self._compare()

    def _compare(self) -> None:
        """Compute the true error of the last `nav`, at the UTC instant that it states."""
        nav = self._live.nav
        if nav.get("t_ms") is None or nav.get("lat_deg") is None:
            return
        truth = self._vehicle.truth.at(
            np.array([nav["t_ms"] * 1e-3 - self._vehicle.utc_start_ns * 1e-9])
        )
        position = np.radians([[nav["lat_deg"], nav["lon_deg"], 0.0]])
        position[:, 2] = math.nan if nav["height_m"] is None else nav["height_m"]
        angles_deg = [nav["roll_deg"], nav["pitch_deg"], nav["yaw_deg"]]
        rpy = np.radians([math.nan if x is None else x for x in angles_deg]) - truth.rpy[0]
        velocity = np.array([nav["v_n_m_s"], nav["v_e_m_s"], nav["v_d_m_s"]]) - truth.v_ned[0]
        self._live.errors = [
            *ned_error(position, truth.position)[0],
            *velocity,
            *np.degrees(wrapped(rpy)),
        ]

    async def _outages(self) -> None:
        """Unplug the scenario's device and plug it in again at its times."""
        loop = asyncio.get_running_loop()
        started = loop.time()
        pulled = self._play.pulled
        for start_s, end_s in pulled.times(self._duration_s) if pulled else ():
            assert pulled is not None
            await asyncio.sleep(started + start_s - loop.time())
            self._vehicle.unplug(pulled.device)
            pulled_ns = monotonic_ns()
            self._live.outage = pulled.device, time.monotonic() + end_s - start_s
            await asyncio.sleep(started + end_s - loop.time())
            self._vehicle.plug(pulled.device)
            self._live.outage = None
            if pulled.device == "gnss":
                self._without_gnss.append((pulled_ns, monotonic_ns()))
        await asyncio.Event().wait()

    def _summary(self, duration_s: float) -> dict[str, Any]:
        daemon = self._daemon
        mqtt = daemon.outputs["mqtt"].counters
        scheduler = daemon.scheduler.status()
        health = daemon.sources.health(daemon.clock.now_ns())
        return {
            **self._play.paper,
            "duration_s": round(duration_s, 3),
            "ticks": scheduler.ticks,
            "overruns": scheduler.overruns,
            "lateness_p99_ms": round(scheduler.lateness_p99_ms, 3),
            **self._score.against(self._vehicle),
            "mqtt_published": mqtt["mqtt_published"],
            "mqtt_dropped": mqtt["mqtt_dropped"],
            "fused": sum(s.fused for n, s in health.items() if n != "imu"),
            "rejected": sum(sum(s.rejected.values()) for s in health.values()),
            "fused_by_source": {name: source.fused for name, source in health.items()},
            "rejected_by_source": {name: source.rejected for name, source in health.items()},
        }

    def _print_outages(self) -> None:
        """Report an event on standard error: the last line of the output is the summary."""
        t_s, error_m, sigma_m = self._score.horizontal(self._vehicle)
        start_ns = self._vehicle.start_ns
        outages = [((a - start_ns) * 1e-9, (b - start_ns) * 1e-9) for a, b in self._without_gnss]
        for sentence in outage_report(t_s, error_m, sigma_m, outages):
            print(sentence, file=sys.stderr)


class Score:
    """Solutions of the running daemon at 10 Hz, compared with the truth at the end."""

    def __init__(self) -> None:
        self._last = 0
        self._rows: list[tuple[float, ...]] = []

    def add(self, s: Solution, covariance: Array) -> None:
        """Add a solution with P (n, n); slots 6 and 7 are north and east."""
        if s.mode not in (Mode.NAVIGATING, Mode.COASTING) or s.t_ns // _SCORE_NS == self._last:
            return
        self._last = s.t_ns // _SCORE_NS
        p = covariance
        cov = float(p[6, 6]), float(p[6, 7]), float(p[7, 7])
        self._rows.append((s.t_ns, s.lat_rad, s.lon_rad, s.height_m, s.rpy_rad[2], *cov))

    def horizontal(self, vehicle: SimulatedVehicle) -> tuple[Array, Array, Array]:
        """Instants (vehicle's clock, s), true horizontal errors and one sigma (m), each (n,)."""
        rows = np.array([r[1:] for r in self._rows]).reshape(-1, 7)
        t_s = np.array([r[0] - vehicle.start_ns for r in self._rows]) * 1e-9
        if not len(t_s):
            return t_s, t_s, t_s
        error = ned_error(rows[:, :3], vehicle.truth.at(t_s).position)[:, :2]
        return t_s, np.linalg.norm(error, axis=1), np.sqrt(rows[:, 4] + rows[:, 6])

    def against(self, vehicle: SimulatedVehicle) -> dict[str, float | None]:
        """Score against the truth: `horizontal_rms_m`, `yaw_rms_deg`, `nees`."""
        if not self._rows:
            return {"horizontal_rms_m": None, "yaw_rms_deg": None, "nees": None}
        rows = np.array([r[1:] for r in self._rows])
        t_s = np.array([r[0] - vehicle.start_ns for r in self._rows]) * 1e-9
        truth = vehicle.truth.at(t_s)
        north, east = ned_error(rows[:, :3], truth.position)[:, :2].T
        known = ~np.isnan(rows[:, 3])
        yaw = wrapped(rows[known, 3] - truth.rpy[known, 2])
        a, b, c = rows[:, 4:].T
        nees = (c * north**2 - 2.0 * b * north * east + a * east**2) / (a * c - b * b)
        return {
            "horizontal_rms_m": round(float(np.sqrt(np.mean(north**2 + east**2))), 4),
            "yaw_rms_deg": round(float(np.degrees(np.sqrt(np.mean(yaw**2)))), 4)
            if len(yaw)
            else None,
            "nees": round(float(np.mean(nees)), 4),
        }


def ned_error(position: Array, truth: Array) -> Array:
    """Position error north, east, down in m; positions are (n, 3) in rad, rad, m."""
    error = np.empty_like(position)
    for row, (p, t) in enumerate(zip(position, truth, strict=True)):
        lat, height = float(t[0]), float(t[2])
        error[row] = (
            (p[0] - lat) * (meridian_radius(lat) + height),
            wrapped(p[1] - t[1]) * (transverse_radius(lat) + height) * math.cos(lat),
            height - p[2],
        )
    return error


def wrapped(angle: Array) -> Array:
    """Angles wrapped into [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


@contextlib.contextmanager
def _log_kept_out(headless: bool) -> Iterator[None]:
    """Keep the log off the terminal, which shows events itself; headless, print errors only."""
    log = logging.getLogger("fusiond")
    handler = logging.StreamHandler(sys.stderr) if headless else logging.NullHandler()
    handler.setLevel(logging.ERROR)
    propagate, log.propagate = log.propagate, False
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.propagate = propagate
