"""Every worked and every real frame of both RDSS wire families, and the message it says."""

from __future__ import annotations

import pytest

from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.messages import (
    BeamPower,
    BeamPowerRequest,
    DeviceClock,
    Feedback,
    Fix,
    HeightMode,
    Identity,
    IdentityRequest,
    Message,
    Outcome,
    OutputRequest,
    PortRateRequest,
    PositionRequest,
    SelfTest,
    SelfTestRequest,
    StopRequest,
    Text,
    TextRequest,
    TimeRequest,
    Unknown,
    VersionRequest,
)

U = 242286
MODULES = {"4.0": binary_4_0, "2.1": text_2_1}


def dms(d: int, m: int, s: float) -> float:
    return pytest.approx(d + m / 60 + s / 3600, abs=1e-9)  # type: ignore[return-value]


def binary_fix(**changes: object) -> Fix:
    """The position of the real DWXX, own fix of this user."""
    fields: dict[str, object] = {
        "user": U,
        "time_of_day_s": 41330.0,
        "fraction": 71,
        "lat_deg": 24.581555555555557,
        "lon_deg": 118.09658333333333,
        "height_m": 20.0,
        "height_anomaly_m": 10.0,
    }
    return Fix(**(fields | changes))  # type: ignore[arg-type]


BINARY: list[tuple[str, Message]] = [
    ("24 49 43 4A 43 00 0C 00 00 00 00 2B", IdentityRequest()),
    ("24 47 4C 4A 43 00 0C 03 B2 6E 00 F5", BeamPowerRequest(U)),
    ("24 58 54 5A 4A 00 0D 03 B2 6E 00 00 EA", SelfTestRequest(U)),
    ("24 58 54 5A 4A 00 0D 03 B2 6E 00 0A E0", SelfTestRequest(U, 10)),
    ("24 53 4A 53 43 00 0D 03 B2 6E 00 00 FF", TimeRequest(U)),
    ("24 42 42 44 51 00 0B 03 B2 6E E5", VersionRequest(U)),
    ("24 43 4B 53 43 00 0C 03 B2 6E 00 EF", PortRateRequest(U)),
    (
        "24 44 57 53 51 00 16 00 00 00 04 00 00 00 00 00 00 00 00 00 00 27",
        PositionRequest(antenna_height_m=0.0),
    ),
    (
        "24 44 57 53 51 00 16 03 B2 6E 04 00 00 00 19 00 00 00 00 00 00 E1",
        PositionRequest(U, antenna_height_m=2.5),
    ),
    (
        "24 44 57 53 51 00 16 03 B2 6E 00 01 B6 00 00 00 00 00 00 00 00 4B",
        PositionRequest(U, HeightMode.GIVEN, height_m=438.0),
    ),
    (
        "24 44 57 53 51 00 16 03 B2 6E 00 80 0C 00 00 00 00 00 00 00 00 70",
        PositionRequest(U, HeightMode.GIVEN, height_m=-12.0),
    ),
    (
        "24 44 57 53 51 00 16 03 B2 6E 24 00 00 00 00 00 00 00 00 00 00 D8",
        PositionRequest(U, antenna_height_m=0.0, emergency=True),
    ),
    (
        "24 44 57 53 51 00 16 03 B2 6E 04 00 00 00 19 00 00 00 00 00 3C DD",
        PositionRequest(U, antenna_height_m=2.5, period_s=60),
    ),
    ("24 4A 53 5A 4C 00 0F 03 B2 6E 44 57 53 51 EA", StopRequest(U, "DWSQ")),
    (
        "24 44 57 58 58 00 1F 03 B2 6E 08 00 00 00 08 31 24 32 71 17 28 00 17 02 0E 06 00 0E 01 06"
        " 8A",
        Fix(
            U,
            31776.0,
            dms(23, 2, 14.6),
            dms(113, 23, 40.0),
            14.0,
            -6.0,
            precision_class_m=100,
            fraction=50,
        ),
    ),
    (
        "24 44 57 58 58 00 1F 03 B2 6E 00 00 00 00 0B 1C 32 47 76 05 2F 07 18 22 35 06 40 0C 00 0A"
        " 81",
        binary_fix(height_m=-12.0),
    ),
    (
        "24 44 57 58 58 00 1F 03 B2 6E 0A 00 00 00 0B 1C 32 47 76 05 2F 07 18 22 35 06 00 14 00 0A"
        " D3",
        binary_fix(precision_class_m=100, multi_value=True),
    ),
    (
        "24 44 57 58 58 00 1F 1F FA 66 08 00 00 00 0B 1C 32 47 76 05 2F 07 18 22 35 06 00 14 00 0A"
        " 8D",  # real
        binary_fix(user=2095718, precision_class_m=100),
    ),
    ("24 46 4B 58 58 00 10 03 B2 6E 00 44 57 53 51 F7", Feedback(Outcome.OK, "DWSQ", user=U)),
    (
        "24 46 4B 58 58 00 10 03 B2 6E 01 44 57 53 51 F6",
        Feedback(Outcome.FAILED, "DWSQ", code=1, user=U),
    ),
    (
        "24 46 4B 58 58 00 10 03 B2 6E 02 00 00 00 00 E4",
        Feedback(Outcome.NOT_LOCKED, code=2, user=U),
    ),
    (
        "24 46 4B 58 58 00 10 03 B2 6E 04 00 00 00 25 C7",
        Feedback(Outcome.FREQUENCY, wait_s=37.0, code=4, user=U),
    ),
    (
        "24 46 4B 58 58 00 10 03 B2 6E 07 00 00 00 00 E1",
        Feedback(Outcome.SUPPRESSED, code=7, user=U),
    ),
    (
        "24 46 4B 58 58 00 10 03 B2 6E 08 00 00 00 00 EE",
        Feedback(Outcome.SILENCE_OR_LIFTED, code=8, user=U),
    ),
    (
        "24 49 43 58 58 00 16 03 B2 6E 00 00 00 0B 06 00 3C 03 00 00 00 D5",
        Identity(U, 60, broadcast_id=11, user_class=6, comm_level=3),
    ),
    (
        "24 5A 4A 58 58 00 15 03 B2 6E 00 00 64 02 00 03 04 00 02 00 9D",
        SelfTest(100.0, user=U, inbound_state=2, levels=(0, 3, 4, 0, 2, 0)),
    ),
    ("24 47 4C 5A 4B 00 11 03 B2 6E 00 03 04 00 02 00 F5", BeamPower((0, 3, 4, 0, 2, 0), U)),
    (
        "24 53 4A 58 58 00 12 03 B2 6E 07 EA 0B 14 17 21 07 33",
        DeviceClock(2026, 11, 20, 84787.0, user=U),
    ),
    (
        "24 54 58 58 58 00 1A 03 B2 6E 60 03 B2 E7 0B 1E 00 30 A4 68 65 6C 6C 6F 00 38",
        Text(242407, b"\xa4hello", "mixed", U, minute_of_day=690),
    ),
    (
        "24 54 58 53 51 00 18 03 B2 6E 46 03 B2 E7 00 30 00 A4 68 65 6C 6C 6F 0B",
        TextRequest(242407, b"\xa4hello", "mixed", U),
    ),
]
BINARY_DECODED_ONLY: list[tuple[str, Message]] = [
    (
        "24 46 4B 58 58 00 10 03 B2 6E 04 25 00 00 00 C7",  # little-endian wait
        Feedback(Outcome.FREQUENCY, wait_s=37.0, code=4, user=U),
    ),
]

LAT, LON = 23 + 2.2434 / 60, 113 + 23.6667 / 60


def text_fix(
    time_of_day_s: float, height_m: float, anomaly_m: float, *, user: int = U, **changes: object
) -> Fix:
    fields: dict[str, object] = {"lat_deg": LAT, "lon_deg": LON} | changes
    return Fix(
        user=user,
        time_of_day_s=time_of_day_s,
        height_m=height_m,
        height_anomaly_m=anomaly_m,
        **fields,  # type: ignore[arg-type]
    )


def old(
    outcome: Outcome, command: str = "DWA", code: int = 0, wait: float | None = None
) -> Message:
    return Feedback(outcome, command, wait, code, inhibited=code != 0)


TEXT: list[tuple[str, Message]] = [
    ("$CCICA,0,00*7B", IdentityRequest()),
    ("$CCRMO,BSI,2,0*26", BeamPowerRequest()),
    ("$CCRMO,BSI,2,5*23", BeamPowerRequest(period_s=5)),
    ("$CCRMO,ZDA,2,0*21", TimeRequest()),
    ("$CCRMO,DWR,2,0*3F", OutputRequest("DWR", 2, 0)),
    ("$CCRMO,,3,*4F", OutputRequest("", 3)),
    ("$CCDWA,0000000,V,1,L,,0,,,0*65", PositionRequest(antenna_height_m=0.0)),  # real
    ("$CCDWA,0242286,V,1,L,,2.5,,,0*74", PositionRequest(U, antenna_height_m=2.5)),
    ("$CCDWA,0242286,V,0,L,438.0,,,,0*7D", PositionRequest(U, HeightMode.GIVEN, height_m=438.0)),
    ("$CCDWA,0242286,A,1,L,,2.5,,,0*63", PositionRequest(U, antenna_height_m=2.5, emergency=True)),
    ("$CCDWA,0242286,V,1,L,,2.5,,,60*42", PositionRequest(U, antenna_height_m=2.5, period_s=60)),
    (
        "$CCDWA,0242286,V,2,L,,2.5,95210.0,18.5,0*44",
        PositionRequest(
            U,
            HeightMode.ALTIMETER_1,
            antenna_height_m=2.5,
            pressure_pa=95210.0,
            temperature_c=18.5,
        ),
    ),
    ("$CCWBA,0242286,L,2.5,0*39", Unknown("CCWBA", b"0242286,L,2.5,0")),
    ("$BDFKI,DWA,Y,Y,0,0000*0C", old(Outcome.OK)),
    ("$BDFKI,DWA,N,Y,0,0037*1F", old(Outcome.FREQUENCY, wait=37.0)),
    ("$BDFKI,DWA,N,N,0,0000*0C", old(Outcome.FREQUENCY)),
    ("$BDFKI,DWA,N,Y,1,0000*1A", old(Outcome.SUPPRESSED, code=1)),
    ("$BDFKI,DWA,N,Y,2,0000*19", old(Outcome.LOW_BATTERY, code=2)),
    ("$BDFKI,DWA,N,Y,3,0000*18", old(Outcome.SILENCE, code=3)),
    ("$BDFKI,DWA,N,Y,0,0058*16", old(Outcome.FREQUENCY, wait=58.0)),  # real, as are the next four
    ("$BDFKI,TXA,Y,Y,0,0000*13", old(Outcome.OK, "TXA")),
    ("$BDFKI,TXA,N,Y,0,0000*04", old(Outcome.NOT_SENT, "TXA")),
    ("$BDFKI,TXA,Y,Y,0,0040*17", old(Outcome.OK, "TXA", wait=40.0)),
    (
        "$BDFKI,082920,TCQ,Y,0,0*70",
        Feedback(Outcome.OK, "TCQ", inhibited=False, time_of_day_s=30560),
    ),
    (
        "$BDDWR,1,0242286,235959.80,2302.2434,N,11323.6667,E,438.2,M,-6.0,M,0,V,V,L*25",
        text_fix(86399.8, 438.2, -6.0),
    ),
    (
        "$BDDWR,1,0242286,000000.30,2302.2434,N,11323.6667,E,438.2,M,-6.0,M,1,V,A,L*39",
        text_fix(0.3, 438.2, -6.0, precision_class_m=100, multi_value=True),
    ),
    (
        "$BDICI,0242286,00242286,0000011,6,60,3,N,0*38",
        Identity(U, 60, broadcast_id=11, user_class=6, comm_level=3, serial=242286),
    ),
    ("$BDICI,0000000,00000000,0000000,0,0,0,N,0*0B", Identity(0, 0)),  # real: no card
    (
        "$BDBSI,02,08,0,3,0,0,0,0,0,3,0,0*54",
        BeamPower((0, 3, 0, 0, 0, 0, 0, 3, 0, 0), response_beam=2, time_difference_beam=8),
    ),
    (
        "$BDZDA,1,233307.00,20,11,2026,-08,00,000000.00,0,0,Y*3A",
        DeviceClock(2026, 11, 20, 84787.0, zone_h=-8, locked=True),
    ),
    (
        "$BDZTI,0,0,0,0,1,0,100.0,0400*6B",
        SelfTest(100.0, external_power=True, charging=False, remaining_min=240),
    ),
    ("$BDTXR,1,0242407,2,,A468656C6C6F*48", Text(242407, b"\xa4hello", "mixed")),
    ("$CCTXA,0242407,1,2,A468656C6C6F*71", TextRequest(242407, b"\xa4hello", "mixed")),
]
TEXT_DECODED_ONLY: list[tuple[str, Message]] = [
    ("$CCJMS,E*3D", Unknown("CCJMS", b"E")),  # read, never written
    ("$CCJMS,N*36", Unknown("CCJMS", b"N")),
    (
        "$BDDWR,1,0242286,084936.50,2302.2434,N,11323.6667,E,14,M,-6,M,1,A,V,L*07",
        text_fix(31776.5, 14.0, -6.0, precision_class_m=100, emergency=True),
    ),
    (
        "$BDDWR,1,0242407,084936.50,2302.2434,N,11323.6667,E,14,M,-6,M,1,V,V,L*1F",  # real
        text_fix(31776.5, 14.0, -6.0, user=242407, precision_class_m=100),
    ),
    (
        "$BDDWR,1,0242286,021549.65,2240.4051,N,11402.5601,E,47,M,-3,M,1,V,V,L*1F",  # real
        text_fix(
            8149.65,
            47.0,
            -3.0,
            precision_class_m=100,
            lat_deg=22 + 40.4051 / 60,
            lon_deg=114 + 2.5601 / 60,
        ),
    ),
    (
        "$BDZDA,3,000329.00,01,01,2006,-08,00,00,00,00,N*0F",  # real
        DeviceClock(2006, 1, 1, 209.0, zone_h=-8, locked=False, mode=3),
    ),
    ("$BDZDA,021429.00,19,06,2025,00,00*70", Unknown("BDZDA", b"021429.00,19,06,2025,00,00")),
]


def line(sentence: str) -> bytes:
    return sentence.encode() + b"\r\n"


WRITTEN = [("4.0", bytes.fromhex(h), m) for h, m in BINARY]
WRITTEN += [("2.1", line(t), m) for t, m in TEXT]
READ = WRITTEN + [("4.0", bytes.fromhex(h), m) for h, m in BINARY_DECODED_ONLY]
READ += [("2.1", line(t), m) for t, m in TEXT_DECODED_ONLY]
FRAMES = {f: [raw for family, raw, _ in READ if family == f] for f in MODULES}


def same(got: Message, want: Message) -> bool:
    if isinstance(got, Fix) and isinstance(want, Fix):
        assert got.lat_deg == pytest.approx(want.lat_deg, abs=1e-9)
        assert got.lon_deg == pytest.approx(want.lon_deg, abs=1e-9)
        rest = [
            [getattr(m, n) for n in Fix.__slots__ if n not in ("lat_deg", "lon_deg")]
            for m in (got, want)
        ]
        return rest[0] == rest[1]
    return got == want
