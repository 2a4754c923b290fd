"""The dashboard as browsers meet it: a real broker at one end, HTTP and WebSockets at the other."""

from __future__ import annotations

import asyncio
import json
import re
import socket
from collections.abc import Callable
from http.client import HTTPConnection
from importlib.resources import files
from pathlib import Path

import pytest

from fusiond.dashboard import browser_connection
from fusiond.dashboard.broker import Access, Broker
from fusiond.dashboard.player import Player
from fusiond.dashboard.vehicles import GIVES_WAY_S, LARGEST_BYTES, MOST_VEHICLES, Hub
from tests.broker import Broker as Mosquitto
from tests.broker import listening
from tests.dashboard.serving import NAMES, Browser, at_work, browsing, payload, refused, said
from tests.patience import PATIENCE_S
from tests.places import REPOSITORY

BASE = "fusiond/truck"
STATIC = files("fusiond.dashboard").joinpath("static")


class Clock:
    """Seconds that the test tells."""

    def __init__(self) -> None:
        self.s = 100.0

    def __call__(self) -> float:
        return self.s


def make_hub() -> Hub:
    hub = Hub(Clock(), "test")
    hub.linked("up")
    return hub


# ------------------------------------------------------------------ from the broker


async def test_from_broker_to_browser_and_back_after_the_broker_was_away(tmp_path: Path) -> None:
    clock = asyncio.get_running_loop().time
    with Mosquitto(tmp_path) as mosquitto:
        async with listening(mosquitto) as (_, daemon):
            await daemon.publish(f"{BASE}/status", payload("status"), qos=1, retain=True)
            hub = Hub(clock, "test")
            broker = Broker(Access("127.0.0.1", mosquitto.port), hub)
            async with at_work(hub, broker.listen) as address, browsing(address) as page:
                kept = await page.until(lambda p: p.latest.get("status"))
                assert kept["at"] is None  # nobody knows how long the broker has had it
                await daemon.publish(f"{BASE}/of_others", b"{}", qos=1)
                for topic in NAMES:
                    await daemon.publish(f"{BASE}/{topic}", payload(topic), qos=1)
                await page.until(lambda p: {"nav", "health", "reply"} <= set(p.latest))
                await page.until(lambda p: p.latest["status"]["at"] is not None)
                assert hub.counters["other_topic"] == 0, "not asked for"
                assert page.latest["nav"]["said"] == said("nav")
                assert page.latest["nav"]["at"] <= page.last["now"]
                assert page.last["vehicle"] == "truck"
                assert page.rows["event"][0][1] == said("event")
                mosquitto.kill()
                await page.until(lambda p: p.last["link"]["state"] == "lost")
                assert page.latest["nav"]["said"] == said("nav")
                mosquitto.start()
                await page.until(lambda p: p.last["link"]["state"] == "up")
                async with listening(mosquitto) as (_, again):

                    async def talk() -> None:
                        while True:  # what is said before it has subscribed is lost
                            await again.publish(f"{BASE}/nav", payload("nav", height_m=3.0))
                            await asyncio.sleep(0.05)

                    talking = asyncio.create_task(talk())
                    await page.until(lambda p: p.latest["nav"]["said"]["height_m"] == 3.0)
                    talking.cancel()


async def test_a_command_needs_the_token_and_gets_the_daemons_answer(tmp_path: Path) -> None:
    with Mosquitto(tmp_path) as mosquitto:
        async with listening(mosquitto) as (listener, daemon):
            hub = Hub(asyncio.get_running_loop().time, "test")
            broker = Broker(Access("127.0.0.1", mosquitto.port), hub)
            hub.send_command = broker.send_command
            async with (
                at_work(hub, broker.listen, token="s3cret-token") as address,
                browsing(address) as page,
            ):
                await daemon.publish(f"{BASE}/status", payload("status"), qos=1, retain=True)
                await page.until(lambda p: "status" in p.latest)
                assert page.hello["commands"] == list(browser_connection.COMMANDS)
                for wrong in ({}, {"token": "s3cret-tokem"}, {"token": 5}, {"token": None}):
                    answer = await page.ask(command="request_fix", **wrong)
                    assert answer == {"ok": False, "text": "refused: wrong token"}
                answer = await page.ask(command="set_position", token="s3cret-token")
                assert not answer["ok"]
                assert (await page.ask(command="request_fix", token="s3cret-token"))["ok"]
                (sent,) = await listener.until(lambda li: li.payloads(f"{BASE}/cmd/request_fix"))
                request_id = json.loads(sent)["id"]
                reply = payload("reply", id=request_id, text="request in 3 s")
                await daemon.publish(f"{BASE}/reply", reply, qos=1)
                latest = await page.until(lambda p: p.latest.get("reply"))
                assert latest["said"]["id"] == request_id
                assert not listener.payloads(f"{BASE}/cmd/set_position")


async def test_without_a_token_nothing_can_be_commanded() -> None:
    hub = make_hub()
    hub.send_command = lambda *sent: pytest.fail(f"sent {sent}")
    hub.receive("truck", "nav", payload("nav"))
    async with at_work(hub) as address, browsing(address) as page:
        answer = await page.ask(command="request_fix", token="")
        assert "--commands" in answer["text"]
        assert page.hello["commands"] == []


# ------------------------------------------------------------------ browsers


async def test_a_late_browser_gets_the_history() -> None:
    hub = make_hub()
    clock = hub.now_s
    assert isinstance(clock, Clock)
    for _ in range(20):
        clock.s += 1.0
        hub.receive("truck", "nav", payload("nav"))
        hub.receive("truck", "event", payload("event"))
    async with at_work(hub) as address, browsing(address) as page:
        await page.until(lambda p: p.rows.get("nav"))
        assert [row[0] for row in page.rows["nav"]] == [101.0 + k for k in range(20)]
        assert len(page.rows["event"]) == 20
        assert page.frames == 1


async def test_several_vehicles_are_offered_and_one_is_shown() -> None:
    hub = make_hub()
    hub.receive("van", "nav", payload("nav", height_m=2.0))
    hub.receive("car", "nav", payload("nav", height_m=1.0))
    async with at_work(hub) as address, browsing(address) as page:
        await page.until(lambda p: "nav" in p.latest)
        assert page.last["vehicles"] == ["car", "van"]
        assert page.latest["nav"]["said"]["height_m"] == 1.0
        await page.connection.send(json.dumps({"vehicle": "ship"}))
        await page.connection.send(json.dumps({"vehicle": "van"}))
        await page.until(lambda p: p.last["vehicle"] == "van")
        assert page.latest["nav"]["said"]["height_m"] == 2.0


@pytest.mark.parametrize("text", ["{", "[1]", '"x"', "{}", '{"command": 5}', "x" * 5000])
async def test_invalid_requests_are_answered(text: str) -> None:
    async with at_work(make_hub()) as address, browsing(address) as page:
        await page.connection.send(text)
        await page.until(lambda p: p.answers)
        assert not page.answers[0]["ok"]
        await page.until(lambda p: p.last["link"]["state"] == "up")


async def test_a_silent_hub_is_heard_once_a_second() -> None:
    async with at_work(make_hub()) as address, browsing(address) as page:
        await page.until(lambda p: p.frames >= 3)
        assert page.last["messages"] == page.last["rows"] == {}


def shows(why: str) -> Callable[[Browser], bool]:
    return lambda page: "status" in page.latest and page.latest["status"]["said"]["why"] == why


async def test_a_slow_browser_gets_the_newest_and_holds_up_nobody() -> None:
    """64 kB a frame: what the two sockets hold is full after a few, and then it does not read."""
    hub = make_hub()
    async with at_work(hub) as address, browsing(address) as quick:
        host, port = address.split(":")
        slow = socket.socket()
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16384)
        slow.setblocking(False)
        loop = asyncio.get_running_loop()
        await loop.sock_connect(slow, (host, int(port)))
        async with browsing(address, sock=slow, max_queue=1, max_size=1 << 24) as held:
            held.connection.transport.pause_reading()
            for number in range(25):
                why = str(number).rjust(60_000)
                hub.receive("truck", "status", payload("status", why=why))
                await quick.until(shows(why))  # every single one, though the other takes none
            held.connection.transport.resume_reading()
            await held.until(shows(why))
            assert held.frames < 0.7 * quick.frames


async def test_more_browsers_than_there_is_room_for_are_refused() -> None:
    async with at_work(make_hub()) as address:
        pages = [browsing(address) for _ in range(browser_connection.MOST_VIEWERS)]
        for page in pages:
            await page.__aenter__()
        assert await refused(address) == 403
        await pages[0].__aexit__(None, None, None)
        async with asyncio.timeout(PATIENCE_S):
            while await refused(address) != 101:  # noqa: ASYNC110 - nothing announces it
                await asyncio.sleep(0.01)
        for page in pages[1:]:
            await page.__aexit__(None, None, None)


# ------------------------------------------------------------------ other sites


async def _get(address: str, path: str, host: str) -> tuple[int, dict[str, str], bytes]:
    def get() -> tuple[int, dict[str, str], bytes]:
        connection = HTTPConnection(*address.split(":"), timeout=PATIENCE_S)
        connection.request("GET", path, headers={"Host": host})
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()

    return await asyncio.to_thread(get)


async def test_other_sites_and_other_names_are_refused() -> None:
    async with at_work(make_hub()) as address:
        port = address.split(":")[1]
        for host in (address, f"localhost:{port}", f"[::1]:{port}"):
            status, headers, body = await _get(address, "/", host)
            assert status == 200
            assert b"<title>fusiond</title>" in body
            assert "default-src 'none'" in headers["content-security-policy"]
        for host in ("evil.example", f"evil.example:{port}", "localhost.evil.example", "[", ""):
            assert (await _get(address, "/", host))[0] == 421
        assert await refused(address, origin=f"http://{address}") == 101
        assert await refused(address, origin="http://evil.example") == 403
        assert await refused(address, origin="null") == 403
        assert await refused(address, additional_headers={"Host": "evil.example"}) != 101


async def test_every_file_of_the_page_is_served_and_asks_nobody_else() -> None:
    scripts = {p.name for p in STATIC.iterdir() if p.name.endswith(".js")}
    async with at_work(make_hub()) as address:
        status, _, index = await _get(address, "/", address)
        wanted = set(re.findall(r'(?:src|href)="(/[^"]+)"', index.decode()))
        seen: set[str] = set()
        while wanted:
            path = wanted.pop()
            seen.add(path)
            status, _, body = await _get(address, path, address)
            assert status == 200, path
            if "uplot" in path:
                continue
            text = body.decode()
            assert not re.search(r"https?://|//[a-z]+\.", text), path
            found = re.findall(r'from "\./([^"]+)"', text)
            wanted |= {f"/static/{name}" for name in found} - seen
        assert {f"/static/{name}" for name in scripts} <= seen
        assert (await _get(address, "/static/uplot/LICENSE", address))[0] == 200
        assert (await _get(address, "/static/../hub.py", address))[0] == 404


# ------------------------------------------------------------------ the hub


def test_unreadable_messages_are_counted_and_skipped() -> None:
    hub = make_hub()
    for bad in (b"{", b"\xff", b'{"lat_deg": NaN}', b"", b'{"lat_deg": -1e999}', b"[" * 60_000):
        hub.receive("truck", "nav", bad)
    digits = b'{"t_ms": ' + b"9" * 400 + b"}"
    hub.receive("truck", "nav", digits)
    hub.receive("truck", "nav", b" " * (LARGEST_BYTES + 1))
    hub.receive("t" * 65, "nav", b"{}")
    hub.receive("truck", "online", b"maybe")
    hub.receive("truck", "tracker", b"{")
    refused = {"malformed": 7, "too_large": 2, "not_as_published": 1}
    assert hub.counters == {**refused, "other_topic": 1}
    assert not hub.vehicles
    for k in range(MOST_VEHICLES + 3):
        hub.receive(f"v{k}", "online", b"online")
    assert len(hub.vehicles) == MOST_VEHICLES
    assert hub.counters["too_many_vehicles"] == 3
    last = f"v{MOST_VEHICLES + 2}/online: there are {MOST_VEHICLES} already"
    kinds = {**refused, "too_many_vehicles": 3}
    assert hub.refused == {"count": 13, "kinds": kinds, "last": last}


def test_names_that_a_broker_has_kept_shut_out_nobody_who_speaks() -> None:
    hub = make_hub()
    clock = hub.now_s
    assert isinstance(clock, Clock)
    for k in range(MOST_VEHICLES + 100):
        hub.receive(f"junk{k}", "online", b"online", kept=True)
    assert len(hub.vehicles) == MOST_VEHICLES
    hub.receive("truck", "online", b"online", kept=True)
    assert "truck" not in hub.vehicles
    hub.receive("truck", "status", payload("status"))
    assert "truck" in hub.vehicles
    for k in range(MOST_VEHICLES - 1):  # who speaks, too, but does not push out who speaks
        hub.receive(f"talking{k}", "online", b"online")
    hub.receive("van", "status", payload("status"))
    assert "van" not in hub.vehicles
    clock.s += GIVES_WAY_S - 1.0
    hub.receive("truck", "status", payload("status"))
    clock.s += 1.0
    hub.receive("van", "status", payload("status"))
    assert {"truck", "van"} < set(hub.vehicles)
    assert len(hub.vehicles) == MOST_VEHICLES


# Each ended the dashboard, or what it sent to browsers.
ATTACKS = {
    "status": b'{"injected": 5}',
    "health": b'{"sources": {"a": {"verdict": []}}}',
    "innovations": b'{"t_ms": 1, "innovations": [{"source": "a", "outcome": "b", "t_ms": '
    + b"1"
    + b"0" * 400
    + b"}]}",
    "nav": b'{"t_ms": 1e308, "lat_deg": 1e308}',
}


async def test_no_message_ends_the_page_and_it_says_what_was_refused(tmp_path: Path) -> None:
    blind = b'{"t_ms": 1e308, "innovations": [{"source": "a", "outcome": "b", "t_ms": -1.7e308}]}'
    with Mosquitto(tmp_path) as mosquitto:
        async with listening(mosquitto) as (_, daemon):
            for topic, attack in ATTACKS.items():  # retained: they meet each start
                await daemon.publish(f"{BASE}/{topic}", attack, qos=1, retain=True)
            hub = Hub(asyncio.get_running_loop().time, "test")
            broker = Broker(Access("127.0.0.1", mosquitto.port), hub)
            async with at_work(hub, broker.listen) as address, browsing(address) as page:
                await page.until(lambda p: p.last.get("refused", {}).get("count") == len(ATTACKS))
                assert page.last["vehicles"] == []
                await daemon.publish(f"{BASE}/innovations", blind, qos=1)
                await daemon.publish(f"{BASE}/status", payload("status"), qos=1)
                await page.until(lambda p: "status" in p.latest)
                assert page.last["refused"]["last"] == "truck/innovations: t_ms: no integer"
                assert page.last["refused"]["kinds"] == {"malformed": 1, "not_as_published": 4}


# ------------------------------------------------------------------ a recording


async def test_a_recording_plays_through_the_same_page() -> None:
    player = Player([REPOSITORY / "tests" / "golden" / "demo.mcap"], speed=500.0)
    hub = Hub(player.now_s, player.origin, player.speed)
    async with at_work(hub, lambda: player.play(hub)) as address, browsing(address) as page:
        await page.until(lambda p: p.last.get("link", {}).get("state") == "ended")
        assert page.hello["origin"] == "demo.mcap"
        assert page.hello["speed"] == 500.0
        times = [row[0] for row in page.rows["nav"]]
        assert times == sorted(times)
        assert times[-1] - times[0] > 10.0
        assert page.rows["nav"][-1][2] == "navigating"
        assert {"gnss", "rdss"} <= {row[1] for row in page.rows["innovation"]}
        assert page.last["now"] >= times[-1]
