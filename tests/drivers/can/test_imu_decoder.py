"""CAN frames to IMU samples without a bus: worked frames, pairing, losses, refusals."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base import PermanentDriverError
from drivers.can.dbc import STANDARD_GRAVITY_M_S2, load_dbc, parameter_group
from drivers.can.imu import CanImuDecoder, CanImuOptions
from drivers.measurements import ArrivalStamp, DeviceStamp, ImuSample, KernelStamp
from tests.places import REPOSITORY

MS = 1_000_000
T0 = 50_000 * MS
EPOCH = 1_760_000_000_000 * MS

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


SBG = CanImuOptions(
    dbc="sbg_ellipse",
    gyro=("IMU_GYRO.GYRO_X", "IMU_GYRO.GYRO_Y", "-IMU_GYRO.GYRO_Z"),
    accel=("IMU_ACCEL.ACCEL_X", "-IMU_ACCEL.ACCEL_Y", "IMU_ACCEL.ACCEL_Z"),
    device_time="IMU_INFO.TIME_STAMP",
)
SBG_UNTIMED = SBG.model_copy(update={"device_time": ()})
MM7 = CanImuOptions(
    dbc="bosch_mm7_10",
    gyro=("-TX2.ROLL_RATE", "TX3.PITCH_RATE", "TX1.YAW_RATE"),
    accel=("TX2.AX", "TX1.AY", "TX3.AZ"),
    counter=("TX1.COUNTER", "TX2.COUNTER", "TX3.COUNTER"),
)
IMU04 = CanImuOptions(
    dbc="racelogic_imu04",
    gyro=("IMU_602.ROLL_RATE", "IMU_602.PITCH_RATE", "IMU_600.YAW_RATE"),
    accel=("IMU_600.ACCEL_X", "-IMU_601.ACCEL_Y", "IMU_603.ACCEL_Z"),
)
ACEINNA = CanImuOptions(
    dbc="aceinna_openimu300ri",
    gyro=("ARI.RATE_X", "ARI.RATE_Y", "ARI.RATE_Z"),
    accel=("ACCS.ACCEL_X", "ACCS.ACCEL_Y", "ACCS.ACCEL_Z"),
)


class Line:
    """Feeds a decoder with frames; frames of one sample lie 0.3 ms apart."""

    def __init__(self, options: CanImuOptions, kernel: bool = True) -> None:
        self.decoder = CanImuDecoder("imu", options)
        self.counters = self.decoder.counters
        self.samples: list[ImuSample] = []
        self.kernel = kernel
        self.offset_ns = EPOCH

    def frame(self, at_ns: int, can_id: int, data: bytes, extended: bool = False) -> None:
        stamp = at_ns + self.offset_ns if self.kernel else None
        sample = self.decoder.feed(can_id, extended, data, at_ns, stamp)
        if sample is not None:
            self.samples.append(sample)

    def burst(self, at_ns: int, *frames: tuple[int, bytes]) -> None:
        for i, (can_id, data) in enumerate(frames):
            self.frame(at_ns + i * 300_000, can_id, data)


def sbg_time(us: int) -> tuple[int, bytes]:
    return 0x120, struct.pack("<IHh", us % 2**32, 0, 2500)


def sbg_accel(k: int) -> tuple[int, bytes]:
    return 0x121, struct.pack("<3h", k % 1000, 2, 981)


def sbg_gyro(k: int) -> tuple[int, bytes]:
    return 0x122, struct.pack("<3h", k % 1000, 20, 350)


def mm7(k: int, tx: int, value: int | None = None) -> tuple[int, bytes]:
    raw = 0x8000 + (k % 1000 if value is None else value)
    return 0x170 + 4 * tx, struct.pack("<HHHBB", raw, 0, raw, k % 16, 0)


def test_axes_signs_and_units() -> None:
    line = Line(SBG)
    line.burst(T0, sbg_time(7000), (0x121, bytes.fromhex("0C00DEFFD503")))
    line.frame(T0 + MS, 0x122, bytes.fromhex("0A00ECFF5E01"))
    (sample,) = line.samples
    assert sample.gyro_rad_s == pytest.approx((0.01, -0.02, -0.35))
    assert sample.accel_m_s2 == pytest.approx((0.12, 0.34, 9.81))
    assert sample.stamp == DeviceStamp("imu", 7_000_000)
    assert sample.t_seen_ns == T0 + MS
    bosch = Line(MM7)
    for frame in ("A08F0000577800 00", "A87D0000118300 00"):
        bosch.frame(T0, 0x174 if frame.startswith("A0") else 0x178, bytes.fromhex(frame))
    bosch.frame(T0, 0x17C, struct.pack("<HHHBB", 0x8000, 0, 0x8000, 0, 0))
    (sample,) = bosch.samples
    assert sample.gyro_rad_s == pytest.approx(
        (math.radians(3.0), 0.0, math.radians(20.0)), abs=1e-9
    )
    assert sample.accel_m_s2 == pytest.approx(
        (0.10003 * STANDARD_GRAVITY_M_S2, -0.24999 * STANDARD_GRAVITY_M_S2, 0.0), abs=3e-4
    )


def test_constant_axes_of_a_partial_imu() -> None:
    options = CanImuOptions(
        dbc="bosch_mm5_10",
        gyro=("TX2.ROLL_RATE", 0.0, "TX1.YAW_RATE"),
        accel=("TX2.AX", "TX1.AY", "-9.80665"),
        timestamp="arrival",
        latency_s=0.004,
    )
    line = Line(options)
    for k in range(20):
        raw = 0x8000 + k
        data = struct.pack("<HHHH", raw, 0, raw, 0)
        line.burst(T0 + k * 10 * MS, (0x174, data), (0x178, data))
    assert len(line.samples) >= 14
    assert line.samples[-1].gyro_rad_s[1] == 0.0
    assert line.samples[-1].accel_m_s2[2] == -9.80665
    assert line.samples[-1].stamp == ArrivalStamp(0.004)


def test_device_time_wraps_and_counts_losses() -> None:
    line = Line(SBG)
    first_us = 2**32 - 20_000
    kept = [k for k in range(40) if k not in (10, 11, 25)]
    for k in kept:
        us = first_us + 5000 * k
        line.burst(T0 + 5 * MS * k, sbg_time(us), sbg_accel(k), sbg_gyro(k))
    ticks = [s.stamp.ticks_ns for s in line.samples if isinstance(s.stamp, DeviceStamp)]
    assert ticks == [(first_us + 5000 * k) * 1000 for k in kept]
    assert line.counters["lost_samples"] == 3
    assert line.counters["device_restarts"] == 0


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_a_stamp_message_ahead_or_behind_lends_its_time_to_its_own_sample(
    order: tuple[int, int, int],
) -> None:
    line = Line(SBG)
    for k in range(30):
        parts = (sbg_time(5000 * k), sbg_accel(k), sbg_gyro(k))
        line.burst(T0 + 5 * MS * k, *(parts[i] for i in order))
    assert len(line.samples) >= 24
    for sample in line.samples[-20:]:
        assert isinstance(sample.stamp, DeviceStamp)
        k = sample.stamp.ticks_ns // (5 * MS)
        assert sample.gyro_rad_s[0] == pytest.approx(k * 0.001)
        assert sample.accel_m_s2[0] == pytest.approx(k * 0.01)


def test_device_restart_begins_a_new_clock() -> None:
    line = Line(SBG)
    for k in range(20):
        line.burst(T0 + 5 * MS * k, sbg_time(900_000_000 + 5000 * k), sbg_accel(k), sbg_gyro(k))
    for k in range(20):
        line.burst(T0 + 5000 * MS + 5 * MS * k, sbg_time(5000 * k), sbg_accel(k), sbg_gyro(k))
    assert line.counters["device_restarts"] == 1
    assert line.samples[-1].stamp == DeviceStamp("imu/1", 95 * MS)
    assert line.counters["lost_samples"] == 0


def test_setting_the_system_clock_is_no_restart() -> None:
    line = Line(SBG)
    for k in range(40):
        if k == 20:
            line.offset_ns += 3600 * 1000 * MS
        line.burst(T0 + 5 * MS * k, sbg_time(5000 * k), sbg_accel(k), sbg_gyro(k))
    assert line.counters["device_restarts"] == 0
    assert len(line.samples) == 40


def device_us(line: Line) -> list[int]:
    stamps = [sample.stamp for sample in line.samples]
    assert all(isinstance(s, DeviceStamp) and s.device == "imu" for s in stamps)
    return [s.ticks_ns // 1000 for s in stamps if isinstance(s, DeviceStamp)]


def timed(k: int) -> tuple[tuple[int, bytes], ...]:
    return sbg_time(900_000_000 + 5000 * k), sbg_accel(k), sbg_gyro(k)


def test_a_stalled_reader_sees_a_burst_and_no_restart() -> None:
    """Nothing for 3.5 and 4 s, then all that was queued; the bus gives no stamps."""
    line = Line(SBG, kernel=False)
    for k in range(3000):
        due_ms = 5 * k
        for stalled, again in ((500, 4000), (6000, 10_000)):
            due_ms = again if stalled <= due_ms < again else due_ms
        line.burst(T0 + due_ms * MS, *timed(k))
    assert line.counters["device_restarts"] == 0
    assert device_us(line) == [900_000_000 + 5000 * k for k in range(3000)]
    assert line.counters["lost_samples"] == 0


def test_repeated_and_overtaken_frames_are_no_restart() -> None:
    """Every sample ten times; old ones again, seconds later, one by one and in a burst."""
    line = Line(SBG)
    for k in range(1200):
        for _ in range(10 if k % 50 == 0 else 1):
            line.burst(T0 + 5 * MS * k, *timed(k))
        if k % 100 == 99:
            line.burst(T0 + 5 * MS * k, *timed(max(0, k - 600)))
        if k == 1000:
            for old in range(100, 200):
                line.burst(T0 + 5 * MS * k, *timed(old))
    assert line.counters["device_restarts"] == 0
    assert device_us(line) == [900_000_000 + 5000 * k for k in range(1200)]
    assert line.counters["time_backward"] > 0


def test_a_restart_to_a_later_time_is_told_by_lateness_that_stays() -> None:
    """Two minutes dark, then a clock that goes on ten seconds behind where it was."""
    line = Line(SBG)
    for k in range(200):
        line.burst(T0 + 5 * MS * k, *timed(k))
    for k in range(1000):
        line.burst(T0 + 120_000 * MS + 5 * MS * k, *timed(2200 + k))
    assert line.counters["device_restarts"] == 1
    assert line.samples[-1].stamp == DeviceStamp("imu/1", (900_000_000 + 5000 * 3199) * 1000)


def test_device_time_that_goes_back_is_refused() -> None:
    line = Line(SBG)
    for k, us in enumerate([0, 5000, 10_000, 15_000, 20_000, 12_000, 30_000]):
        line.burst(T0 + 5 * MS * k, sbg_time(us), sbg_accel(k), sbg_gyro(k))
    ticks = [s.stamp.ticks_ns for s in line.samples if isinstance(s.stamp, DeviceStamp)]
    assert ticks == [us * 1000 for us in (0, 5000, 10_000, 15_000, 20_000, 30_000)]
    assert line.counters["time_backward"] == 1


def test_pairing_by_counter_needs_no_arrival_times() -> None:
    """Frames of two samples interleaved, all with the same stamp."""
    line = Line(MM7)
    for k in range(0, 40, 2):
        line.burst(T0, mm7(k, 1), mm7(k + 1, 1), mm7(k, 2), mm7(k + 1, 2))
        line.burst(T0, mm7(k, 3), mm7(k + 1, 3))
    assert len(line.samples) == 40
    for k, sample in enumerate(line.samples):
        rate = math.radians(0.005 * k)
        assert sample.gyro_rad_s == pytest.approx((-rate, rate, rate), abs=1e-9)
    assert line.counters["unpaired"] == 0


def test_counter_counts_losses_beyond_its_modulus() -> None:
    line = Line(MM7)
    kept = [*range(20), *range(20 + 37, 80)]
    for k in kept:
        line.burst(T0 + 5 * MS * k, mm7(k, 1), mm7(k, 2), mm7(k, 3))
    assert line.counters["lost_samples"] == 37
    assert len(line.samples) == len(kept)


def test_a_frame_missing_makes_no_sample() -> None:
    line = Line(MM7)
    for k in range(20):
        frames = [mm7(k, 1), mm7(k, 2), mm7(k, 3)]
        if k == 8:
            del frames[1]
        line.burst(T0 + 5 * MS * k, *frames)
    assert len(line.samples) == 19
    assert line.counters["unpaired"] == 2
    assert line.counters["lost_samples"] == 1


def test_pairing_by_arrival_learns_the_interval_and_counts_losses() -> None:
    line = Line(SBG_UNTIMED)
    for k in range(60):
        if k in (30, 31):
            continue
        frames = [sbg_accel(k), sbg_gyro(k)]
        if k == 45:
            del frames[0]
        line.burst(T0 + 5 * MS * k, *frames)
    for sample in line.samples:
        assert sample.gyro_rad_s[0] * 10.0 == pytest.approx(sample.accel_m_s2[0])
        assert isinstance(sample.stamp, KernelStamp)
    assert line.samples[-1].stamp == KernelStamp(EPOCH + T0 + 59 * 5 * MS)
    assert line.counters["lost_samples"] == 3
    assert len(line.samples) >= 50


def test_jitter_of_arrival_is_no_loss() -> None:
    line = Line(SBG_UNTIMED, kernel=False)
    late = {20: 9.0, 21: 4.5, 22: 0.5, 40: 2.0}
    for k in range(60):
        line.burst(T0 + int((5.0 * k + late.get(k, 0.0)) * MS), sbg_accel(k), sbg_gyro(k))
    assert line.counters["lost_samples"] == 0
    assert line.samples[-1].stamp == ArrivalStamp(0.0)


def test_duplicates_are_dropped() -> None:
    for options in (SBG, SBG_UNTIMED):
        line = Line(options)
        for k in range(20):
            frames = [sbg_time(5000 * k)] if options is SBG else []
            frames += [sbg_accel(k), sbg_gyro(k)]
            if k > 10:
                frames += frames[-2:]
            line.burst(T0 + 5 * MS * k, *frames)
        values = [s.gyro_rad_s[0] for s in line.samples]
        assert values == sorted(set(values))
        assert values[-1] == pytest.approx(0.019)
        assert line.counters["duplicates"] == 18


def test_equal_readings_at_rest_are_no_duplicates() -> None:
    line = Line(SBG_UNTIMED)
    for k in range(30):
        line.burst(T0 + 5 * MS * k, sbg_accel(0), sbg_gyro(0))
    assert line.counters["duplicates"] == 0
    assert len(line.samples) >= 24


def test_refusals_are_named() -> None:
    line = Line(IMU04)
    nan, inf = struct.pack(">2f", math.nan, 1.0), struct.pack(">2f", 1.0, math.inf)
    line.frame(T0, 0x600, nan)
    line.frame(T0, 0x600, inf)
    line.frame(T0, 0x600, struct.pack(">2f", 0.0, 3e38))
    line.frame(T0, 0x600, b"\x00" * 7)
    line.frame(T0, 0x7FF, b"\x00" * 8)
    line.frame(T0, 0x600, b"\x00" * 8, extended=True)
    assert line.counters["not_finite"] == 2
    assert line.counters["out_of_range"] == 1
    assert line.counters["wrong_length"] == 1
    assert line.counters["other_frames"] == 2
    line = Line(ACEINNA)
    not_available = struct.pack("<3H2x", 0xFFFF, 0x7D00, 0x7D00)
    line.frame(T0, 0x0CF02A80, not_available, extended=True)
    assert line.counters["out_of_range"] == 1


def test_j1939_matches_the_group_whatever_priority_and_one_source() -> None:
    ari, accs = bytes.fromhex("807D007C00870000"), bytes.fromhex("0C7DDE7CD5800000")
    for options, expected in (
        (ACEINNA, 0x42),
        (ACEINNA.model_copy(update={"source_address": 0x80}), 0x80),
    ):
        line = Line(options)
        for k in range(20):
            at_ns = T0 + 10 * MS * k
            for address in (0x42, 0x80):
                line.frame(
                    at_ns,
                    0x18F02A00 | address,
                    ari[:1] + bytes([125, address, 124]) + ari[4:],
                    True,
                )
                line.frame(at_ns + MS, 0x0CF02D00 | address, accs, True)
        assert len(line.samples) >= 14
        assert line.counters["other_source"] == 40
        rate_y = math.radians(((124 << 8 | expected) / 128.0) - 250.0)
        assert [s.gyro_rad_s[1] for s in line.samples] == pytest.approx(
            [rate_y] * len(line.samples)
        )
    assert parameter_group(0x18EA80FE) == 0xEA00


def test_filters_let_only_the_mapped_through() -> None:
    def passes(options: CanImuOptions, can_id: int, extended: bool) -> bool:
        return any(
            f["extended"] == extended and can_id & f["can_mask"] == f["can_id"] & f["can_mask"]
            for f in CanImuDecoder("imu", options).filters
        )

    assert passes(SBG, 0x120, False)
    assert not passes(SBG, 0x123, False)
    assert not passes(SBG, 0x120, True)
    assert passes(ACEINNA, 0x18F02A11, True)
    assert not passes(ACEINNA, 0x18F02911, True)
    addressed = ACEINNA.model_copy(update={"source_address": 0x80})
    assert passes(addressed, 0x18F02D80, True)
    assert not passes(addressed, 0x18F02D81, True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dbc": "no_such"}, ["no_such", "sbg_ellipse"]),
        ({"gyro": ("IMU_GYR.GYRO_X", "0", "0")}, ["IMU_GYR.GYRO_X", "IMU_GYRO.GYRO_X"]),
        ({"gyro": ("IMU_GYRO.GYROX", "0", "0")}, ["did you mean GYRO_X", "GYRO_Z"]),
        ({"accel": ("0", "0", "0")}, ["accel", "at least one"]),
        ({"accel": ("IMU_INFO.TEMPERATURE", "0", "0")}, ["degC", "m/s^2"]),
        ({"gyro_unit": "furlong"}, ["furlong", "rad/s"]),
        ({"device_time": "IMU_INFO.TEMPERATURE"}, ["unsigned"]),
        ({"device_time": "IMU_INFO.IMU_STATUS"}, ["device_time", "us"]),
    ],
)
def test_mistakes_in_the_mapping_are_explained(change: dict[str, object], words: list[str]) -> None:
    options = CanImuOptions.model_validate({**SBG.model_dump(), **change})
    with pytest.raises(PermanentDriverError) as mistake:
        CanImuDecoder("imu", options)
    for word in words:
        assert word in str(mistake.value)


def test_unit_override_and_foreign_spelling(tmp_path: Path) -> None:
    text = (
        'VERSION ""\nBU_: A\nBO_ 1 M: 4 A\n SG_ W : 0|16@1- (1,0) [0|0] "°/s" A\n'
        ' SG_ F : 16|16@1- (1,0) [0|0] "cm" A\n'
    )
    path = tmp_path / "own.dbc"
    path.write_text(text, encoding="utf-8")
    options = CanImuOptions(
        dbc=str(path), gyro=("M.W", 0.0, 0.0), accel=("M.F", 0.0, 0.0), accel_unit="mg"
    )
    line = Line(options)
    line.frame(T0, 1, struct.pack("<2h", 180, 1000))
    assert line.samples[0].gyro_rad_s[0] == pytest.approx(math.pi)
    assert line.samples[0].accel_m_s2[0] == pytest.approx(9.80665)


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0x120, 0x121, 0x122, 0x174, 0x178, 0x17C, 0x600, 0x601, 0x602, 0x603])
            | st.integers(0, 2**29 - 1),
            st.booleans(),
            st.binary(max_size=64),
            st.integers(-(2**62), 2**62),
            st.none() | st.integers(-(2**62), 2**62),
        ),
        max_size=60,
    )
)
def test_garbage_never_raises_and_samples_are_finite(
    frames: list[tuple[int, bool, bytes, int, int | None]],
) -> None:
    for options in (SBG, SBG_UNTIMED, MM7, IMU04, ACEINNA):
        decoder = CanImuDecoder("imu", options)
        for can_id, extended, data, t_seen_ns, realtime_ns in frames:
            sample = decoder.feed(can_id, extended, data, t_seen_ns, realtime_ns)
            if sample is not None:
                assert all(map(math.isfinite, sample.gyro_rad_s + sample.accel_m_s2))
