"""The demo's car, recorded in time of its own: its simulated devices feed the rig."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from fusiond.configuration.schema import Config
from fusiond.demo.demo import demo_setup
from fusiond.simulation.live_devices import SimulatedVehicle
from tests.clock.host_time import MS, Host
from tests.recording.rig import Rig


class Drive(Rig):
    """The demo's car with recording into `folder`; `run` drives on.

    `unplugged` devices send nothing.
    """

    def __init__(
        self, folder: Path, duration_s: float, config: Config | None = None, **options: Any
    ) -> None:
        play = demo_setup()
        config = config or play.served(1, folder)
        scenario = play.scenario.fitted(config)
        self.vehicle = SimulatedVehicle(scenario, seed=3, duration_s=duration_s)
        host = Host()
        self._start_ns = self.vehicle.start_ns = host.mono + 500 * MS
        utc_ns = host.utc(self._start_ns)
        self.vehicle.utc_start_ns = self.vehicle.terminal.utc_start_ns = utc_ns
        self.unplugged: set[str] = set()
        self._next_imu = self._next_gnss = 0
        super().__init__(folder, config, host, **options)
        self._hear_requests()

    def _hear_requests(self) -> None:
        """What the driver sends goes to the terminal, and where it goes anyhow."""
        inputs = self.inputs["rdss"]
        recorded = inputs.on_input

        def heard(kind: str, t_ns: int, payload: Any) -> None:
            if kind == "sent":
                self.vehicle.terminal.receive(payload, self.t_s)
            if recorded is not None:
                recorded(kind, t_ns, payload)

        inputs.on_input = heard

    @property
    def t_s(self) -> float:
        """Of the vehicle's drive."""
        return (self.host.mono - self._start_ns) * 1e-9

    def run(self, until_s: float, at_tick: Callable[[int], None] | None = None) -> None:
        """Drive until `until_s` of the drive."""
        self.run_to(self._start_ns + round(until_s * 1e9), at_tick)

    def serve(self, until_ns: int) -> None:
        vehicle, until_s = self.vehicle, (until_ns - self._start_ns) * 1e-9
        while vehicle.truth.t_s[self._next_imu + 1] <= until_s:
            k = self._next_imu
            self._next_imu += 1
            if "imu" not in self.unplugged:
                t_ns = round(float(vehicle.truth.t_s[k + 1]) * 1e9)
                gyro, accel = vehicle.imu.gyro[k].tolist(), vehicle.imu.accel[k].tolist()
                for m in vehicle.encoder.frames(k + 1, t_ns, gyro, accel):
                    self.frame("imu", m.arbitration_id, m.is_extended_id, bytes(m.data))
        while vehicle.gnss.t_arrival_s[self._next_gnss] <= until_s:
            sentences = vehicle.gnss.nmea(self._next_gnss, vehicle.utc_start_ns)
            self._next_gnss += 1
            if "gnss" not in self.unplugged:
                self.take("gnss", "read", sentences[:40])  # boundaries fall where they fall
                self.take("gnss", "read", sentences[40:])
                self.take("gnss", "silence")
        self.take("rdss", "due")
        if data := vehicle.terminal.read(until_s):
            self.take("rdss", "read", data)
