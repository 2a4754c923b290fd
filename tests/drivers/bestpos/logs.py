"""Logs of the BESTPOS family, with their CRC."""

from __future__ import annotations

from drivers.bestpos.framing import log_crc

WEEK, TOW_S = 2447, 180_887.0
"""2026-12-01 02:14:29 UTC, with 18 leap seconds."""
PLACE = "39.96872420000,116.32572020000,45.3000,-9.1000,WGS84,0.0140,0.0120,0.0310"
BELOW = '"7",0.800,0.000,33,31,29,26,00,01,3d,15'


def log(head: str, body: str) -> bytes:
    text = f"{head};{body}".encode()
    return b"#%b*%08x\r\n" % (text, log_crc(text))


def novatel(name: str, body: str, second: float = 0.0, status: str = "FINESTEERING") -> bytes:
    when = f"{status},{WEEK},{TOW_S + second:.3f}"
    return log(f"{name},COM1,0,83.5,{when},02000000,5a3c,16248", body)


def unicore(name: str, body: str, second: float = 0.0, leap: int = 18, base: str = "GPS") -> bytes:
    week, tow_s = (WEEK, TOW_S) if base == "GPS" else (WEEK - 1356, TOW_S - 14.0)
    when = f"{base},FINE,{week},{round((tow_s + second) * 1000)}"
    return log(f"{name},97,{when},0,0,{leap},12", body)


def bestpos(
    second: float = 0.0,
    *,
    name: str = "BESTPOSA",
    kind: str = "NARROW_INT",
    status: str = "SOL_COMPUTED",
    place: str = PLACE,
    clock: str = "FINESTEERING",
) -> bytes:
    return novatel(name, f"{status},{kind},{place},{BELOW}", second, clock)


def bestvel(second: float = 0.0, *, name: str = "BESTVELA", latency: str = "0.000") -> bytes:
    """5 m/s along 120 degrees, rising by a tenth."""
    body = f"SOL_COMPUTED,DOPPLER_VELOCITY,{latency},0.000,5.0000,120.000000,0.1000,0.0"
    return novatel(name, body, second)


def bestnav(second: float = 0.0, *, leap: int = 18, base: str = "GPS", velocity: str = "") -> bytes:
    """Unicore's, with the sigmas of its velocity."""
    moving = "SOL_COMPUTED,DOPPLER_VELOCITY,0.000,0.000,5.0000,120.000000,0.1000,0.0200,0.0300"
    head = f'SOL_COMPUTED,NARROW_INT,{PLACE},"0",0.400,0.000,50,28,28,0,1,12,12,41'
    return unicore("BESTNAVA", f"{head},{velocity or moving}", second, leap, base)


def heading(second: float = 0.0, *, name: str = "UNIHEADINGA", kind: str = "NARROW_INT") -> bytes:
    body = f'SOL_COMPUTED,{kind},1.2040,143.6120,0.8450,0.0000,0.4180,0.6350,"7",24,19,19,12'
    return unicore(name, body, second)
