"""Decoder of UBX-NAV frames into measurements: epochs by iTOW, judged. No I/O, no clock.

An epoch closes with NAV-EOE, or as `drivers.epoch_ends` finds.
"""

from __future__ import annotations

import struct

from drivers.measurements import Measurement, Vector3
from drivers.nmea.mixed_framing import Frame, Item, StreamSplitter
from drivers.solution import Solution
from drivers.solution_decoder import SolutionDecoder
from drivers.ubx.messages import (
    CLASS_NAV,
    COMBINED,
    DEAD_RECKONING,
    END_OF_EPOCH,
    MESSAGES,
    RELPOSNED,
    THREE_D,
    TIME_ONLY,
    TWO_D,
    NavEpoch,
    UnreadableError,
    parse_relposned,
)

WEEK_MS = 604_800_000
RTK = {1: 5, 2: 4}
"""Quality of NMEA by carrSoln."""


class UbxDecoder(SolutionDecoder[Item, NavEpoch]):
    """See `SolutionDecoder`. A caller that splits the stream itself passes frames to `decode`.

    Every NAV frame ends in one counter: `nav_messages`, `nav_unreadable`, `late_message` (its epoch
    was closed), `relposned`, or `ubx_not_used`, which takes all other classes too. Of baselines
    `baseline_of_a_station`, `heading_not_valid`, `heading_not_fixed`; the rest is
    `SolutionJudge`'s.
    """

    _known: tuple[int, int] | None = None
    """Reference iTOW with its UTC."""

    def _make_splitter(self) -> StreamSplitter:
        return StreamSplitter(self.counters)

    def decode(self, raw: bytes, t_seen_ns: int) -> list[Measurement]:
        """Measurements that a frame, verified by `StreamSplitter`, completes."""
        self._t_seen_ns = t_seen_ns
        found: list[Measurement] = []
        self._frame(raw, found)
        return found

    def _take(self, item: Item, found: list[Measurement]) -> None:
        if isinstance(item, Frame) and item.kind == "ubx":
            self._frame(item.raw, found)

    # ----------------------------------------------------------------- messages to epochs

    def _frame(self, raw: bytes, found: list[Measurement]) -> None:
        kind, payload = raw[3], raw[6:-2]
        if raw[2] != CLASS_NAV:
            self.counters["ubx_not_used"] += 1
        elif kind == END_OF_EPOCH and len(payload) == 4:
            self.counters["nav_messages"] += 1
            epoch = self._epoch
            if epoch is not None and epoch.itow_ms == int.from_bytes(payload, "little"):
                self._close(found, learn=False, at_once=True)
        elif kind == RELPOSNED:
            self._baseline(payload, found)
        elif kind in MESSAGES:
            self._group(kind, payload, found)
        else:
            self.counters["ubx_not_used"] += 1

    def _group(self, kind: int, payload: bytes, found: list[Measurement]) -> None:
        _, least, itow_at, take = MESSAGES[kind]
        if len(payload) < least:
            self.counters["nav_unreadable"] += 1
            return
        (itow_ms,) = struct.unpack_from("<I", payload, itow_at)
        if not self._belongs(itow_ms, kind, found):
            return
        epoch = self._epoch or NavEpoch(itow_ms)
        try:
            take(epoch, payload)
        except UnreadableError:
            self.counters["nav_unreadable"] += 1
            return
        self._epoch = epoch
        self.counters["nav_messages"] += 1
        epoch.t_seen_ns = self._t_seen_ns
        if self._cycle.add(itow_ms, kind):
            self._close(found, learn=False, at_once=True)

    def _solution(self, epoch: NavEpoch) -> Solution | None:
        epoch.whole()
        if epoch.utc_ns is not None:
            self._known = epoch.itow_ms, epoch.utc_ns
        elif self._known is not None:
            epoch.utc_ns = self._utc_of(epoch.itow_ms)
        return _solution(epoch) if epoch.rank or epoch.fix is not None else None

    def _utc_of(self, itow_ms: int) -> int | None:
        """UTC of an iTOW by the last reference; None before one."""
        if self._known is None:
            return None
        since_ms = (itow_ms - self._known[0] + WEEK_MS // 2) % WEEK_MS - WEEK_MS // 2
        return self._known[1] + since_ms * 1_000_000

    def _baseline(self, payload: bytes, found: list[Measurement]) -> None:
        baseline = parse_relposned(payload)
        if baseline is None:
            self.counters["nav_unreadable"] += 1
            return
        self.counters["relposned"] += 1
        if baseline.refusal is not None:
            self.counters[baseline.refusal] += 1
            return
        # It waits for the base's observations, so it belongs to an older epoch than the open one.
        utc_ns = self._utc_of(baseline.itow_ms)
        epoch = self._epoch
        if epoch is not None and epoch.itow_ms == baseline.itow_ms and epoch.utc_ns is not None:
            utc_ns = epoch.utc_ns
        yaw_rad, sd_rad = baseline.heading_rad, baseline.sd_rad
        found += self._judge.heading(self._t_seen_ns, utc_ns, yaw_rad, sd_rad)


def _refusal(epoch: NavEpoch) -> str | None:
    if epoch.fix is None:
        return "status_missing"
    if epoch.fix == DEAD_RECKONING:
        return "dead_reckoning_refused"
    if epoch.fix == TIME_ONLY:
        return "time_only_refused"
    if epoch.fix not in (TWO_D, THREE_D, COMBINED) or not epoch.rank:
        return "no_fix"
    if not epoch.fix_ok:
        return "limits_exceeded"
    return None if epoch.position_valid else "no_fix"


def _solution(e: NavEpoch) -> Solution:
    plane = e.fix == TWO_D
    v = e.v_ned_m_s
    sd_v: Vector3 | None = e.covariance_v_m_s
    if sd_v is None and e.sd_v_m_s is not None:
        sd_v = (e.sd_v_m_s,) * 3
    return Solution(
        e.t_seen_ns,
        e.utc_ns,
        e.utc_known,
        _refusal(e),
        RTK.get(e.carrier, 2 if e.differential else 1),
        e.lat_rad,
        e.lon_rad,
        None if plane else e.height_m,
        e.covariance_ned_m or e.sd_ned_m,
        (v[0], v[1], None) if plane and v is not None else v,
        (sd_v[0], sd_v[1], None) if plane and sd_v is not None else sd_v,
        e.satellites,
        e.hdop,
        e.vdop,
    )
