"""Incremental checksums over any stretch of a growing buffer, each byte processed once.

A stream can hold a header every six bytes that claims 8 KiB. Checking each claim by itself would
cost a thousand times the stream; running sums give the checksum of any stretch at once.

    Fletcher   A(i) = sum of bytes before i, B(i) = A(1) + ... + A(i), modulo 256
               over p..q: a = A(q) - A(p),  b = B(q) - B(p) - (q - p) A(p)
    CRC-24Q    C(i) the remainder of all before i, C(0) = 0
               over p..q: C(q) + C(p) x^(8 (q - p)), modulo the generator, in GF(2)

Source: RFC 1145 (Fletcher's sums); u-blox ZED-F9P interface description section 3.4 (8-bit
Fletcher); RTCM 10403.3 section 4.2 (CRC-24Q, polynomial 1864CFB hex).
"""

from __future__ import annotations

from functools import cache
from itertools import accumulate

GENERATOR = 0x1864CFB


def _crc24q_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 16
        for _ in range(8):
            crc = (crc << 1) ^ (GENERATOR if crc & 0x800000 else 0)
        table.append(crc & 0xFFFFFF)
    return tuple(table)


_TABLE = _crc24q_table()


def _next_crc(crc: int, byte: int) -> int:
    return (crc << 8) & 0xFFFFFF ^ _TABLE[crc >> 16 ^ byte]


def crc24q(data: bytes) -> int:
    """CRC-24Q of `data`, initial value 0; 0 over a whole good RTCM 3 frame."""
    crc = 0
    for byte in data:
        crc = _next_crc(crc, byte)
    return crc


def _powers(longest: int) -> tuple[int, ...]:
    """x^(8 n) modulo the generator, n = 0 to `longest`."""
    return tuple(accumulate(range(longest), lambda power, _: _next_crc(power, 0), initial=1))


LONGEST_RTCM = 1029
"""Header 3, payload up to 1023, CRC 3."""
_X8 = _powers(LONGEST_RTCM)


def _product(a: int, b: int) -> int:
    """a b modulo the generator, in GF(2)."""
    result = 0
    while b:
        if b & 1:
            result ^= a
        b >>= 1
        a <<= 1
        if a & 0x1000000:
            a ^= GENERATOR
    return result


_X24 = tuple(_product(four_bits, GENERATOR & 0xFFFFFF) for four_bits in range(16))
"""Four bits times x^24, modulo the generator."""


@cache
def _multiples(count: int) -> tuple[int, ...]:
    """Four bits times x^(8 `count`), modulo the generator."""
    return tuple(_product(_X8[count], four_bits) for four_bits in range(16))


def _shifted(crc: int, count: int) -> int:
    """`crc` times x^(8 `count`): four bits at a time, a false header costs a microsecond here."""
    multiples, result = _multiples(count), 0
    for place in (20, 16, 12, 8, 4, 0):
        result = (result << 4) & 0xFFFFFF ^ _X24[result >> 20] ^ multiples[crc >> place & 15]
    return result


class RunningFletcher:
    """Sums along a buffer. `taken`: bytes worked on since the start, each twice at most.

    A stretch that overlaps no refused one is summed by itself, which is faster: good frames never
    overlap.
    """

    def __init__(self) -> None:
        self.taken = 0
        self._a, self._b = [0], [0]
        self._refused = 0
        """End of the last stretch refused."""

    def holds(self, buffer: bytearray, start: int, end: int) -> bool:
        """True if the last two bytes of start..end are the sums of the others."""
        if start >= self._refused:
            self.taken += end - start
            covered = buffer[start : end - 2]
            good = sum(covered) & 0xFF == buffer[end - 2]
            good = good and sum(accumulate(covered)) & 0xFF == buffer[end - 1]
            if not good:
                self._refused = end
            return good
        self._extend(buffer, end - 2)
        a, b, q = self._a, self._b, end - 2
        first = (a[q] - a[start]) & 0xFF
        second = (b[q] - b[start] - (q - start) * a[start]) & 0xFF
        return first == buffer[q] and second == buffer[q + 1]

    def _extend(self, buffer: bytearray, end: int) -> None:
        a, b, known = self._a, self._b, len(self._a) - 1
        if end <= known:
            return
        more = list(accumulate(buffer[known:end], initial=a[-1] & 0xFF))[1:]
        b += list(accumulate(more, initial=b[-1] & 0xFF))[1:]
        a += more
        self.taken += end - known

    def drop(self, count: int) -> None:
        """Forget the first `count` bytes of the buffer."""
        self._refused = max(0, self._refused - count)
        if count < len(self._a):
            del self._a[:count], self._b[:count]
        else:
            self._a, self._b = [0], [0]


class RunningCrc24q:
    """Remainders along a buffer. `taken`: bytes worked on since the start."""

    def __init__(self) -> None:
        self.taken = 0
        self._crc = [0]

    def holds(self, buffer: bytearray, start: int, end: int) -> bool:
        """True if start..end (at most LONGEST_RTCM bytes) ends with its CRC."""
        known = len(self._crc) - 1
        if end > known:
            more = accumulate(buffer[known:end], _next_crc, initial=self._crc[-1])
            self._crc += list(more)[1:]
            self.taken += end - known
        return self._crc[end] == _shifted(self._crc[start], end - start)

    def drop(self, count: int) -> None:
        """Forget the first `count` bytes of the buffer."""
        if count < len(self._crc):
            del self._crc[:count]
        else:
            self._crc = [0]
