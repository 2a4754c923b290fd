"""Options of devices and of the clock change `process --can` as they change the daemon.

The frames of a bus go into the daemon's drivers, at the instants of their stamps, and into a log
that `process` reads: the filter's state at the end is the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.can.bus import CanFrame
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.load import load_config
from fusiond.configuration.schema import Config
from fusiond.live.chain import Chain
from fusiond.live.events import Events
from fusiond.navigator.navigator import Navigator
from fusiond.offline.process import process
from tests.clock.host_time import Host
from tests.offline.both_ways import Told, told
from tests.offline.recorded_bus import BEGIN_S, CONFIG, bus

SECONDS = 40
FAILS_S = 25.0
ALIGNED_S = 12.0
ROUNDING = 1e-5
"""Of instants to 0.2 us, where nothing but noise moves the vehicle."""
SPARE = {"source": "imu2", "axes": ("+y", "+z", "+x"), "mounting_sd_deg": 0.5}


def configured(options: dict[str, Any]) -> Config:
    """The car of css_164 with options by dotted names."""
    settings = load_config(CONFIG).model_dump(exclude_unset=True, mode="json")
    settings["sources"]["imu2"] = {**settings["sources"]["imu"], "channel": "can1"}
    for key, value in options.items():
        *path, name = key.split(".")
        section = settings
        for part in path:
            section = section.setdefault(part, {})
        section[name] = value
    return Config.model_validate(settings)


def frames() -> Iterator[can.Message]:
    """Both buses; a second unit 3 ms after the first, which falls silent."""
    for m in bus(SECONDS):
        unit = m.arbitration_id == 9
        if not unit or m.timestamp - BEGIN_S < FAILS_S:
            yield m
        if unit:
            yield can.Message(m.timestamp + 3e-3, 9, is_extended_id=False, data=m.data, channel=1)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bus") / "bus.log"
    path.write_text(
        "\n".join(
            f"({m.timestamp:.6f}) can{m.channel} {m.arbitration_id:03X}#{m.data.hex()}"
            for m in sorted(frames(), key=lambda m: m.timestamp)
        )
    )
    return path


def by_process(config: Config, log: Path) -> Told:
    seen: list[Navigator] = []
    process(config, None, [], can_log=log, watch=seen.append)
    return told(seen[-1])


def by_daemon(config: Config, messages: Iterable[can.Message]) -> Told:
    tick_ns = round(1e9 / config.scheduler.rate_hz)
    ordered = sorted(messages, key=lambda m: m.timestamp)
    stamps = [round(float(f"{m.timestamp:.6f}") * 1e9) for m in ordered]
    host = Host(mono=stamps[0], true_utc_at_zero=0)
    clock = Clock(config.clock, host)
    chain = Chain(config, clock, Events(clock))
    inputs = chain.sources.inputs
    taken = 0
    # Behind the inertial unit's end the daemon goes on by fixes alone; a file ends there.
    last = stamps[-1]
    if config.imu.spare is None:
        last = stamps[0] + round((FAILS_S + 1.0) * 1e9)
    for k in range(stamps[0] // tick_ns, last // tick_ns + 2):
        while taken < len(stamps) and stamps[taken] <= k * tick_ns:
            m, host.mono = ordered[taken], stamps[taken]
            frame = CanFrame(m.arbitration_id, False, bytes(m.data), host.mono, host.mono)
            for name, section in config.sources.items():
                if section.options["channel"] == f"can{m.channel}":
                    inputs[name].take("frame", frame, host.mono)
            taken += 1
        host.mono = k * tick_ns
        chain.tick(k * tick_ns)
    return told(chain.navigator)


OPTIONS: dict[str, dict[str, Any]] = {
    "clock.utc": {"clock.utc": "system"},
    "clock.serial_latency_s": {"clock.serial_latency_s": 0.02},
    "clock.max_clock_drift_ppm": {"clock.max_clock_drift_ppm": 5000.0},
    "imu.latency_s": {"sources.imu.latency_s": 0.015},
    "imu.timestamp": {"sources.imu.timestamp": "arrival", "sources.imu.latency_s": 0.02},
    "imu.gyro_unit": {"sources.imu.gyro_unit": "mrad/s"},
    "gnss.timestamp": {"sources.gnss.timestamp": "kernel"},
    "gnss.latency_s": {"sources.gnss.timestamp": "arrival", "sources.gnss.latency_s": 0.2},
    "gnss.geoid_m": {"sources.gnss.geoid_m": 40.0},
    "gnss without accuracy": {"sources.gnss.horizontal_accuracy": None},
    "gnss.heading": {"sources.gnss.heading": "gnss_attitude.Heading"},
    "gnss by another name": {"sources.gnss.satellites": "gnss_status.Satellites"},
    "imu.spare": {"imu.spare": SPARE},
}
SAME = {"gnss by another name"}
"""The number of satellites, which nothing is weighed by."""


@pytest.fixture(scope="module")
def as_it_stands(log: Path) -> Told:
    return by_process(configured({}), log)


def test_as_it_stands(log: Path, as_it_stands: Told) -> None:
    assert as_it_stands.same(by_daemon(configured({}), frames()), ROUNDING)
    assert as_it_stands.words[0]["gnss"]["fused"] > 10


@pytest.mark.parametrize("name", OPTIONS)
def test_options(name: str, log: Path, as_it_stands: Told) -> None:
    config = configured(OPTIONS[name])
    found = by_process(config, log)
    assert found.same(by_daemon(config, frames()), ROUNDING)
    assert found.same(as_it_stands, ROUNDING) == (name in SAME)


def test_the_spare_goes_on_where_the_first_fell_silent(log: Path) -> None:
    result = process(configured({"imu.spare": SPARE}), None, [], can_log=log)
    assert "imu_spare" in {event["code"] for event in result["events"]}
    assert result["solution_rows"] > 100 * (SECONDS - ALIGNED_S)
    alone = process(configured({}), None, [], can_log=log)
    assert alone["solution_rows"] < 100 * FAILS_S - 500
    assert alone["files"]["imu"]["rejected"] == {"second_imu": 100 * SECONDS}
