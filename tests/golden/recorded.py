"""Recorded vehicles through the daemon's chain, in time of the recording: logs for `golden`.

The recordings lie where `FUSIOND_DATA` says and are not copied into the project; what is kept of
them is the solution.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path

import can
import numpy as np
from can.typechecking import CanFilter

from drivers.can.base_driver import CanDriver
from fusiond.configuration.load import load_config
from fusiond.configuration.schema import Source
from fusiond.files.measurement_csv import read_imu
from fusiond.offline.can_log_reader import messages
from fusiond.simulation.can.imu import SIM_IMU, CanImu
from tests.clock.host_time import Host, S, utc
from tests.places import DATA, REPOSITORY
from tests.recording.rig import Rig

RAWX, SFRBX = b"\xb5\x62\x02\x15", b"\xb5\x62\x02\x13"
LATENCY_NS = S // 10
"""From an epoch to its last byte."""
WALK_NS = utc("2023-08-24T23:59:42")
"""Any week will do: its first second of GPS time, by a UTC that is 18 s behind."""


class Bus(Rig):
    """The car of `css_164`: each of its frames goes to the sources whose filters let it through."""

    def __init__(self, folder: Path, begin_s: float, length_s: float) -> None:
        config = load_config(REPOSITORY / "config" / "css_164.toml")
        log = DATA / "css_164" / "can.log.gz"
        began_s = next(messages(log)).timestamp
        begin_ns, end_ns = (round((began_s + s) * 1e9) for s in (begin_s, begin_s + length_s))
        late = (m for m in messages(log) if m.timestamp * 1e9 >= begin_ns)
        self._frames = takewhile(lambda m: m.timestamp * 1e9 < end_ns, late)
        self._next: can.Message | None = next(self._frames)
        host = Host(true_utc_at_zero=begin_ns - Host.mono)
        super().__init__(folder, config, host)
        self._filters: dict[str, list[CanFilter]] = {}
        for name, source in self.chain.sources.all.items():
            assert isinstance(source.driver, CanDriver)
            decoder = source.driver.Decoder(name, source.driver.options, Counter())
            self._filters[name] = decoder.filters
        self.end_ns = host.mono + end_ns - begin_ns

    def serve(self, until_ns: int) -> None:
        while self._next is not None:
            m = self._next
            t_ns = round(m.timestamp * 1e9) - self.host.true_utc_at_zero
            if t_ns > until_ns:
                return
            self.host.mono = max(self.host.mono, t_ns)
            for source, filters in self._filters.items():
                if any(_passes(f, m) for f in filters):
                    self.frame(source, m.arbitration_id, m.is_extended_id, bytes(m.data))
            self._next = next(self._frames, None)


def _passes(wanted: CanFilter, m: can.Message) -> bool:
    same = m.arbitration_id & wanted["can_mask"] == wanted["can_id"] & wanted["can_mask"]
    return same and m.is_extended_id == wanted["extended"]


class Walk(Rig):
    """The walk of `walk_0827`: its samples as frames of the simulated IMU, the receiver's raw
    stream as it came, an epoch at a time."""

    def __init__(self, folder: Path, begin_s: float, length_s: float) -> None:
        config = load_config(REPOSITORY / "config" / "walk_0827.toml")
        imu = Source(driver="can_imu", **SIM_IMU.model_dump())
        raw = Source.model_validate({"driver": "gnss", "port": str(folder / "raw")})
        sources = {"imu": imu, "raw": raw}
        table = read_imu(DATA / "walk_0827" / "imu.csv")
        first = int(np.searchsorted(table.t_s, begin_s))
        self._samples = iter(
            zip(table.t_s[first:], table.gyro[first:], table.accel[first:], strict=True)
        )
        stream = epochs((DATA / "walk_0827" / "gnss.ubx").read_bytes())
        self._epochs = _from(begin_s, stream)
        self._sample, self._epoch = next(self._samples), next(self._epochs)
        self._encoder, self._count = CanImu(SIM_IMU), 0
        begin_ns = round(begin_s * 1e9)
        host = Host(true_utc_at_zero=WALK_NS + begin_ns - Host.mono)
        super().__init__(folder, config.model_copy(update={"sources": sources}), host)
        self._ahead_ns = host.mono - begin_ns
        self.end_ns = host.mono + round(length_s * 1e9)

    def serve(self, until_ns: int) -> None:
        while (t_ns := round(self._sample[0] * 1e9) + self._ahead_ns) <= until_ns:
            self.host.mono = max(self.host.mono, t_ns)
            self._count += 1
            _, gyro, accel = self._sample
            for m in self._encoder.frames(self._count, t_ns, gyro.tolist(), accel.tolist()):
                self.frame("imu", m.arbitration_id, m.is_extended_id, bytes(m.data))
            self._sample = next(self._samples)
        while (t_ns := round(self._epoch[0] * 1e9) + self._ahead_ns + LATENCY_NS) <= until_ns:
            self.host.mono = max(self.host.mono, t_ns)
            self.take("raw", "read", self._epoch[1])
            self.take("raw", "silence")
            self._epoch = next(self._epochs)


def _from(begin_s: float, stream: Iterator[tuple[float, bytes]]) -> Iterator[tuple[float, bytes]]:
    """The stream from an epoch on, with what the satellites broadcast before it."""
    broadcast = b""
    for t_s, data in stream:
        if t_s >= begin_s:
            yield t_s, broadcast + data
            broadcast = b""
        else:
            broadcast += b"".join(data[at:end] for at, end in frames(data, SFRBX))


def epochs(stream: bytes) -> Iterator[tuple[float, bytes]]:
    """The stream cut behind each RXM-RAWX, with its receiver time (s of GPS week)."""
    begin = 0
    for at, end in frames(stream, RAWX):
        yield struct.unpack_from("<d", stream, at + 6)[0], stream[begin:end]
        begin = end


def frames(stream: bytes, of: bytes) -> Iterator[tuple[int, int]]:
    """Begin and end of each UBX frame of one kind."""
    end = 0
    while (at := stream.find(of, end)) >= 0:
        (length,) = struct.unpack_from("<H", stream, at + 4)
        end = at + 8 + length
        yield at, end
