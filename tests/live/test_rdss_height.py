"""The height that a request for a fix gives, by the daemon on a pseudo terminal: the filter's with
its sigma, or the pressure of the vehicle's own barometer."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

import pytest

from drivers.can.height import CanHeightDecoder
from drivers.can.python_can_import import can
from drivers.measurements import DelayedFix
from drivers.rdss.messages import HeightMode, PositionRequest
from drivers.standard_atmosphere import standard_pressure_pa
from fusiond.clock.stamp_mapping import Instant
from fusiond.live.daemon import Daemon
from fusiond.live.sources import Emitted
from fusiond.simulation.can.encoder import CanEncoder
from fusiond.simulation.can.star_tracker_radar import SIM_BAROMETER
from fusiond.simulation.live_devices import SimulatedVehicle
from tests.live.daemon_bench import NO_MQTT, PARKED, RDSS, REST, Bench, running
from tests.patience import until

FAST = replace(REST, rdss=replace(REST.rdss, service_frequency_s=1))
HEIGHT_M = REST.origin_deg_m[2]
BAROMETER = """
[sources.barometer]
driver = "can_height"
interface = "virtual"
channel = "{channel}"
dbc = "fusiond_sim_aids"
pressure = "BAROMETER.PRESSURE"
accuracy = "BAROMETER.SIGMA"
counter = "BAROMETER.BAROMETER_COUNTER"
"""


class Heard:
    """Requests that the terminal has taken, and fixes that the daemon has."""

    def __init__(self, daemon: Daemon, vehicle: SimulatedVehicle) -> None:
        self.requests: list[PositionRequest] = []
        self.fixes: list[DelayedFix] = []
        terminal = vehicle.terminal
        answer = terminal._position

        def position(request: PositionRequest, t_s: float) -> None:
            self.requests.append(request)
            answer(request, t_s)

        def arrived(item: Emitted, instant: Instant) -> None:
            if isinstance(item, DelayedFix):
                self.fixes.append(item)

        terminal._position = position  # type: ignore[method-assign]
        daemon.sources.on_arrival = arrived

    def modes(self) -> set[HeightMode]:
        return {request.height_mode for request in self.requests}


async def test_a_request_gives_the_filters_height_and_the_fix_has_its_sigma(bench: Bench) -> None:
    vehicle = bench.vehicle(FAST, gnss_link=bench.folder / "gnss", rdss_link=bench.folder / "rdss")
    heard = Heard(bench.daemon(RDSS, NO_MQTT), vehicle)
    async with running(bench.made, vehicle):
        await bench.mode(PARKED)
        await until(lambda: any(fix.height_given for fix in heard.fixes))
    # Before it navigates it has nothing to give: the centre's terrain model.
    assert heard.requests[0].height_mode is HeightMode.NONE
    given = [r.height_m for r in heard.requests if r.height_mode is HeightMode.GIVEN]
    # The antenna's, a metre above the inertial unit.
    assert given == pytest.approx([HEIGHT_M + 1.0] * len(given), abs=10.0)
    sigmas = [fix.height_sd_m for fix in heard.fixes if fix.height_given]
    assert all(sd is not None and 0.3 < sd < 10.0 for sd in sigmas)
    assert not heard.fixes[0].height_given
    assert heard.fixes[0].height_sd_m is None


@asynccontextmanager
async def air(channel: str, pressure_pa: float) -> AsyncIterator[None]:
    """A barometer's frames, five a second."""
    encoder = CanEncoder(CanHeightDecoder("barometer", SIM_BAROMETER))
    with can.Bus(interface="virtual", channel=channel) as bus:

        async def send() -> None:
            for number in itertools.count():
                for frame in encoder.frames(number, 0, (pressure_pa, 0.2)):
                    bus.send(frame)
                await asyncio.sleep(0.2)

        task = asyncio.create_task(send())
        try:
            yield
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


async def test_without_a_height_a_request_gives_the_barometers_pressure(bench: Bench) -> None:
    own = RDSS + "use_solution_height = false\nuse_barometer = true\n"
    channel = str(bench.imu.channel)
    vehicle = bench.vehicle(FAST, gnss_link=bench.folder / "gnss", rdss_link=bench.folder / "rdss")
    daemon = bench.daemon(own, BAROMETER.format(channel=channel), NO_MQTT)
    heard = Heard(daemon, vehicle)
    pressure = standard_pressure_pa(HEIGHT_M)
    async with running(daemon, vehicle), air(channel, pressure):
        await until(
            lambda: (
                any(r.height_mode is HeightMode.ALTIMETER_1 for r in heard.requests[:-1])
                and any(fix.height_given for fix in heard.fixes)
            )
        )
    assert heard.modes() <= {HeightMode.NONE, HeightMode.ALTIMETER_1}
    said = [r for r in heard.requests if r.height_mode is HeightMode.ALTIMETER_1]
    assert [r.pressure_pa for r in said] == pytest.approx([pressure] * len(said), abs=1.0)
    # Its own height it would only get back, and a pressure states no sigma.
    by_pressure = [fix for fix in heard.fixes if fix.height_given]
    assert all(fix.height_sd_m is None for fix in by_pressure)
    assert by_pressure[-1].height_m == pytest.approx(HEIGHT_M, abs=3.0)
