"""A real Mosquitto on a free loopback port, to start, kill, freeze and listen to."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import aiomqtt

from tests.patience import PATIENCE_S

_PATH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/usr/local/sbin"])


def free_port() -> int:
    """A loopback TCP port that was free just now."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


class Broker:
    """Mosquitto with its own configuration in `folder`; `with Broker(tmp_path) as b: b.port`.

    `lines` are added to its configuration; by default it lets everyone in. Nothing is kept over a
    restart: the broker comes back empty, on the same port.
    """

    def __init__(self, folder: Path, *lines: str) -> None:
        self.port = free_port()
        self._config = folder / f"mosquitto-{self.port}.conf"
        self._log = folder / f"mosquitto-{self.port}.log"
        self._config.write_text(
            "\n".join(
                [
                    # Started as root it would change to a user who cannot read `folder`.
                    *(["user root"] if os.geteuid() == 0 else []),
                    f"listener {self.port} 127.0.0.1",
                    *(lines or ("allow_anonymous true",)),
                    "persistence false",
                    "",
                ]
            )
        )
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Broker:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def log(self) -> str:
        return self._log.read_text(errors="replace")

    def start(self) -> None:
        """Start and wait until it accepts connections."""
        binary = shutil.which("mosquitto", path=_PATH)
        assert binary is not None, "mosquitto is missing: apt-get install mosquitto"
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [binary, "-v", "-c", str(self._config)], stdout=log, stderr=log
            )
        end = time.monotonic() + PATIENCE_S
        while True:
            assert self._process.poll() is None, self.log
            with socket.socket() as s:
                if s.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            assert time.monotonic() < end, self.log
            time.sleep(0.02)

    def stop(self) -> None:
        """Stop for good; also a frozen one."""
        self._end(signal.SIGTERM)

    def kill(self) -> None:
        """Die at once: connections are reset, no will is published."""
        self._end(signal.SIGKILL)

    def _end(self, number: int) -> None:
        if self._process is not None:
            self._process.send_signal(number)
            self._process.send_signal(signal.SIGCONT)
            self._process.wait(PATIENCE_S)
            self._process = None

    def set_nice(self, nice: int) -> None:
        assert self._process is not None
        os.setpriority(os.PRIO_PROCESS, self._process.pid, nice)

    def freeze(self) -> None:
        """The kernel still accepts connections and bytes; nobody reads them."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)


class Listener:
    """Everything that came in, in order, as topic, payload and the retained flag."""

    def __init__(self) -> None:
        self.messages: list[aiomqtt.Message] = []
        self._changed = asyncio.Event()

    def add(self, message: aiomqtt.Message) -> None:
        self.messages.append(message)
        self._changed.set()

    def payloads(self, topic: str) -> list[bytes]:
        return [bytes(m.payload) for m in self.messages if m.topic.value == topic]

    async def until(
        self, condition: Callable[[Listener], Any], timeout_s: float = PATIENCE_S
    ) -> Any:
        """The first true value of `condition(self)`; an error after `timeout_s`."""
        async with asyncio.timeout(timeout_s):
            while not (value := condition(self)):
                self._changed.clear()
                await self._changed.wait()
        return value


@asynccontextmanager
async def listening(
    broker: Broker, topic: str = "fusiond/#", **options: Any
) -> AsyncIterator[tuple[Listener, aiomqtt.Client]]:
    """A subscriber of its own; yields what it hears and its client, which may publish too."""
    listener = Listener()
    patient = {"timeout": PATIENCE_S, **options}  # aiomqtt's own 10 s end on a busy host
    async with aiomqtt.Client("127.0.0.1", broker.port, **patient) as client:
        await client.subscribe(topic, qos=1)

        async def listen() -> None:
            async for message in client.messages:
                listener.add(message)

        task = asyncio.create_task(listen())
        try:
            yield listener, client
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
