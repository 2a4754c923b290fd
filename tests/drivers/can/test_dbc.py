"""The shipped descriptions of frames: worked frames of the manuals, both ways."""

from __future__ import annotations

import cantools
import pytest

from drivers.can.dbc import load_dbc
from tests.places import REPOSITORY

WORKED = [
    (
        "sbg_ellipse",
        0x121,
        "0C 00 DE FF D5 03",
        {"ACCEL_X": 0.12, "ACCEL_Y": -0.34, "ACCEL_Z": 9.81},
    ),
    ("sbg_ellipse", 0x122, "0A 00 EC FF 5E 01", {"GYRO_X": 0.01, "GYRO_Y": -0.02, "GYRO_Z": 0.35}),
    (
        "xsens_mti600",
        0x032,
        "00 08 FF F0 00 B0",
        {"GYRO_X": 0.015625, "GYRO_Y": -0.03125, "GYRO_Z": 0.34375},
    ),
    (
        "xsens_mti600",
        0x034,
        "00 20 FF C0 09 D0",
        {"ACCEL_X": 0.125, "ACCEL_Y": -0.25, "ACCEL_Z": 9.8125},
    ),
    ("xsens_mti600", 0x005, "00 01 E2 40", {"TIME": 12.3456}),
    ("bosch_mm5_10", 0x174, "A0 8F 00 00 57 78 00 00", {"YAW_RATE": 20.0, "AY": -0.24999}),
    ("bosch_mm5_10", 0x178, "A8 7D 00 00 11 83 00 00", {"ROLL_RATE": -3.0, "AX": 0.10003}),
    ("bosch_mm7_10", 0x174, "A0 8F 00 00 57 78 00 00", {"YAW_RATE": 20.0, "AY": -0.24999}),
    ("bosch_mm7_10", 0x178, "A8 7D 00 00 11 83 00 00", {"ROLL_RATE": -3.0, "AX": 0.10003}),
    ("racelogic_imu04", 0x600, "41 A0 00 00 3D CC CC CD", {"YAW_RATE": 20.0, "ACCEL_X": 0.1}),
    (
        "aceinna_openimu300ri",
        0x0CF02A80,
        "80 7D 00 7C 00 87 00 00",
        {"RATE_X": 1.0, "RATE_Y": -2.0, "RATE_Z": 20.0},
    ),
    (
        "aceinna_openimu300ri",
        0x08F02D80,
        "0C 7D DE 7C D5 80 00 00",
        {"ACCEL_X": 0.12, "ACCEL_Y": -0.34, "ACCEL_Z": 9.81},
    ),
]


@pytest.mark.parametrize(("dbc", "can_id", "frame", "values"), WORKED)
def test_worked_frames_both_ways(
    dbc: str, can_id: int, frame: str, values: dict[str, float]
) -> None:
    message = load_dbc(dbc).get_message_by_frame_id(can_id)
    data = bytes.fromhex(frame)
    decoded = message.decode(data)
    assert isinstance(decoded, dict)
    for name, value in values.items():
        assert decoded[name] == pytest.approx(value, abs=6e-6)
    others = {signal.name: decoded[signal.name] for signal in message.signals}
    assert message.encode({**others, **values}) == data


@pytest.mark.parametrize("dbc", sorted({worked[0] for worked in WORKED}))
def test_shipped_dbc_is_strict_and_has_units(dbc: str) -> None:
    path = REPOSITORY / "config" / "dbc" / f"{dbc}.dbc"
    database = cantools.database.load_file(path, strict=True)
    for message in database.messages:
        for signal in message.signals:
            if (
                signal.name.startswith(("GYRO", "RATE_", "YAW_RATE"))
                and "STATUS" not in signal.name
            ):
                assert signal.unit in {"rad/s", "deg/s"}
