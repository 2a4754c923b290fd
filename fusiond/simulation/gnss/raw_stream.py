r"""Raw stream of a GNSS receiver as bytes: UBX (RXM-RAWX, RXM-SFRBX) or RTCM 3 (MSM7, 1019, 1042).

What is sent with an epoch:

    observations    of every epoch
    UBX             the subframes that ended since the epoch before, of the satellites in view, as
                    they come off the air: LNAV and D1 one every 6 s, 1 to 3 of a frame of 30 s
                    (LNAV page 18 each time as subframe 4, which really comes every 12.5 min); D2 a
                    page of subframe 1 every 3 s. BeiDou's frames begin 14 s after full half minutes
    RTCM 3          1019 or 1042 of every satellite in view, every 30 s
    at the start    after the first epoch with a satellite, the whole message of all in view, as a
                    receiver sends that had them before the line was opened; `warm` off: not.
                    Epochs that nobody read (`repeat`) put this off

A satellite that comes into view later is complete after 30 s at most, or 18 s of its message.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Literal

from drivers.raw.messages import Ephemeris, Klobuchar, RawGnssEpoch, RawSignal
from fusiond.gnss.nominal_constellation import system_time
from fusiond.gnss.orbit import WEEK_S
from fusiond.simulation.gnss import rtcm3_encode, ubx_encode
from fusiond.simulation.gnss.nav_subframes import (
    D2_PERIOD_S,
    LNAV_PERIOD_S,
    d1,
    d2,
    lnav,
    lnav_ionosphere,
)
from fusiond.simulation.gnss.raw import GnssRaw

RawFormat = Literal["ubx", "rtcm3"]
FRAME_S = 30
"""Interval of a frame of LNAV and D1, of ten pages of D2 subframe 1, and of RTCM ephemerides."""


class GnssRawStream:
    """Encoder of a receiver's epochs, to be asked in their order."""

    def __init__(self, receiver: GnssRaw, raw_format: RawFormat, *, warm: bool = True) -> None:
        self.receiver = receiver
        self.counters: Counter[str] = Counter()
        self._send: Callable[[int, RawGnssEpoch], bytes]
        self._send = self._ubx if raw_format == "ubx" else self._rtcm3
        self._warm = self._is_warm = warm
        self._locked_s: dict[tuple[str, str], float] = {}
        self._before_s = 0.0
        self._frames: dict[str, tuple[int, int, tuple[tuple[int, ...], ...]]] = {}
        self._models: dict[str, Klobuchar] = {model.system: model for model in receiver.ionosphere}

    def bytes_of(self, k: int) -> bytes:
        """Bytes that the receiver sends with epoch `k`."""
        epoch = self.receiver.epoch(k)
        self.counters["epochs"] += 1
        self.counters["signals"] += len(epoch.signals)
        data = self._send(k, epoch)
        self._before_s = float(self.receiver.t_s[k])
        return data

    def repeat(self) -> None:
        """Repeat all broadcast messages in view at once."""
        self._warm = self._is_warm

    def _locks_ms(self, k: int, signals: Sequence[RawSignal]) -> list[int]:
        """Tracking time of each signal; it restarts after a loss."""
        now = float(self.receiver.t_s[k])
        names = [(s.satellite, s.signal) for s in signals]
        self._locked_s = {name: self._locked_s.get(name, now) for name in names}
        return [round((now - self._locked_s[name]) * 1e3) for name in names]

    def _starts(self, epoch: RawGnssEpoch) -> bool:
        """True if all messages are due at once, which happens once at most."""
        if not self._warm or not epoch.signals:
            return False
        self._warm = False
        return True

    def _broadcast(self, k: int, epoch: RawGnssEpoch) -> Iterator[Ephemeris]:
        t = float(self.receiver.t_s[k])
        yield from self.receiver.broadcast(t, {(s.system, s.prn) for s in epoch.signals})

    # ------------------------------------------------------------------------ UBX

    def _ubx(self, k: int, epoch: RawGnssEpoch) -> bytes:
        out = [ubx_encode.rawx(epoch, self._locks_ms(k, epoch.signals))]
        start = self._starts(epoch)
        before, now = self._before_s, float(self.receiver.t_s[k])
        if start or self._second_over(before, now):
            for satellite in self._broadcast(k, epoch):
                blocks = self._blocks(satellite, before, now, start)
                out += (ubx_encode.sfrbx(satellite.system, satellite.prn, b) for b in blocks)
        self.counters["subframes"] += len(out) - 1
        return b"".join(out)

    def _second_over(self, before: float, now: float) -> bool:
        """True if a full second lies in between: subframes of all systems end at full seconds."""
        second = self.receiver.start[1]
        return (now + second) // 1.0 > (before + second) // 1.0

    def _blocks(
        self, satellite: Ephemeris, before: float, now: float, everything: bool
    ) -> Iterator[tuple[int, ...]]:
        """Blocks that ended after `before` and not after `now`, or a whole frame just completed."""
        period = D2_PERIOD_S if satellite.message == "d2" else LNAV_PERIOD_S
        system = satellite.system
        week, own_now = system_time(system, *self.receiver.gps_time(now))
        ended = int(own_now // period)
        if everything:
            begin = int(own_now // FRAME_S) * FRAME_S - FRAME_S
            yield from self._frame(satellite, week, begin)
            return
        for number in range(ended - int((own_now - (now - before)) // period), 0, -1):
            last = (ended - number + 1) * period
            begin = (last - 1) // FRAME_S * FRAME_S
            frame = self._frame(satellite, week, begin)
            place = (last - begin) // period - 1
            if place < len(frame):
                yield frame[place]

    def _frame(self, satellite: Ephemeris, week: int, begin: int) -> tuple[tuple[int, ...], ...]:
        """Blocks of the frame that begins at second `begin` of the system's own week.

        A frame is made once, with the ephemeris of its first block: it holds one ephemeris.
        """
        if begin < 0:
            week, begin = week - 1, begin + int(WEEK_S)
        made = self._frames.get(satellite.satellite)
        if made is not None and made[:2] == (week, begin):
            return made[2]
        model = self._models[satellite.system]
        blocks: tuple[tuple[int, ...], ...]
        match satellite.message:
            case "lnav":
                page_18 = lnav_ionosphere(model, week, begin + 3 * LNAV_PERIOD_S)
                blocks = (*lnav(satellite, week, begin), page_18)
            case "d1":
                blocks = d1(satellite, model, week, begin)
            case _:
                blocks = d2(satellite, model, week, begin)
        self._frames[satellite.satellite] = week, begin, blocks
        return blocks

    # ------------------------------------------------------------------------ RTCM 3

    def _rtcm3(self, k: int, epoch: RawGnssEpoch) -> bytes:
        out = [rtcm3_encode.msm7(epoch, self._locks_ms(k, epoch.signals))]
        second, now = self.receiver.start[1], float(self.receiver.t_s[k])
        due = (now + second) // FRAME_S > (self._before_s + second) // FRAME_S
        if self._starts(epoch) or due:
            out += map(rtcm3_encode.ephemeris_frame, self._broadcast(k, epoch))
        self.counters["ephemerides"] += len(out) - 1
        return b"".join(out)
