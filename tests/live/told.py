"""A daemon in a process of its own that tells its solutions on its standard output.

They are stamped by the monotonic clock that both processes share, so they can be held against a
vehicle that is simulated here whatever becomes of UTC or of the broker. Events are read off its
log.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import sys
from pathlib import Path
from typing import NamedTuple

from drivers.base import monotonic_ns
from fusiond.navigation.solution import Mode, Solution
from tests.patience import PATIENCE_S

# As `fusiond.live.daemon.run`, with a listener to the solutions; it begins when it is told to.
SCRIPT = """
import asyncio, json, logging, signal, sys
from pathlib import Path
from fusiond.configuration.load import load_config
from fusiond.live.daemon import Daemon
from fusiond.live.process_usage import release_start_memory

every, ticks = int(sys.argv[2]), 0

def say(s):
    global ticks
    ticks += 1
    if ticks % every == 1 or every == 1:
        where = s.lat_rad, s.lon_rad, s.height_m
        sd = s.sd_ned_m, s.sd_v_ned_m_s, s.sd_rpy_rad
        what = s.t_ns, s.mode, s.reason, *where, s.v_ned_m_s, s.rpy_rad, *sd
        print(json.dumps(what), flush=True)

async def main():
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    daemon = Daemon(load_config(Path(sys.argv[1])), on_solution=say)
    release_start_memory()
    await daemon.run(stop)

logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(levelname)s %(message)s")
print("loaded", flush=True)
sys.stdin.readline()
asyncio.run(main())
"""
EVENT = re.compile(r"(?:INFO|WARNING|ERROR) (\w+): (\w+): (.*)")


class Heard(NamedTuple):
    """An event as it was logged, at `t_ns` of the monotonic clock."""

    t_ns: int
    source: str
    code: str
    text: str


class ToldDaemon:
    """The process. `said` hands out its solutions in order, one of `every` ticks; `events` is what
    it has told so far; its log is added to `log`, which others may share.

    `folder` is its runtime directory, `environment` is added to its own.
    """

    def __init__(
        self, config: Path, every: int = 1, environment: dict[str, str] | None = None
    ) -> None:
        self._config, self._every = config, every
        self._environment = environment or {}
        self.log = config.with_suffix(".log")
        self.events: list[Heard] = []
        self._process: asyncio.subprocess.Process | None = None
        self._listening: asyncio.Task[None] | None = None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def status(self) -> int | None:
        """How it ended; None while it runs."""
        return None if self._process is None else self._process.returncode

    @property
    def cpu_s(self) -> float:
        """Processor time so far, of user and system."""
        words = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    async def load(self) -> ToldDaemon:
        """Start it, and wait until it has loaded its code."""
        command = [sys.executable, "-c", SCRIPT, str(self._config), str(self._every)]
        self._process = await asyncio.create_subprocess_exec(
            *command,
            env={**os.environ, **self._environment},
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        self._listening = asyncio.create_task(self._listen())
        assert await self._line() == b"loaded\n"
        return self

    async def begin(self) -> None:
        """Let it begin."""
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(b"\n")
        await self._process.stdin.drain()

    async def said(self) -> Solution:
        """The next solution. Raises AssertionError when it has ended or says nothing for long."""
        t_ns, mode, reason, lat, lon, height, v, rpy, *sd = json.loads(await self._line())
        triples = (tuple(three) for three in (v, rpy, *sd))
        return Solution(t_ns, Mode(mode), reason, lat, lon, height, *triples)  # type: ignore[arg-type]

    async def _line(self) -> bytes:
        assert self._process is not None
        assert self._process.stdout is not None
        async with asyncio.timeout(PATIENCE_S):
            line = await self._process.stdout.readline()
        assert line, self.log.read_text()
        return line

    async def _listen(self) -> None:
        assert self._process is not None
        assert self._process.stderr is not None
        with self.log.open("ab") as log:
            async for line in self._process.stderr:
                log.write(line)
                log.flush()
                found = EVENT.match(line.decode(errors="replace"))
                if found is not None:
                    self.events.append(Heard(monotonic_ns(), *found.groups()))

    async def terminate(self) -> int:
        """SIGTERM, as systemd stops it; the exit status. What it still says is not kept."""
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)
        return await self._end()

    async def kill(self) -> None:
        """SIGKILL: nothing is put in order."""
        if self._process is not None and self._process.returncode is None:
            self._process.kill()
            await self._end()

    async def _end(self) -> int:
        assert self._process is not None
        assert self._process.stdout is not None
        assert self._listening is not None
        async with asyncio.timeout(PATIENCE_S):
            while await self._process.stdout.read(65536):
                pass
            await self._listening
            return await self._process.wait()
