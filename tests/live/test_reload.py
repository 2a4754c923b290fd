"""SIGHUP: what a running daemon takes from its file again, what it cannot, and a bad file."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from fusiond.configuration.load import ConfigError, load_config
from fusiond.configuration.schema import Config
from fusiond.live.daemon import run_daemon
from fusiond.live.reload import difference
from fusiond.navigation.solution import Mode
from fusiond.replay.replay_output import ReplayOptions, replay
from tests.broker import free_port
from tests.live.daemon_bench import NO_MQTT, PARKED, Bench, running
from tests.patience import PATIENCE_S, until


@pytest.fixture(autouse=True)
def _level_as_before() -> Iterator[None]:
    log = logging.getLogger("fusiond")
    before = log.level
    yield
    log.setLevel(before)


async def _sentence(port: int) -> bytes:
    """The first line that a client at that port hears."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
            except ConnectionRefusedError:
                await asyncio.sleep(0.01)
                continue
            try:
                return await reader.readline()
            finally:
                writer.close()


def _edit(path: Path, *changes: tuple[str, str]) -> None:
    text = path.read_text()
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    path.write_text(text)


async def test_outputs_gates_and_log_level_change_while_it_navigates(
    bench: Bench, tmp_path: Path
) -> None:
    before, after, scraped = free_port(), free_port(), free_port()
    daemon = bench.daemon(
        NO_MQTT,
        f"[outputs.nmea]\nport = {before}\n[outputs.prometheus]\nport = {scraped}",
        f'[recording]\ndirectory = "{tmp_path / "logs"}"',
    )
    path = bench.folder / "test.toml"
    vehicle = bench.vehicle(gnss_link=bench.folder / "gnss")
    async with running(daemon, vehicle):
        await bench.mode(PARKED)
        assert (await _sentence(before)).startswith(b"$")
        untouched, navigated = daemon.outputs["prometheus"], len(bench.seen)

        _edit(path, ("[imu]\n", '[imu]\nrate_hz = "fast"\n'))
        await daemon.reload(lambda: load_config(path))
        assert "imu.rate_hz" in bench.events("reload_refused")[0]
        assert (await _sentence(before)).startswith(b"$")

        _edit(
            path,
            ('rate_hz = "fast"\n', "rate_hz = 50.0\n"),
            ("lever_arm_m = [0.0, 0.0, -1.0]", "gate_probability = 1e-6\n"),
            (f"port = {before}", f"port = {after}"),
            ('vehicle = "test"', 'vehicle = "test"\nlog_level = "debug"'),
        )
        verdicts = daemon.navigator.verdicts
        await daemon.reload(lambda: load_config(path))
        assert (await _sentence(after)).startswith(b"$")
        with pytest.raises(ConnectionRefusedError):
            await asyncio.open_connection("127.0.0.1", before)
        assert daemon.outputs["prometheus"] is untouched
        assert logging.getLogger("fusiond").level == logging.DEBUG
        taken, needed = bench.events("reloaded")[-1], bench.events("restart_needed")[-1]
        assert "aiding.gnss.gate_probability, log_level, outputs.nmea.port" in taken
        assert "aiding.gnss.lever_arm_m, imu.rate_hz:" in needed
        assert daemon.config.imu.rate_hz == 100.0
        # They have begun anew; a fix may have come since.
        begun = daemon.navigator.verdicts
        assert begun is not verdicts
        assert all(report.verdict == "too_few" for report in begun.reports().values())
        await until(lambda: bench.health["gnss"].rejected.get("gated", 0) > 0)

        # What is as it runs already needs nothing.
        await daemon.reload(lambda: daemon.config)
        assert bench.events("reloaded")[-1].endswith("changed: nothing")
    assert Mode.ALIGNING not in {s.mode for s in bench.seen[navigated:]}
    (log,) = (tmp_path / "logs").iterdir()
    again = replay([log], ReplayOptions())
    assert again["identical"] is True, again["first_difference"]


async def test_a_reload_that_fails_is_told_and_the_next_one_works(
    bench: Bench,
) -> None:
    daemon, again = bench.daemon(NO_MQTT), asyncio.Event()
    broken = iter([True])

    def read() -> Config:
        if next(broken, False):
            raise RuntimeError("no disk")
        return daemon.config

    async with running(daemon):
        reloading = asyncio.create_task(daemon.reload_when(again, read))
        again.set()
        await until(lambda: bench.events("reload_fault") != [])
        assert "no disk" in bench.events("reload_fault")[0]
        again.set()
        await until(lambda: bench.events("reloaded") != [])
        reloading.cancel()


class _Operator(logging.Handler):
    """Asks for a reload once the daemon runs, and stops it after that."""

    def emit(self, record: logging.LogRecord) -> None:
        said = record.getMessage()
        if ": reloaded: " in said:
            os.kill(os.getpid(), signal.SIGTERM)
        elif ", vehicle test, config" in said:
            os.kill(os.getpid(), signal.SIGHUP)


def test_sighup_reads_the_file_again_and_systemd_hears_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: Bench
) -> None:
    bench.daemon(NO_MQTT)
    path = tmp_path / "test.toml"
    log, operator = logging.getLogger("fusiond"), _Operator()
    log.addHandler(operator)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            manager.bind(str(tmp_path / "notify"))
            manager.setblocking(False)
            run_daemon(load_config(path), path, lambda: load_config(path))
            assert manager.recv(256).startswith(b"RELOADING=1\nMONOTONIC_USEC=")
    finally:
        log.removeHandler(operator)
    assert bench.events("reloaded")[0].endswith("changed: nothing")


def test_what_only_a_restart_makes_right_is_refused(bench: Bench) -> None:
    """Time for chrony must not come from the clock that chrony sets, which runs until then."""
    path = bench.folder / "test.toml"
    bench.daemon(NO_MQTT, '[clock]\nutc = "system"')
    running_now = load_config(path)
    _edit(path, ('utc = "system"', 'utc = "gnss"\n[outputs.chrony]'))
    with pytest.raises(ConfigError, match=r"only with a restart: .*chrony"):
        difference(running_now, load_config(path))


def test_what_goes_out_by_the_broker_goes_with_it(bench: Bench) -> None:
    path = bench.folder / "test.toml"
    bench.daemon("[mqtt]\nhealth_rate_hz = 1.0\n[outputs.owntracks]\n[outputs.nmea]")
    before = load_config(path)
    _edit(path, ("health_rate_hz = 1.0", "health_rate_hz = 2.0"))
    assert difference(before, load_config(path)).outputs == {"mqtt", "owntracks"}
    _edit(path, ("[outputs.owntracks]\n", ""), ("health_rate_hz = 2.0", "health_rate_hz = 1.0"))
    found = difference(before, load_config(path))
    assert found.outputs == {"mqtt", "owntracks"}
    assert (found.restart, found.gates) == ((), {})
