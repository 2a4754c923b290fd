"""Digest of the navigator's state after a tick, eight bytes."""

from __future__ import annotations

import struct
from hashlib import blake2b

from fusiond.navigation.solution import Solution
from fusiond.navigator.navigator import Navigator

DIGEST_BYTES = 8
_SLICE = 2032
"""Bytes hashed at a time. From 2048 on hashlib lets another thread run meanwhile: the log writer,
which then keeps the tick waiting for up to 5 ms (sys.getswitchinterval)."""
_SOLUTION = struct.Struct("<q26d")
_T_NS = struct.Struct("<q")


def state_digest(navigator: Navigator, solution: Solution) -> bytes:
    """Digest of the solution and its mode, and of the filter's state (nav, xi, P) once started.

    BLAKE2b to 8 bytes: two states that differ agree by chance once in 2^64 ticks. NaN counts by its
    bits. 10 us a tick.
    """
    s = solution
    of = s.mode.encode() + _SOLUTION.pack(
        s.t_ns,
        *(s.lat_rad, s.lon_rad, s.height_m),
        *(*s.v_ned_m_s, *s.rpy_rad, *s.sd_ned_m, *s.sd_v_ned_m_s, *s.sd_rpy_rad),
        *(*s.gyro_bias_rad_s, *s.accel_bias_m_s2),
        *(s.bound.hpl_m, s.bound.vpl_m),
    )
    if navigator.started is not None:
        e = navigator.estimator
        parts = _T_NS.pack(e.t_ns), e.nav.tobytes(), e.xi.tobytes(), e.covariance.tobytes()
        of += b"".join(parts)
    whole = memoryview(of)
    found = blake2b(whole[:_SLICE], digest_size=DIGEST_BYTES)
    for at in range(_SLICE, len(of), _SLICE):
        found.update(whole[at : at + _SLICE])
    return found.digest()
