"""Discovery of devices on ports and buses, for `fusiond config init`.

Discovery only listens. The one exception is an RDSS terminal, which is silent until asked for its
identity: that question is sent only on request and does not make it transmit. On a bus the decoder
of each known device receives every frame; the device whose decoder completes most samples fits.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import AsyncIterator, Awaitable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.base import monotonic_ns
from drivers.bestpos.decoder import POSITIONS as LOGGED_POSITIONS
from drivers.bestpos.framing import LogSplitter
from drivers.can.bus import CanBus, CanFrame, Interface
from drivers.can.decoder import CanDecoder
from drivers.can.gnss import CanGnssDriver
from drivers.can.imu import CanImuDriver
from drivers.measurements import ImuSample
from drivers.nmea.compass import FORMATTERS
from drivers.nmea.mixed_framing import Frame, Sentence, StreamSplitter, is_rdss_sentence
from drivers.rate_search import BAUDS, LISTEN_NS
from drivers.rdss.driver import RdssDriver, RdssOptions
from drivers.reconnecting_line import SerialLine
from drivers.sbf.framing import BlockSplitter
from fusiond.doctor.shipped_dbc_options import KNOWN_DEVICES
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2

SOUND_ITEMS = 3
"""Correct checksums that identify a protocol: one in 256 random lines has a correct one."""
TERMINAL_S = 25.0
"""Two families at three baud rates, 3 s each, and a reply."""
EPOCH_S = 1.2
"""Listening time after the first valid line: one epoch of a 1 Hz receiver."""
BUS_S = 3.0
LEAST_SAMPLES = 5
MOST_TILT_DEG = 30.0
"""Largest tilt of the down axis. 0 is exactly down, 45 lies between two axes; a slope of 20 % has
11 deg, and units are mounted parallel to the vehicle's axes."""
GRAVITY_TOLERANCE = 0.1
"""Tolerance of measured gravity: bias and scale of a consumer unit reach 0.1 g, a wrong unit a
factor."""
RATES_HZ = (1, 2, 4, 5, 8, 10, 20, 25, 40, 50, 80, 100, 125, 160, 200, 250, 400, 500, 800, 1000)
RATE_TOLERANCE = 0.08
"""Rates of devices differ by a quarter and more; a count over 3 s is off by a frame or two."""
_DRIVERS: dict[str, Any] = {"can_imu": CanImuDriver, "can_gnss": CanGnssDriver}
# RTCM 10403.3, table 3.5-78: MSM1 to MSM7 of GPS to BeiDou are 1071 to 1127.
_MSM = range(1071, 1128)
_RXM_RAWX = b"\x02\x15"
_NAV_POSITIONS = frozenset({b"\x01\x07", b"\x01\x02", b"\x01\x06"})
"""UBX-NAV-PVT, POSLLH and SOL."""
# NMEA 0183 4.11: sentences that hold a position.
_POSITIONS = ("GGA", "GNS", "RMC", "GLL")
_HEADINGS = Counter(FORMATTERS)
_BINARY = {
    "raw": "raw observations",
    "ubx_nav": "UBX navigation messages",
    "bestpos": "logs of the BESTPOS family",
    "sbf": "SBF blocks",
    "ubx": "UBX frames",
    "rtcm": "RTCM frames",
}
_SOLUTIONS = {"ubx_nav": "ubx", "bestpos": "bestpos", "sbf": "sbf"}
"""Drivers for positions in a receiver's own logs, where NMEA has none."""


@dataclass(frozen=True, slots=True)
class Device:
    """Device found: driver and options of its source, and a description."""

    driver: str
    options: dict[str, Any]
    text: str
    rate_hz: float | None = None
    aiding: str | None = None
    """Kind of `[aiding]`, for a driver with several kinds."""
    down: str | None = None
    """Sensor axis that points down, if gravity showed it."""


@dataclass(frozen=True, slots=True)
class SilentPort:
    """Port or bus without a recognised device, and the reason."""

    text: str


@dataclass(slots=True)
class _Line:
    """Data received over a serial line."""

    splitter: StreamSplitter = field(default_factory=StreamSplitter)
    logs: LogSplitter = field(default_factory=lambda: LogSplitter(Counter()))
    blocks: BlockSplitter = field(default_factory=lambda: BlockSplitter(Counter()))
    kinds: Counter[str] = field(default_factory=Counter)

    def receive(self, data: bytes, t_seen_ns: int) -> None:
        for item in self.splitter.feed(data):
            self.kinds[_kind(item)] += 1
        self.kinds["bestpos"] += sum(log.name in LOGGED_POSITIONS for log in self.logs.feed(data))
        self.kinds["sbf"] += len(self.blocks.feed(data))

    @property
    def sound(self) -> bool:
        return self.kinds.total() >= SOUND_ITEMS

    @property
    def known(self) -> bool:
        """True if further input would not change the result. A two-antenna receiver sends heading
        and position in one epoch, a compass never sends a position."""
        return self.sound and ("position" in self.kinds or not self.kinds & _HEADINGS)


def _kind(item: Sentence | Frame) -> str:
    if isinstance(item, Sentence):
        if is_rdss_sentence(item):
            return "rdss"
        name = item.formatter
        return name if name in FORMATTERS else "position" if name in _POSITIONS else "nmea"
    if item.kind == "ubx":
        kind = item.raw[2:4]
        return "raw" if kind == _RXM_RAWX else "ubx_nav" if kind in _NAV_POSITIONS else "ubx"
    number = int.from_bytes(item.raw[3:5], "big") >> 4
    return "raw" if number in _MSM else "rtcm"


async def device_on_port(
    port: str, *, ask_terminal: bool, listen_s: float = LISTEN_NS * 1e-9
) -> Device | SilentPort:
    """Device on a serial port, or the reason why none is recognised.

    `ask_terminal` allows asking an RDSS terminal for its card, which sends bytes on this port.
    """
    for baud in BAUDS:
        received = _Line()
        line = SerialLine(port, baud)
        async with _running(line.run(received.receive)):
            await _until(lambda received=received: received.known, listen_s)
            if received.sound:
                await _until(lambda received=received: "raw" in received.kinds, EPOCH_S)
        if received.sound:
            return _receiver(port, baud, received.kinds)
        if not line.counters["opened"]:
            return SilentPort(f"{port}: cannot be opened: {line.detail}")
        if not line.counters["bytes_in"]:
            break  # silent at one rate is silent at all
    else:
        rates = f"{len(BAUDS)} baud rates"
        return SilentPort(
            f"{port}: bytes come, and none of {rates} makes sense of them: look at the "
            "wiring, and whether another program reads it"
        )
    found = await _terminal(port) if ask_terminal else None
    return found or SilentPort(
        f"{port}: silent: is the device powered and its output on?"
        + ("" if ask_terminal else " An RDSS terminal is silent until it is asked: --ask-terminal")
    )


def _receiver(port: str, baud: int, kinds: Counter[str]) -> Device:
    nmea = {*FORMATTERS, "position", "nmea"}
    if kinds["rdss"] > sum(kinds[kind] for kind in nmea):
        return Device(
            "rdss", {"port": port}, _description(port, baud, ["sentences of an RDSS terminal"])
        )
    said = [_BINARY[kind] for kind in _BINARY if kinds[kind]]
    if nmea & set(kinds):
        said.insert(0, "NMEA sentences")
    options = {"port": port, "baud": baud}
    if kinds["raw"]:
        return Device("gnss", options, _description(port, baud, said))
    if not kinds["position"]:
        for kind, driver in _SOLUTIONS.items():
            if kinds[kind]:
                return Device(driver, options, _description(port, baud, said))
    headings = [name for name in FORMATTERS if kinds[name]]
    if headings and not kinds["position"]:
        text = _description(port, baud, [f"a compass ({', '.join(headings)})"])
        kind = "heading" if headings == ["HDT"] else "compass"
        return Device("compass", options, text, aiding=kind)
    return Device("nmea", options, _description(port, baud, said))


def _description(port: str, baud: int, received: list[str]) -> str:
    return f"{port}: {', '.join(received)} at {baud} baud"


async def _terminal(port: str) -> Device | None:
    """Ask an RDSS terminal for its identity alone."""
    options = RdssOptions(port=port, transmit=False)
    driver = RdssDriver("rdss", options, lambda _: None, monotonic_ns)
    async with _running(driver.run()):
        await _until(lambda: driver.status.state in ("running", "silent"), TERMINAL_S)
        if driver.status.state != "running":
            return None
    return Device("rdss", {"port": port}, f"{port}: an RDSS terminal answers")


async def device_on_bus(
    interface: Interface, channel: str, listen_s: float = BUS_S
) -> list[Device | SilentPort]:
    """Devices with a shipped DBC file on a CAN bus, the IMU and the receiver that fit best; or the
    reason why none is recognised."""
    decoders: list[tuple[int, CanDecoder[Any]]] = []
    for number, known in enumerate(KNOWN_DEVICES):
        kind = _DRIVERS[known.driver]
        options = kind.Options(**known.options, interface=interface, channel=channel)
        decoders.append((number, kind.Decoder(known.title, options)))
    samples: dict[int, list[int]] = {number: [] for number, _ in decoders}
    forces: dict[int, list[tuple[float, ...]]] = {number: [] for number, _ in decoders}
    fault = ""

    def receive(frame: CanFrame) -> None:
        if frame.remote or frame.error:
            return
        for number, decoder in decoders:
            for measured in decoder.feed(frame):
                samples[number].append(measured.t_seen_ns)
                if isinstance(measured, ImuSample):
                    forces[number].append(measured.accel_m_s2)

    def link(up: bool, why: str) -> None:
        nonlocal fault
        fault = "" if up else why

    bus = CanBus(interface, channel)
    async with _running(bus.run(receive, link, lambda state: None)):
        await asyncio.sleep(listen_s)
    found: dict[str, tuple[int, int]] = {}
    for number, decoder in decoders:
        driver, count = KNOWN_DEVICES[number].driver, len(samples[number])
        # A foreign device on the same identifiers is refused again and again.
        refused = sum(decoder.counters[name] for name in ("wrong_length", "out_of_range"))
        if count >= LEAST_SAMPLES and refused < count and count > found.get(driver, (0, 0))[0]:
            found[driver] = count, number
    if not found:
        frames = bus.counters["frames"]
        silence = "no frames: check power, bit rate and wiring"
        if frames:
            silence = f"{frames} frames, of no unit with a shipped DBC file: name yours as `dbc`"
        return [SilentPort(f"{interface} {channel}: {fault or silence}")]
    return [_on_bus(interface, channel, n, samples[n], forces[n]) for _, n in found.values()]


def down_axis(forces: list[tuple[float, ...]]) -> str | None:
    """Sensor axis that points down, by specific forces (n, 3) in m/s^2 at rest.

    None if no axis has gravity alone: the unit moves, or is tilted by more than `MOST_TILT_DEG`."""
    if not forces:
        return None
    mean, sd = np.mean(forces, axis=0), np.std(forces, axis=0)
    size = float(np.linalg.norm(mean))
    up = int(np.argmax(np.abs(mean)))
    tolerance = GRAVITY_TOLERANCE * STANDARD_GRAVITY_M_S2
    if abs(size - STANDARD_GRAVITY_M_S2) > tolerance or float(sd.max()) > tolerance:
        return None
    if abs(float(mean[up])) < size * np.cos(np.radians(MOST_TILT_DEG)):
        return None
    return ("-" if mean[up] > 0.0 else "+") + "xyz"[up]


def _on_bus(
    interface: Interface,
    channel: str,
    number: int,
    seen_ns: list[int],
    forces: list[tuple[float, ...]],
) -> Device:
    known = KNOWN_DEVICES[number]
    rate_hz = round_rate((len(seen_ns) - 1) / max(1e-9, (seen_ns[-1] - seen_ns[0]) * 1e-9))
    bus = {"channel": channel} if interface == "socketcan" else {}
    if interface != "socketcan":
        bus = {"interface": interface, "channel": channel}
    text = f"{interface} {channel}: frames of {known.title}, {rate_hz:g} Hz"
    return Device(known.driver, {**bus, **known.options}, text, rate_hz, down=down_axis(forces))


def round_rate(rate_hz: float) -> float:
    """Usual rate of devices nearest to a counted rate."""
    nearest = min(RATES_HZ, key=lambda r: abs(r - rate_hz))
    return float(nearest if abs(nearest - rate_hz) <= RATE_TOLERANCE * nearest else round(rate_hz))


@contextlib.asynccontextmanager
async def _running(work: Awaitable[None]) -> AsyncIterator[None]:
    task = asyncio.ensure_future(work)
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def _until(condition: Any, seconds: float) -> None:
    loop = asyncio.get_running_loop()
    end_s = loop.time() + seconds
    while not condition() and loop.time() < end_s:  # noqa: ASYNC110 - the line has no such event
        await asyncio.sleep(0.02)
