r"""Group delay of a signal in the satellite, relative to the clock of the ephemeris.

    pseudorange + c (dt - d) = range + ...        d in s, in terms of the broadcast group delays

GPS (clock refers to L1/L2 P, ionosphere-free):
    L1 P: d = TGD,  L2 P: d = (f1/f2)^2 TGD;  L1 C/A, L2C: the same, and 0.3 m more of sigma
    L5: d = TGD, and 3 m more of sigma
    each of L1 C/A, L2C, L5 with CNAV: d = TGD - ISC, and 0.1 m, L5 0.3 m
Galileo (clock of I/NAV refers to E1/E5b, of F/NAV to E1/E5a, each ionosphere-free):
    E1:  I/NAV d = BGDb,  F/NAV d = BGDa
    E5b: I/NAV d = (f1/f5b)^2 BGDb
    E5a: F/NAV d = (f1/f5a)^2 BGDa;  I/NAV d = BGDb + ((f1/f5a)^2 - 1) BGDa
BeiDou (clock refers to B3I):
    B3I: d = 0,  B1I: d = TGD1,  B2I: d = TGD2                          by D1 and D2
    B1C and B2a, pilot: d = T_GD,  data: d = T_GD + ISC                  by B-CNAV1 and B-CNAV2
    both together, by their power: B1C d = T_GD + ISC / 4, B2a d = T_GD + ISC / 2
B-CNAV1 has T_GD of both and the ISC of B1C, B-CNAV2 that of B2a. A clock of either message refers
to B3I.

Without a broadcast delay, so refused by name: BeiDou B1C and B2a until B-CNAV has come, B1I and B2I
until D1 or D2 has, Galileo E5 as a whole and E6.

E5a with an I/NAV clock: both clocks serve E1, so dt_F - BGDa = dt_I - BGDb there, and dt_F follows.
L1 C/A and L2C: the inter-signal corrections, in CNAV only, are the differential code biases
C1C-C1W and C2L-C2W, within 1 ns RMS: 0.3 m. L5 likewise.
IS-GPS-705J 20.3.3.3.1.2.1 has it within +-2^-35 2^12 = 120 ns, in orbit it is a few ns: 3 m.

No standard bounds the error of an ISC: the sigma is a third of the one without an ISC, a tenth for
L5.

Source: IS-GPS-200N 20.3.3.3.3.2 and 30.3.3.3.1.1; Galileo OS SIS ICD 2.1 5.1.5; BDS-SIS-ICD-B1I-3.0
5.2.4 (equipment group delay), BDS-SIS-ICD-B3I-1.0 5.2.4 (B3I takes none), BDS-SIS-ICD-B1C-1.0 7.6
and BDS-SIS-ICD-B2a-1.0 7.6 (T_GD, ISC), 4.2 of both (power of the components).
"""

from __future__ import annotations

from typing import NamedTuple

from drivers.raw.messages import CARRIER_HZ, Ephemeris, SignalDelays

GPS_L5_SIGMA_M = 3.0
GPS_CIVIL_SIGMA_M = 0.3
ISC_SIGMA_M = {"1": 0.1, "2": 0.1, "5": 0.3}
_P_CODES = "WPYMD"
"""Signals that the clock refers to."""


class GroupDelay(NamedTuple):
    """`delay_s` to take off the clock offset; `sigma_m` what stays unknown of it."""

    delay_s: float
    sigma_m: float = 0.0


_L1_L2 = (CARRIER_HZ["G", "1"] / CARRIER_HZ["G", "2"]) ** 2
_E1_E5A = (CARRIER_HZ["E", "1"] / CARRIER_HZ["E", "5"]) ** 2
_E1_E5B = (CARRIER_HZ["E", "1"] / CARRIER_HZ["E", "7"]) ** 2
_DATA_BAND = {"bcnav1": "1", "bcnav2": "5"}
"""Band of the data component whose ISC a message contains."""
_DATA_SHARE = {"1P": 0.0, "1D": 1.0, "1X": 0.25, "5P": 0.0, "5D": 1.0, "5X": 0.5}


def group_delay(
    ephemeris: Ephemeris, signal: str, sent: SignalDelays | None = None
) -> GroupDelay | None:
    """Delay of a signal (RINEX code such as "1C") by its satellite's ephemeris and CNAV data
    `sent`; None if unknown."""
    band, delays = signal[0], ephemeris.group_delay_s
    if sent is not None:
        for name, correction_s in sent.correction_s:
            if name == signal:
                return GroupDelay(sent.group_delay_s - correction_s, ISC_SIGMA_M[band])
    if ephemeris.system == "G":
        return _gps(signal, delays)
    if ephemeris.system == "E":
        return _galileo(band, delays, ephemeris.message)
    if ephemeris.message in _DATA_BAND:
        return _bcnav(signal, delays, _DATA_BAND[ephemeris.message])
    return _beidou(band, signal, delays)


def _gps(signal: str, delays: tuple[float, ...]) -> GroupDelay | None:
    if not delays:
        return None
    civil = 0.0 if signal[1:2] in _P_CODES else GPS_CIVIL_SIGMA_M
    scale = {"1": (1.0, civil), "2": (_L1_L2, civil), "5": (1.0, GPS_L5_SIGMA_M)}.get(signal[0])
    return None if scale is None else GroupDelay(scale[0] * delays[0], scale[1])


def _galileo(band: str, delays: tuple[float, ...], message: str) -> GroupDelay | None:
    """`delays` (BGD E1/E5a, BGD E1/E5b); F/NAV has the first only."""
    if message == "fnav":
        scale = {"1": 1.0, "5": _E1_E5A}.get(band)
        return GroupDelay(scale * delays[0]) if scale is not None and delays else None
    if len(delays) < 2:
        return None
    a, b = delays[:2]
    delay = {"1": b, "7": _E1_E5B * b, "5": b + (_E1_E5A - 1.0) * a}.get(band)
    return None if delay is None else GroupDelay(delay)


def _beidou(band: str, signal: str, delays: tuple[float, ...]) -> GroupDelay | None:
    if band == "6":
        return GroupDelay(0.0)
    at = {"2": 0, "7": 1}.get(band)
    if at is None or (band == "7" and signal[1] not in "IQX") or at >= len(delays):
        return None
    return GroupDelay(delays[at])


def _bcnav(signal: str, delays: tuple[float, ...], data_band: str) -> GroupDelay | None:
    """Delay from `delays` (T_GD of B1C's pilot, T_GD of B2a's, ISC of the data component on
    `data_band`)."""
    if signal[0] == "6":
        return GroupDelay(0.0)
    share = _DATA_SHARE.get(signal)
    if share is None or len(delays) < 3 or (share and signal[0] != data_band):
        return None
    return GroupDelay(delays[0 if signal[0] == "1" else 1] + share * delays[2])
