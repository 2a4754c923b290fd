"""Decoder of Septentrio's SBF into measurements: epochs by time of week, judged. No I/O, no clock.

    4007 PVTGeodetic       mode, place, velocity; accuracies in revision 2 5906 PosCovGeodetic, 5908
    VelCovGeodetic    variances; they replace the accuracies 4001 DOP, 5914 ReceiverTime (leap
    seconds), 5921 EndOfPVT 5938 AttEuler, 5939 AttCovEuler             heading of two antennas
    HAccuracy              twice the root of the mean square of the horizontal distance VAccuracy
    twice the sigma of the height

Do-not-use values (-2e10, 65535, ...) become None. Source: Septentrio AsteRx SB3 Reference Guide,
section 4.2.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from drivers.measurements import Measurement, Vector3
from drivers.plausible import LEAP_SECONDS, within
from drivers.raw.weeks import LAST_WEEK, WEEK_S, utc_as_reported
from drivers.sbf.framing import Block, BlockSplitter
from drivers.solution import Solution
from drivers.solution_decoder import SolutionDecoder

PVT, POSITION_COVARIANCE, VELOCITY_COVARIANCE, DOP = 4007, 5906, 5908, 4001
ATTITUDE, ATTITUDE_COVARIANCE, TIME, END_OF_PVT = 5938, 5939, 5914, 5921
QUALITY = {1: 1, 2: 2, 4: 4, 5: 5, 6: 2, 7: 4, 8: 5, 10: 2}
"""Quality by PVT mode: stand-alone, differential, RTK fixed and float, SBAS, moving base, PPP."""
FIXED_LOCATION = 3
DATUMS = frozenset({0, 19, 30, 31, 34})
"""WGS 84/ITRS; that of the base; ETRS89, NAD83(2011), GDA2020, which are a plate's own and within
two metres of it, as those of a base usually are."""
NO_NUMBER = -2e10
NO_16, NO_32 = 0xFFFF, 0xFFFFFFFF
HEADING_FIXED = frozenset({2, 4})
"""Modes of AttEuler with ambiguities fixed: of two antennas, of three."""

_WHEN = struct.Struct("<IH")
_PVT = struct.Struct("<IHBBdddfffffdfBBB")
_ACCURACY_AT, _ACCURACY = 82, struct.Struct("<HH")
_COVARIANCE = struct.Struct("<IHBBfff")
_DOP = struct.Struct("<IHBxHHHH")
_ATTITUDE = struct.Struct("<IHBBHxxf")
_ATTITUDE_COVARIANCE = struct.Struct("<IHxBf")
_TIME = struct.Struct("<IH6xbB")
SIZES = {
    PVT: _PVT.size,
    POSITION_COVARIANCE: _COVARIANCE.size,
    VELOCITY_COVARIANCE: _COVARIANCE.size,
    DOP: _DOP.size,
    ATTITUDE: _ATTITUDE.size,
    ATTITUDE_COVARIANCE: _ATTITUDE_COVARIANCE.size,
    TIME: _TIME.size,
    END_OF_PVT: _WHEN.size,
}
_OF_PVT = frozenset({PVT, POSITION_COVARIANCE, VELOCITY_COVARIANCE, DOP})


@dataclass(slots=True)
class _Epoch:
    t_seen_ns: int = 0
    pvt: Solution | None = None
    sd_ned_m: Vector3 | None = None
    sd_v_ned_m_s: Vector3 | None = None
    hdop: float | None = None
    vdop: float | None = None


class SbfDecoder(SolutionDecoder[Block, _Epoch]):
    """See `SolutionDecoder`.

    Every block ends in one counter: `blocks_used`, `blocks_not_used`, `blocks_unreadable`, or
    `late_message`. Of headings `heading_not_valid`, `heading_not_fixed`; of positions
    `position_type_unknown`; the rest is `BlockSplitter`'s and `SolutionJudge`'s.
    """

    _when: tuple[int, int] = (NO_32, NO_16)
    """Time of the open epoch: time of week (ms) and week."""
    _leap_seconds: int | None = None
    _heading: tuple[tuple[int, int], float, int] | None = None
    """Attitude that awaits its covariance: instant, heading (rad), and arrival."""

    def _make_splitter(self) -> BlockSplitter:
        return BlockSplitter(self.counters)

    @property
    def epoch_open(self) -> bool:
        """True if `silence` would close an epoch, or a heading."""
        return super().epoch_open or self._heading is not None

    def _end(self, found: list[Measurement], *, learn: bool) -> None:
        super()._end(found, learn=learn)
        self._report_heading(None, found)

    # ----------------------------------------------------------------- blocks to epochs

    def _take(self, block: Block, found: list[Measurement]) -> None:
        least = SIZES.get(block.number)
        if least is None:
            self.counters["blocks_not_used"] += 1
            return
        if len(block.body) < least:
            self.counters["blocks_unreadable"] += 1
            return
        when: tuple[int, int] = _WHEN.unpack_from(block.body)
        if block.number in _OF_PVT and not self._group(block, when, found):
            return
        self.counters["blocks_used"] += 1
        if block.number == END_OF_PVT and when == self._when:
            self._close(found, learn=False, at_once=True)
        elif block.number == TIME:
            leap, _ = _TIME.unpack_from(block.body)[2:]
            self._leap_seconds = leap if within(leap, LEAP_SECONDS) else self._leap_seconds
        elif block.number == ATTITUDE:
            self._attitude(block.body, when, found)
        elif block.number == ATTITUDE_COVARIANCE:
            _, _, error, variance = _ATTITUDE_COVARIANCE.unpack_from(block.body)
            if self._heading is not None and self._heading[0] == when:
                good = error & 3 == 0 and 0.0 < variance < math.inf
                self._report_heading(math.radians(math.sqrt(variance)) if good else None, found)

    def _group(self, block: Block, when: tuple[int, int], found: list[Measurement]) -> bool:
        """True if a block belongs to an epoch."""
        if not self._belongs(when, block.number, found):
            return False
        epoch = self._epoch or _Epoch()
        self._epoch, self._when, epoch.t_seen_ns = epoch, when, self._t_seen_ns
        body = block.body
        if block.number == PVT:
            epoch.pvt = self._pvt(body, epoch.t_seen_ns)
        elif block.number == DOP:
            _, _, _, _, _, horizontal, vertical = _DOP.unpack_from(body)
            epoch.hdop, epoch.vdop = (
                x * 0.01 if 0 < x < NO_16 else None for x in (horizontal, vertical)
            )
        else:
            _, _, _, error, *variances = _COVARIANCE.unpack_from(body)
            good = not error and all(0.0 < v < math.inf for v in variances)
            n, e, d = (math.sqrt(v) if good else 0.0 for v in variances)
            if good and block.number == POSITION_COVARIANCE:
                epoch.sd_ned_m = n, e, d
            elif good:
                epoch.sd_v_ned_m_s = n, e, d
        if self._cycle.add(when, block.number):
            self.counters["blocks_used"] += 1
            self._close(found, learn=False, at_once=True)
            return False
        return True

    def _solution(self, epoch: _Epoch) -> Solution | None:
        s = epoch.pvt
        if s is None:
            return None
        s.t_seen_ns = epoch.t_seen_ns
        s.utc_ns = self._utc(self._when)
        s.utc_known = s.utc_ns is not None
        s.hdop, s.vdop = epoch.hdop, epoch.vdop
        s.sd_ned_m = epoch.sd_ned_m or s.sd_ned_m
        s.sd_v_ned_m_s = epoch.sd_v_ned_m_s
        return s

    def _utc(self, when: tuple[int, int]) -> int | None:
        tow_ms, week = when
        if tow_ms >= WEEK_S * 1000 or not 0 < week <= LAST_WEEK:
            return None
        return utc_as_reported(week, tow_ms * 1e-3, self._leap_seconds)

    # ----------------------------------------------------------------- fields

    def _pvt(self, body: bytes, t_seen_ns: int) -> Solution:
        (
            _, _, mode, error, lat, lon, height, _, v_n, v_e, v_u, _, _, _, _, datum, satellites,
        ) = _PVT.unpack_from(body)  # fmt: skip
        kind, plane = mode & 15, bool(mode & 0x80)
        refusal = None
        quality = QUALITY.get(kind)
        if error or kind == 0:
            refusal = "no_fix"
        elif kind == FIXED_LOCATION:
            refusal = None if self._decoding.allow_simulator else "manual_refused"
        elif quality is None:
            self.counters["position_type_unknown"] += 1
            refusal = "no_fix"
        elif datum not in DATUMS:
            refusal = "datum_refused"
        moving = v_n > NO_NUMBER and v_e > NO_NUMBER
        down = -v_u if v_u > NO_NUMBER and not plane else None
        sd = None
        if len(body) >= _ACCURACY_AT + _ACCURACY.size:
            horizontal, vertical = _ACCURACY.unpack_from(body, _ACCURACY_AT)
            if 0 < horizontal < NO_16 and 0 < vertical < NO_16:
                level = horizontal * 0.005 * math.sqrt(0.5)
                sd = level, level, vertical * 0.005
        placed = lat > NO_NUMBER and lon > NO_NUMBER
        return Solution(
            t_seen_ns,
            refusal=refusal,
            quality=quality or 1,
            lat_rad=lat if placed else None,
            lon_rad=lon if placed else None,
            height_m=None if height <= NO_NUMBER or plane else height,
            sd_ned_m=sd,
            v_ned_m_s=(v_n, v_e, down) if moving else None,
            satellites=None if satellites == 255 else satellites,
        )

    def _attitude(self, body: bytes, when: tuple[int, int], found: list[Measurement]) -> None:
        """Keep an attitude until its covariance or the next one arrives."""
        self._report_heading(None, found)
        _, _, _, error, mode, heading_deg = _ATTITUDE.unpack_from(body)
        if error & 3 or not mode or not NO_NUMBER < heading_deg < math.inf:
            self.counters["heading_not_valid"] += 1
        elif mode not in HEADING_FIXED:
            self.counters["heading_not_fixed"] += 1
        else:
            self._heading = when, math.radians(heading_deg), self._t_seen_ns

    def _report_heading(self, sd_rad: float | None, found: list[Measurement]) -> None:
        heading, self._heading = self._heading, None
        if heading is None:
            return
        when, yaw, t_seen_ns = heading
        found += self._judge.heading(t_seen_ns, self._utc(when), yaw, sd_rad)
