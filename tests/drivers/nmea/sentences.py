"""Golden sentences of a receiver, changed ones, and what the decoder makes of them."""

from __future__ import annotations

from datetime import UTC, date, datetime
from functools import reduce
from operator import xor

from drivers.measurements import (
    Measurement,
    PositionFix,
)
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding

EARLIEST = date(2025, 1, 1)
UTC_NS = int(datetime(2025, 6, 19, 2, 14, 29, tzinfo=UTC).timestamp()) * 1_000_000_000
# Golden sentences; the checksums were computed apart from this project's code.
GGA = "$GNGGA,021429.00,3958.12345,N,11619.54321,E,4,18,0.62,45.300,M,-9.100,M,1.0,0000*47"
GGA_SW = "$GPGGA,021429.00,3958.12345,S,11619.54321,W,1,08,1.10,45.3,M,,M,,*72"
GGA_NO_FIX = "$GAGGA,021429.00,,,,,0,00,99.99,,,,,,*7B"
RMC = "$GNRMC,021429.00,A,3958.12345,N,11619.54321,E,19.438,090.00,190625,,,R,V*2B"
RMC_V = "$GNRMC,021429.00,V,3958.12345,N,11619.54321,E,,,190625,,,N,V*2E"
VTG = "$GNVTG,090.00,T,,M,19.438,N,36.000,K,R*3B"
GNS = "$GNGNS,021429.00,3958.12345,N,11619.54321,E,RRNAN,18,0.62,45.300,-9.100,1.0,0000,V*53"
GSA = "$GNGSA,A,3,03,06,14,17,19,24,,,,,,,1.21,0.62,1.04,1*0A"
GSA_2D = "$GNGSA,A,2,03,06,14,,,,,,,,,,2.21,1.62,1.50,4*05"
GST = "$GNGST,021429.00,12,0.020,0.010,45,0.014,0.012,0.031*40"
GST_EMPTY = "$GBGST,021429.00,12,,,,,,*64"
ZDA = "$BDZDA,021429.00,19,06,2025,00,00*70"
ZDA_RDSS = "$BDZDA,3,000329.00,01,01,2006,-08,00,00,00,00,N*0F"
HDT = "$GNHDT,350.00,T*1D"
THS = "$GNTHS,010.50,A*1D"
THS_E = "$GNTHS,010.50,E*19"


def made(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}"


def changed(sentence: str, old: str, new: str) -> str:
    """A golden sentence with one field changed, and its checksum mended."""
    assert old in sentence
    return made(sentence[1:-3].replace(old, new, 1))


def at(sentence: str, time: str) -> str:
    return changed(sentence, "021429.00", time)


def wire(*sentences: str) -> bytes:
    return "".join(sentence + "\r\n" for sentence in sentences).encode()


def decoder(**options: object) -> NmeaDecoder:
    return NmeaDecoder("gnss", NmeaDecoding.model_validate({"earliest_date": EARLIEST, **options}))


def decode(*sentences: str, **options: object) -> tuple[list[Measurement], NmeaDecoder]:
    one = decoder(**options)
    return one.feed(wire(*sentences), 7) + one.flush(), one


def fix_of(*sentences: str, **options: object) -> PositionFix:
    (fix,) = [m for m in decode(*sentences, **options)[0] if isinstance(m, PositionFix)]
    return fix


def fixes(found: list[Measurement]) -> list[PositionFix]:
    return [m for m in found if isinstance(m, PositionFix)]


def gga(second: int, quality: int = 4) -> bytes:
    """A fix at 02:14 and some seconds, as it comes off the line."""
    return wire(
        made(
            f"GNGGA,0214{second:02d}.00,3958.12345,N,11619.54321,E,{quality},18,0.62,45.3,M,-9.1,M,,"
        )
    )


def rmc(second: int) -> bytes:
    """Velocity and date, 2026-12-01, of the same epoch."""
    return wire(
        made(f"GNRMC,0214{second:02d}.00,A,3958.12345,N,11619.54321,E,19.438,090.00,011226,,,R,V")
    )
