"""Corrections from a caster to the receiver: answers of NTRIP 1.0 and 2.0, over real sockets."""

from __future__ import annotations

import asyncio
import base64
import os
import re
import ssl
import subprocess
import tomllib
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.base import Backoff
from drivers.measurements import DeviceEvent
from drivers.nmea.driver import NmeaDriver, NmeaOptions
from drivers.ntrip.client import NtripClient, NtripOptions
from drivers.ntrip.protocol import HEADER_BYTES, CasterRefusedError, CasterReply
from drivers.raw.driver import GnssOptions
from tests.broker import free_port
from tests.drivers.at_work import at_work
from tests.drivers.nmea.sentences import gga, rmc
from tests.drivers.raw.frames import rtcm
from tests.patience import until
from tests.places import REPOSITORY
from tests.pty_device import Device

FRAMES = [rtcm(bytes([0x3E, 0xD0]) + bytes(range(n))) for n in (17, 200, 60)]
ICY = b"ICY 200 OK\r\n\r\n"
PLAIN = b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\nContent-Type: gnss/data\r\n\r\n"
CHUNKED = PLAIN[:-2] + b"Transfer-Encoding: chunked\r\n\r\n"


def chunk(data: bytes) -> bytes:
    return b"%x;ext=1\r\n%s\r\n" % (len(data), data)


# ------------------------------------------------------------------ the answer


@settings(max_examples=40, deadline=None)
@given(data=st.data(), chunked=st.booleans())
def test_an_answer_is_the_same_however_it_is_cut(data: st.DataObject, *, chunked: bool) -> None:
    payload = data.draw(st.binary(max_size=60))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(payload)), max_size=4)))
    parts = [payload[a:b] for a, b in zip([0, *cuts], [*cuts, len(payload)], strict=True)]
    wire = PLAIN + payload
    if chunked:
        wire = CHUNKED + b"".join(chunk(part) for part in parts if part)
    splits = sorted(data.draw(st.lists(st.integers(0, len(wire)), max_size=6)))
    reply = CasterReply()
    ends = zip([0, *splits], [*splits, len(wire)], strict=True)
    assert b"".join(reply.feed(wire[a:b]) for a, b in ends) == payload
    assert reply.accepted


def test_an_old_caster_says_one_line() -> None:
    reply = CasterReply()
    assert reply.feed(b"ICY 200") + reply.feed(b" OK\r\n") == b""
    assert reply.feed(b"\xd3\x00") == b"\xd3\x00"


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (b"SOURCETABLE 200 OK\r\nServer: x\r\n", "no such mountpoint"),
        (b"HTTP/1.1 200 OK\r\nContent-Type: gnss/sourcetable\r\n\r\n", "no such mountpoint"),
        (b"HTTP/1.1 404 Not Found\r\n\r\n", "no such mountpoint"),
        (b"HTTP/1.0 401 Unauthorized\r\n\r\n", "user or password"),
        (b"HTTP/1.1 503 Busy\r\n\r\n", "the caster says '503 Busy'"),
        (b"SSH-2.0-OpenSSH\r\n\r\n", "no answer of a caster"),
        (b"x" * (HEADER_BYTES + 4), "does not end"),
    ],
)
def test_an_answer_that_is_no_correction_is_named(answer: bytes, why: str) -> None:
    with pytest.raises(CasterRefusedError, match=why):
        CasterReply().feed(answer)


@pytest.mark.parametrize("size", [b"no size\r\n", b"-5\r\n", b"0x5\r\n", b"1" * 100])
def test_a_chunk_without_a_size_is_the_end_of_what_is_understood(size: bytes) -> None:
    reply = CasterReply()
    assert reply.feed(CHUNKED + chunk(b"abc") + size + b"abc") == b"abc"
    assert isinstance(reply.over, CasterRefusedError)


@pytest.mark.parametrize("cut", range(62, 69))
def test_the_longest_line_of_a_chunk_may_be_cut_anywhere(cut: int) -> None:
    """Between its CR and its LF, too."""
    wire = b"3;" + b"e" * 62 + b"\r\nabc\r\n"
    reply = CasterReply()
    assert reply.feed(CHUNKED + wire[:cut]) + reply.feed(wire[cut:]) == b"abc"
    assert reply.over is None


def test_the_last_chunk_is_the_end_and_takes_nothing_with_it() -> None:
    reply = CasterReply()
    assert reply.feed(CHUNKED + chunk(b"abc") + b"0\r\n\r\n") == b"abc"
    assert isinstance(reply.over, EOFError)


# ------------------------------------------------------------------ caster and receiver


class Caster:
    """Answers every connection with `answer`, and keeps what came up."""

    def __init__(self, answer: bytes, tls: ssl.SSLContext | None = None) -> None:
        self.answer, self._tls = answer, tls
        self.port = free_port()
        self.peers: list[asyncio.StreamWriter] = []
        """Who has connected; `clients` have asked for something, too."""
        self.clients: list[asyncio.StreamWriter] = []
        self.requests: list[str] = []
        self.heard = bytearray()

    def options(self, **more: Any) -> NtripOptions:
        return NtripOptions(caster=f"localhost:{self.port}", mountpoint="VRS3", **more)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.peers.append(writer)
        with suppress(ConnectionError, asyncio.IncompleteReadError):
            self.requests.append((await reader.readuntil(b"\r\n\r\n")).decode())
            writer.write(self.answer)
            self.clients.append(writer)
            while data := await reader.read(1000):
                self.heard += data

    @asynccontextmanager
    async def up(self) -> AsyncIterator[Caster]:
        server = await asyncio.start_server(self._serve, "127.0.0.1", self.port, ssl=self._tls)
        try:
            yield self
        finally:
            server.close()
            self.clients.clear()
            while self.peers:
                self.peers.pop().transport.abort()
            await server.wait_closed()


class Vehicle:
    """A receiver on a pty, whose driver has a caster."""

    def __init__(self, device: Device, ntrip: NtripOptions) -> None:
        self.device = device
        self.written = bytearray()
        self.events: list[tuple[str, str]] = []
        options = NmeaOptions(port=str(device.link), ntrip=ntrip)
        self.driver = NmeaDriver("gnss", options, self._take)

    def _take(self, item: object) -> None:
        if isinstance(item, DeviceEvent) and item.code.startswith("ntrip"):
            self.events.append((item.code, item.text))

    @property
    def counters(self) -> Counter[str]:
        return self.driver.counters

    def got(self, data: bytes) -> bool:
        with suppress(BlockingIOError):
            self.written += os.read(self.device.master, 65536)
        return bytes(self.written) == data


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "gnss")
    device.plug()
    yield device
    device.unplug()


@pytest.mark.parametrize("answer", [ICY, PLAIN, CHUNKED], ids=["1.0", "2.0", "2.0 in chunks"])
async def test_corrections_reach_the_receiver_whole_and_nothing_else_does(
    answer: bytes, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FUSIOND_NTRIP_PASSWORD", "pässword")
    caster = Caster(answer)
    vehicle = Vehicle(device, caster.options(user="vehicle"))
    torn = bytearray(FRAMES[0])
    torn[9] ^= 1
    sent = [FRAMES[0], FRAMES[1][:50], FRAMES[1][50:], bytes(torn), b"text\r\n", gga(1), FRAMES[2]]
    async with caster.up(), at_work(vehicle.driver.run()):
        await until(lambda: bool(caster.clients) and vehicle.counters["opened"] == 1)
        for part in sent:
            caster.clients[0].write(chunk(part) if answer is CHUNKED else part)
        await until(lambda: vehicle.got(b"".join(FRAMES)))
        device.send(gga(29) + rmc(29))
        await until(lambda: vehicle.driver.status.state == "running")
        assert vehicle.driver.status.detail == ""
        assert [code for code, _ in vehicle.events] == ["ntrip_running"]
    first, *lines = caster.requests[0].splitlines()
    assert first == "GET /VRS3 HTTP/1.1"
    secret = next(line.split()[-1] for line in lines if line.startswith("Authorization: Basic "))
    assert base64.b64decode(secret).decode() == "vehicle:pässword"
    counted = {
        name: vehicle.counters[f"ntrip_{name}"] for name in ("frames", "damaged", "not_rtcm")
    }
    assert counted == {"frames": 3, "damaged": 1, "not_rtcm": 1}
    assert vehicle.counters["ntrip_write_refused"] == 0
    assert vehicle.counters["ntrip_garbage_bytes"] >= len("text")
    assert vehicle.counters["rtcm_frames"] == 0  # the receiver's own frames are another matter


async def test_why_there_are_none_is_said_and_it_is_tried_again(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FUSIOND_NTRIP_PASSWORD", raising=False)
    caster = Caster(b"HTTP/1.1 401 Unauthorized\r\n\r\n")
    vehicle = Vehicle(device, caster.options(user="vehicle"))
    async with caster.up(), at_work(vehicle.driver.run()):
        # What is sent before the port is open is lost.
        await until(lambda: bool(vehicle.events) and vehicle.counters["opened"] == 1)
        device.send(gga(29) + rmc(29))
        await until(lambda: vehicle.driver.status.state == "running")
        where = f"no corrections of localhost:{caster.port}/VRS3"
        await until(lambda: bool(vehicle.driver.status.detail))
        why = "user or password is wrong (401); FUSIOND_NTRIP_PASSWORD is not set"
        assert vehicle.driver.status.detail == f"{where}: {why}"
        caster.answer = ICY + FRAMES[0]
        await until(lambda: vehicle.got(FRAMES[0]))
    assert [code for code, _ in vehicle.events] == ["ntrip_refused", "ntrip_running"]


async def test_the_position_goes_up_once_the_receiver_has_one(device: Device) -> None:
    caster = Caster(ICY)
    vehicle = Vehicle(device, caster.options(send_gga=True))
    async with caster.up(), at_work(vehicle.driver.run()):
        await until(lambda: vehicle.counters["opened"] == 1)
        device.send(gga(28, quality=0))
        await until(lambda: vehicle.counters["sentences"] == 1)
        assert [code for code, _ in vehicle.events] == ["ntrip_waiting"]
        assert caster.requests == []
        device.send(gga(29) + rmc(29))
        await until(lambda: bytes(caster.heard) == gga(29))
    assert vehicle.counters["ntrip_gga_sent"] == 1


class Attempts:
    """A client alone, whose receiver takes nothing, with waits that a test can bear."""

    def __init__(self, caster: Caster, *, tls: bool = False) -> None:
        self.states: list[tuple[str, str]] = []
        self.counters: Counter[str] = Counter()
        self.client = NtripClient(
            caster.options(tls=tls),
            self.counters,
            lambda frame: False,
            lambda: b"",
            lambda state, text: self.states.append((state, text)),
            Backoff(0.01, 0.02),
        )


async def test_a_caster_that_is_gone_and_comes_back() -> None:
    caster = Caster(CHUNKED + chunk(FRAMES[0]))
    attempts = Attempts(caster)
    where = f"corrections of localhost:{caster.port}/VRS3"
    async with at_work(attempts.client.run()):
        await until(lambda: attempts.counters["ntrip_failed"] >= 3)
        async with caster.up():
            await until(lambda: attempts.client.state == "running")
            caster.clients[0].write(b"0\r\n\r\n")  # the last chunk: it comes again
            await until(lambda: len(attempts.states) >= 4)
            assert [state for state, _ in attempts.states[:4]] == ["lost", "running"] * 2
        await until(lambda: attempts.client.state == "lost")
    assert "Connection refused" in attempts.states[0][1]
    assert attempts.states[1] == ("running", where)
    assert attempts.states[2] == ("lost", f"no {where}: the caster closed the connection")
    assert attempts.counters["ntrip_write_refused"] == attempts.counters["ntrip_frames"] >= 2


async def test_a_caster_that_goes_silent_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.ntrip.client.SILENT_S", 0.2)
    caster = Caster(ICY + FRAMES[0])
    attempts = Attempts(caster)
    async with caster.up(), at_work(attempts.client.run()):
        await until(lambda: len(caster.requests) >= 2)
    assert ("lost", "nothing for 0.2 s") in [(s, t.partition(": ")[2]) for s, t in attempts.states]


# ------------------------------------------------------------------ TLS


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of `localhost`, signed by itself, with its key behind it in one file."""
    pem = tmp_path_factory.mktemp("caster") / "caster.pem"
    command = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2"
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    key = pem.with_suffix(".key")
    files = ["-keyout", str(key), "-out", str(pem)]
    subprocess.run([*command.split(), *names, *files], check=True, capture_output=True)
    pem.write_text(pem.read_text() + key.read_text())
    return pem


def secured(certificate: Path) -> Caster:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate)
    return Caster(ICY + FRAMES[0], context)


async def test_a_caster_with_tls_is_verified_and_heard(
    certificate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    caster = secured(certificate)
    attempts = Attempts(caster, tls=True)
    async with caster.up(), at_work(attempts.client.run()):
        await until(lambda: attempts.client.state == "running")
    assert attempts.counters["ntrip_frames"] >= 1


async def test_a_caster_whose_authority_is_unknown_gets_no_password(certificate: Path) -> None:
    caster = secured(certificate)
    attempts = Attempts(caster, tls=True)
    async with caster.up(), at_work(attempts.client.run()):
        await until(lambda: attempts.client.state == "refused")
    assert "certificate is not accepted: self-signed certificate" in attempts.client.detail
    assert "SSL_CERT_FILE" in attempts.client.detail
    assert caster.requests == []


async def test_a_port_without_tls_is_named() -> None:
    caster = Caster(ICY)
    attempts = Attempts(caster, tls=True)
    async with caster.up(), at_work(attempts.client.run()):
        await until(lambda: bool(caster.peers))
        caster.peers[0].write(b"ICY 400 what is that\r\n\r\n")
        await until(lambda: attempts.client.state == "refused")
    assert attempts.client.detail.endswith("there is no TLS at that port")


# ------------------------------------------------------------------ configuration


@pytest.mark.parametrize(
    "wrong",
    [
        {"caster": "http://caster"},
        {"mountpoint": "A B"},
        {"mountpoint": "A\r\nHost: x"},
        {"tls": True},
        {"user": "a:b"},
        {"user": "a\r\nX: y"},
        {"password": "secret"},
    ],
)
def test_what_cannot_be_asked_for_is_refused(wrong: dict[str, str]) -> None:
    with pytest.raises(ValidationError):
        NtripOptions.model_validate({"caster": "caster", "mountpoint": "M", **wrong})


def test_nothing_is_written_through_a_gpsd() -> None:
    ntrip = NtripOptions(caster="caster", mountpoint="M")
    assert ntrip.address == ("caster", 2101)
    with pytest.raises(ValidationError, match="behind a gpsd"):
        GnssOptions(port="gpsd://localhost", ntrip=ntrip)


def test_the_page_is_true() -> None:
    page = (REPOSITORY / "docs" / "network.md").read_text(encoding="utf-8")
    sections = [tomllib.loads(text) for text in re.findall(r"```toml\n(.*?)```", page, re.DOTALL)]
    NmeaOptions.model_validate(
        {k: v for k, v in sections[0]["sources"]["gnss"].items() if k != "driver"}
    )
    ntrip = sections[1]["sources"]["gnss"]["ntrip"]
    assert set(ntrip) == set(NtripOptions.model_fields)
    NtripOptions.model_validate(ntrip)
    code = "".join(p.read_text() for p in sorted((REPOSITORY / "drivers" / "ntrip").glob("*.py")))
    counted = set(re.findall(r'counters\["(\w+)"\]', code))
    assert counted == set(re.findall(r"`(ntrip_\w+)`", page)) - {
        f"ntrip_{state}" for state in ("running", "lost", "refused", "waiting")
    }
