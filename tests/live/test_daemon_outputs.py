"""The daemon in this process: what an operator tells it, and what it serves."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import aiomqtt
import pytest

from fusiond.navigation.solution import Mode
from fusiond.outputs.commands import COMMANDS
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.recording.reader import Log
from fusiond.replay.replay_output import ReplayOptions, replay
from tests.broker import Broker, Listener, free_port, listening
from tests.live.daemon_bench import PARKED, RDSS, Bench, driving, running
from tests.patience import PATIENCE_S, until


async def test_commands_of_an_operator(bench: Bench, tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        mqtt = f'[mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\n'
        mqtt += f"commands = {json.dumps(list(COMMANDS))}\n"
        recording = f'[recording]\ndirectory = "{tmp_path / "logs"}"\n'
        daemon = bench.daemon(RDSS, mqtt, recording)
        here = {"lat_deg": 30.5276, "lon_deg": 114.3556, "height_m": 38.0, "sd_m": 5.0}
        vehicle = bench.vehicle(rdss_link=bench.folder / "rdss")
        async with (
            listening(broker) as (listener, client),
            running(daemon),
        ):
            ask = partial(_ask, listener, client)
            reply = await ask("set_position", here)
            begins = "position taken: without an inertial unit navigation begins there"
            assert (reply["ok"], reply["text"]) == (True, begins)
            reply = await ask("reset_filter", {})
            async with driving(vehicle):
                await bench.mode(Mode.ALIGNING)
                # Told where it is, it can start without any receiver.
                reply = await ask("set_position", here)
                assert reply["ok"], reply
                assert reply["text"].startswith(("position taken: aligning", "position fused"))
                await bench.mode(PARKED)
                payloads = await listener.until(lambda li: li.payloads("fusiond/test/calibration"))
                calibration = json.loads(payloads[0])
                assert calibration["parameters"]["gnss_time_s"]["state"] == "not_observed"
                assert not calibration["settled"]
                await until(lambda: bench.health["rdss"].state == "running")
                reply = await ask("request_fix", {})
                assert reply["ok"], reply
                assert reply["text"]
                reply = await ask("inject", {"source": "roof", "fault": "drop", "duration_s": 1.0})
                assert (reply["ok"], "there are imu, gnss, rdss" in reply["text"]) == (False, True)
                reply = await ask("inject", {"source": "imu", "fault": "drop", "duration_s": 1.0})
                assert (reply["ok"], reply["text"]) == (True, "imu: drop for 1 s")
                await bench.mode(Mode.INVALID)
                await until(lambda: bench.events("injection_ended") != [])
                reply = await ask("reset_filter", {})
                assert (reply["ok"], reply["text"]) == (True, "aligning again")
                await bench.mode(Mode.ALIGNING)
                reply = await ask("set_position", here)
                await bench.mode(PARKED)
                reply = await ask("set_position", {**here, "lat_deg": 91.0})
                assert not reply["ok"]
                assert "lat_deg" in reply["text"]
                # While it navigates it is a fix like any other; the reply says how it ended.
                reply = await ask("set_position", here)
                assert reply["ok"], reply
                assert reply["text"].startswith("position fused: it was ")
                far = {**here, "lat_deg": here["lat_deg"] + 2.7}
                reply = await ask("set_position", far)
                assert not reply["ok"]
                assert "position gated: it is 300" in reply["text"]
                assert "force = true" in reply["text"]
                assert abs(math.degrees(bench.seen[-1].lat_rad) - here["lat_deg"]) < 0.01
                reply = await ask("set_position", {**far, "force": True})
                assert reply["ok"], reply
                assert reply["text"] == "position taken: aligning from it"
                await bench.mode(Mode.ALIGNING)
                await ask("set_position", here)
                await bench.mode(PARKED)  # what was put right is no motion
                await listener.until(lambda li: "gated" in _judged(li))
                reply = await ask("stop_recording", {})
                assert reply["ok"], reply
                reply = await ask("start_recording", {})
                assert reply["text"].startswith("recording into test_")
    modes = [json.loads(p)["mode"] for p in listener.payloads("fusiond/test/status")]
    assert {"waiting", "aligning", "coasting"} <= set(modes)
    status = [json.loads(p) for p in listener.payloads("fusiond/test/status")]
    assert ["imu: drop for 1 s"] in [m["injected"] for m in status]
    assert {"recording", "off"} >= {m["recording"] for m in status}
    fixes = _judged(listener)
    assert {"fused", "gated"} <= fixes.keys()
    assert fixes["gated"]["nis"] > 1e6 > fixes["fused"]["nis"] >= 0.0
    sources = {one["source"] for one in _innovations(listener)}
    assert not any("zero" in source for source in sources)  # constraints are not told
    first, second = sorted((tmp_path / "logs").iterdir(), key=lambda p: p.stat().st_mtime)
    again = replay([first], ReplayOptions())  # commands and all
    assert again["identical"] is True, again["first_difference"]
    assert again["outcomes"]["operator"]["gated"] >= 1
    assert replay([second], ReplayOptions())["identical"] is None  # it was started on the way
    channels = {message.topic for message in Log([first]).messages()}
    assert "/innovation" in channels
    assert "/innovations" not in channels


def _innovations(listener: Listener) -> list[dict[str, Any]]:
    bundles = [json.loads(p) for p in listener.payloads("fusiond/test/innovations")]
    return [one for bundle in bundles for one in bundle["innovations"]]


def _judged(listener: Listener) -> dict[str, dict[str, Any]]:
    """The operator's fixes, as innovations tell of them, by their outcome."""
    told = _innovations(listener)
    return {one["outcome"]: one for one in told if one["source"] == "operator"}


async def _ask(
    listener: Listener, client: aiomqtt.Client, name: str, fields: dict[str, Any]
) -> dict[str, Any]:
    """Send a command; its reply."""
    number = f"{name}-{len(listener.messages)}"
    await listener.until(lambda heard: heard.payloads("fusiond/test/online"))
    await client.publish(f"fusiond/test/cmd/{name}", json.dumps({"id": number, **fields}), qos=1)

    def reply(heard: Listener) -> dict[str, Any] | None:
        replies = [json.loads(p) for p in heard.payloads("fusiond/test/reply")]
        return next((r for r in replies if r["id"] == number), None)

    found: dict[str, Any] = await listener.until(reply)
    return found


async def test_an_output_that_raises_is_restarted(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve = MqttPublisher.run
    falls = [RuntimeError("a defect"), None]

    async def fall_once(self: MqttPublisher) -> None:
        fault = falls.pop(0)
        if fault is not None:
            raise fault
        await serve(self)

    monkeypatch.setattr(MqttPublisher, "run", fall_once)
    with Broker(tmp_path) as broker:
        daemon = bench.daemon(f'[mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\n')
        async with listening(broker) as (listener, _), running(daemon):
            await listener.until(lambda heard: heard.payloads("fusiond/test/nav"))
    assert len(bench.events("output_fault")) == 1


async def test_configured_outputs_are_served_and_nothing_is_time_before_utc_is_settled(
    bench: Bench, tmp_path: Path
) -> None:
    vehicle = bench.vehicle(gnss_link=bench.folder / "gnss")
    ports = free_port(), free_port()
    with Broker(tmp_path) as broker:
        daemon = bench.daemon(
            f'[mqtt]\nhost = "127.0.0.1"\nport = {broker.port}',
            f"[outputs.gpsd]\nport = {ports[0]}\nrate_hz = 10.0",
            f"[outputs.nmea]\nport = {ports[1]}\nrate_hz = 10.0",
        )
        async with listening(broker) as (listener, _), running(daemon):
            await until(lambda: daemon.outputs["gpsd"].status.state == "running")
            reader, writer = await asyncio.open_connection("127.0.0.1", ports[0])
            writer.write(b'?WATCH={"enable":true,"json":true};')
            # The system clock has a date, but no receiver has confirmed it.
            undated = await _report(reader, lambda tpv: True)
            assert (undated["mode"], "time" in undated) == (1, False)
            nav = (await listener.until(lambda heard: heard.payloads("fusiond/test/nav")))[0]
            assert json.loads(nav)["t_utc"] is not None
            async with driving(vehicle):
                fix = await _report(reader, lambda tpv: tpv["mode"] == 3 and "time" in tpv)
                health = json.loads(
                    await listener.until(
                        lambda heard: next(
                            (p for p in heard.payloads("fusiond/test/health")
                             if b'"requests":1' in p and b'"utc_source":"gnss"' in p),
                            None,
                        )
                    )
                )  # fmt: skip
            writer.close()
    assert fix["device"] == "fusiond://test"
    assert {o["state"] for o in health["outputs"].values()} == {"running"}
    assert list(health["outputs"]) == ["mqtt", "gpsd", "nmea"]
    assert health["utc_settled"]


async def _report(
    reader: asyncio.StreamReader, wanted: Callable[[dict[str, Any]], bool]
) -> dict[str, Any]:
    """The first TPV of gpsd's protocol that is as wanted."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            report: dict[str, Any] = json.loads(await reader.readline())
            if report["class"] == "TPV" and wanted(report):
                return report
