"""MQTT broker of the demo, in its own process so that ticks keep their time.

    with DemoBroker() as broker: broker.port

The process (`python -m fusiond.demo.broker`) prints its port on the loopback interface and ends
when its standard input ends, so that it never outlives the demo.
"""

from __future__ import annotations

import asyncio
import importlib.util
import logging
import signal
import socket
import subprocess
import sys
from types import TracebackType

from fusiond.files.install_extra import install_command

_ATTEMPTS = 5
"""Attempts to find a free port; another process may take one before the broker does."""
_END_S = 5.0


class DemoError(Exception):
    """Error: the demo cannot run on this installation; the text says what to install."""


class DemoBroker:
    """Context manager of a broker process. Raises `DemoError` if it cannot start."""

    def __init__(self) -> None:
        if importlib.util.find_spec("amqtt") is None:
            raise DemoError(f"the demo's MQTT broker is not installed: {install_command('demo')}")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fusiond.demo.broker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.port = 0

    def __enter__(self) -> DemoBroker:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._end()
            raise DemoError("the demo's MQTT broker did not start; its error stands above")
        self.port = int(line)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end()

    def _end(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


def _free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


async def _serve() -> None:
    from amqtt.broker import Broker  # noqa: PLC0415 - an extra
    from amqtt.errors import BrokerError  # noqa: PLC0415

    for attempt in range(_ATTEMPTS):
        port = _free_port()
        broker = Broker(
            {
                "listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}"}},
                "plugins": {
                    "amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}
                },
            }
        )
        try:
            await broker.start()
            break
        except BrokerError:
            if attempt == _ATTEMPTS - 1:
                raise
    print(port, flush=True)
    await asyncio.to_thread(sys.stdin.read)
    await broker.shutdown()


def main() -> None:
    # Ctrl-C goes to the whole terminal; the demo ends in order, and then this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.disable(logging.CRITICAL)
    asyncio.run(_serve())


if __name__ == "__main__":
    main()
