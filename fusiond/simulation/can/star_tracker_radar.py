"""Star tracker and radar of the simulated vehicle on its CAN bus."""

from __future__ import annotations

from collections import Counter
from typing import Any

from drivers.can.attitude_bearing import (
    CanAttitudeDecoder,
    CanAttitudeOptions,
    CanBearingDecoder,
    CanBearingOptions,
)
from drivers.can.decoder import CanDecoder
from drivers.can.height import CanHeightOptions
from drivers.can.python_can_import import can
from fusiond.simulation.barometer import BarometerOptions
from fusiond.simulation.can.encoder import CanEncoder
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.star_tracker_radar import (
    SarOptions,
    SarRadar,
    StarTracker,
    StarTrackerOptions,
    sensor_streams,
)

SIM_STAR = CanAttitudeOptions(
    interface="virtual",
    channel="fusiond-sim",
    dbc="fusiond_sim_aids",
    rpy=("STAR_ATTITUDE.ROLL", "STAR_ATTITUDE.PITCH", "STAR_ATTITUDE.YAW"),
    sd_rpy=("STAR_SIGMA.SD_ROLL", "STAR_SIGMA.SD_PITCH", "STAR_SIGMA.SD_YAW"),
    valid="STAR_SIGMA.VALID",
    counter=("STAR_ATTITUDE.ATTITUDE_COUNTER", "STAR_SIGMA.SIGMA_COUNTER"),
    latency_s=StarTrackerOptions().latency_s,
)
SIM_SAR = CanBearingOptions(
    interface="virtual",
    channel="fusiond-sim",
    dbc="fusiond_sim_aids",
    azimuth="SAR_BEARING.AZIMUTH",
    elevation="SAR_BEARING.ELEVATION",
    target="SAR_BEARING.TARGET",
    sd_azimuth="SAR_SIGMA.SD_AZIMUTH",
    sd_elevation="SAR_SIGMA.SD_ELEVATION",
    valid="SAR_SIGMA.VALID",
    counter=("SAR_BEARING.BEARING_COUNTER", "SAR_SIGMA.SIGMA_COUNTER"),
    latency_s=SarOptions().latency_s,
)
SIM_BAROMETER = CanHeightOptions(
    interface="virtual",
    channel="fusiond-sim",
    dbc="fusiond_sim_aids",
    pressure="BAROMETER.PRESSURE",
    accuracy="BAROMETER.SIGMA",
    counter="BAROMETER.BAROMETER_COUNTER",
    latency_s=BarometerOptions().latency_s,
)
"""The simulation's own devices: `config/dbc/fusiond_sim_aids.dbc`, 1.3 arcsec a step."""


class CanSensor:
    """Sensor that sends its epochs on time, over its own connection to the bus."""

    def __init__(
        self,
        name: str,
        sensor: StarTracker | SarRadar,
        decoder: CanDecoder[Any],
        bus: tuple[str, str],
    ) -> None:
        self.name, self.sensor = name, sensor
        self._encoder = CanEncoder(decoder)
        self._where = bus
        self._bus: can.BusABC | None = None
        self._next = 0

    def plug(self) -> None:
        """Connect to the bus. Raises OSError, can.CanError."""
        if self._bus is None:
            interface, channel = self._where
            self._bus = can.Bus(interface=interface, channel=channel)

    def unplug(self) -> None:
        """Disconnect from the bus, which silences the sensor."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    @property
    def next_s(self) -> float:
        """Next instant of a measurement, s of the trajectory."""
        arrivals = self.sensor.t_arrival_s
        return float(arrivals[self._next]) if self._next < len(arrivals) else float("inf")

    def serve(self, t_s: float, counters: Counter[str]) -> None:
        """Send the epochs due at `t_s`; counts `NAME_frames`, `NAME_lost`, `NAME_unplugged`."""
        while self.next_s <= t_s:
            k, self._next = self._next, self._next + 1
            if self._bus is None:
                counters[f"{self.name}_unplugged"] += 1
                continue
            t_ns = round(float(self.sensor.t_s[k]) * 1e9)
            for frame in self._encoder.frames(k, t_ns, self.sensor.values(k)):
                try:
                    self._bus.send(frame)
                    counters[f"{self.name}_frames"] += 1
                except (can.CanError, OSError):
                    counters[f"{self.name}_lost"] += 1


def can_sensors(
    truth: Truth,
    star: StarTrackerOptions | None,
    sar: SarOptions | None,
    seed: int,
    bus: tuple[str, str],
) -> dict[str, CanSensor]:
    """Devices on board by name (`star_tracker`, `sar`), on the bus (interface, channel)."""
    star_rng, sar_rng = sensor_streams(seed)
    devices = {}
    if star is not None:
        tracker, decoder = StarTracker(truth, star, star_rng), CanAttitudeDecoder("star", SIM_STAR)
        devices["star_tracker"] = CanSensor("star_tracker", tracker, decoder, bus)
    if sar is not None:
        radar = SarRadar(truth, sar, sar_rng)
        devices["sar"] = CanSensor("sar", radar, CanBearingDecoder("sar", SIM_SAR), bus)
    return devices
