"""The daemon while kernels compile: it answers, takes over what is there, can be stopped."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import time
from collections.abc import Callable, Coroutine
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from fusiond.clock.stamp_mapping import Clock
from fusiond.commands.status import retained_messages, selected_vehicle
from fusiond.live import daemon
from fusiond.live.daemon import Daemon
from fusiond.live.early_services import Front
from fusiond.navigation.compiled import FOLDER
from fusiond.workers.forked import ForkedJobs
from tests.broker import Broker, listening
from tests.hil.processes import DaemonProcess
from tests.live.daemon_bench import Bench, running
from tests.patience import PATIENCE_S, until


def _waits_for(file: Path) -> Callable[[], None]:
    def job() -> None:
        while not file.exists():
            time.sleep(0.01)

    return job


def _mqtt(port: int, *commands: str) -> str:
    text = f'[mqtt]\nhost = "127.0.0.1"\nport = {port}\n'
    return text + f"commands = {json.dumps(commands)}\n"


async def test_it_answers_while_kernels_compile_and_goes_on_by_the_same_connection(
    bench: Bench, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    with (
        Broker(tmp_path) as broker,
        ForkedJobs([_waits_for(first), _waits_for(second)]) as compiling,
    ):
        config = bench.configuration(_mqtt(broker.port, "reset_filter"))
        front = Front(config, Clock(config.clock))
        async with listening(broker) as (listener, client):
            waiting = asyncio.create_task(front.wait_for(compiling, asyncio.Event()))
            status = await listener.until(lambda heard: heard.payloads("fusiond/test/status"))
            said = json.loads(status[0])
            assert (said["mode"], said["why"]) == ("waiting", "compiling 0/2 kernels, once")
            vehicles = await retained_messages("127.0.0.1", broker.port, None, None, PATIENCE_S)
            name, heard = selected_vehicle(vehicles, None, PATIENCE_S)
            assert (name, heard.topics["status"]["mode"]) == ("test", "waiting")
            await client.publish("fusiond/test/cmd/reset_filter", '{"id": "a"}', qos=1)
            reply = await listener.until(lambda heard: heard.payloads("fusiond/test/reply"))
            assert "kernels are being compiled" in json.loads(reply[0])["text"]
            first.touch()
            await listener.until(lambda heard: _whys(heard, "compiling 1/2 kernels, once"))
            second.touch()
            await asyncio.wait_for(waiting, PATIENCE_S)
            made = Daemon(config, front=front)
            async with running(made):
                await listener.until(lambda heard: _whys(heard, "Waiting for IMU data"))
                await client.publish("fusiond/test/cmd/reset_filter", '{"id": "b"}', qos=1)
                await listener.until(lambda heard: len(heard.payloads("fusiond/test/reply")) > 1)
                assert listener.payloads("fusiond/test/online") == [b"online"]
                assert made.outputs["mqtt"].counters["mqtt_reconnects"] == 0
    assert any("compiling 0/2" in record.getMessage() for record in caplog.records)


def _whys(heard: Any, text: str) -> bool:
    return any(json.loads(p)["why"] == text for p in heard.payloads("fusiond/test/status"))


async def test_it_is_ready_after_a_while_though_kernels_still_compile(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fusiond.live.early_services.READY_AFTER_S", 0.0)
    config = bench.configuration("[mqtt]\nenabled = false\n")
    front = Front(config, Clock(config.clock))
    told: list[str] = []
    monkeypatch.setattr(front.service, "_send", told.append)
    stop = asyncio.Event()
    with ForkedJobs([_waits_for(tmp_path / "never")]) as compiling:
        waiting = asyncio.create_task(front.wait_for(compiling, stop))
        await until(lambda: told)
        stop.set()
        await asyncio.wait_for(waiting, PATIENCE_S)
    assert told[0] == "READY=1\nSTATUS=compiling 0/1 kernels, once"


def _children(pid: int) -> list[int]:
    return [int(c) for c in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


async def test_the_process_compiles_what_is_missing_elsewhere(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache" / FOLDER.name
    shutil.copytree(FOLDER, cache)
    removed = list(cache.glob("fusiond.navigation.vibration.*.kernel"))
    assert removed
    for file in removed:
        file.unlink()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache.parent))
    bench.configuration("[mqtt]\nenabled = false\n")
    async with DaemonProcess(bench.folder / "test.toml") as process:
        await process.start()
        await until(lambda: f"compiled {len(removed)} of {len(removed)} kernels" in process.log)
        await process.ready()
        assert f"STATUS=compiling 0/{len(removed)} kernels, once" in process.told
        assert all(file.exists() for file in removed)
        assert await process.terminate() == 0


async def test_the_process_can_be_stopped_while_it_compiles(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    bench.configuration("[mqtt]\nenabled = false\n")
    async with DaemonProcess(bench.folder / "test.toml") as process:
        await process.start()
        await until(lambda: "compiling 0/" in process.log)
        (child,) = _children(process.pid)
        assert await process.terminate() == 0
        with pytest.raises(ProcessLookupError):
            os.kill(child, 0)


def test_where_nothing_can_be_kept_it_compiles_before_anybody_waits_for_ticks(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Children would compile for nobody, and a watchdog would not wait for this process."""
    compiled: list[int] = []

    def served(main: Coroutine[None, None, None]) -> None:
        main.close()
        compiled.append(-1)

    monkeypatch.setattr(daemon, "kernels_can_be_kept", lambda: False)
    monkeypatch.setattr(daemon, "ForkedJobs", None)
    monkeypatch.setattr(daemon.asyncio, "run", served)
    config = bench.configuration("[mqtt]\nenabled = false\n")
    jobs = [partial(compiled.append, k) for k in range(3)]
    daemon.run_daemon(config, bench.folder / "test.toml", lambda: config, jobs)
    assert compiled == [0, 1, 2, -1]
    assert "compiling 3 kernels, at each start: NUMBA_CACHE_DIR" in caplog.text
