"""DBC files with a flaw: what is sound is read as without it, what is not is left out by name."""

from __future__ import annotations

import logging
import random
from pathlib import Path
from typing import Any

import cantools
import pytest

from drivers.base import PermanentDriverError
from drivers.can.dbc import SHIPPED, find_signal, load_dbc
from drivers.can.dbc_salvage import UnreadableError, read_whole, sound_part, unselected

MULTIPLEXED = """VERSION ""
BU_: A
BO_ 200 MUX: 8 A
 SG_ S M : 0|8@1+ (1,0) [0|255] "" A
 SG_ T m1M : 8|8@1+ (1,0) [0|255] "" A
 SG_ U m3 : 16|16@1- (0.5,0) [0|0] "m" A
 SG_ V m2 : 16|32@1- (1,0) [0|0] "m/s" A
SIG_VALTYPE_ 200 V : 1;
SG_MUL_VAL_ 200 T S 1-1;
SG_MUL_VAL_ 200 U T 3-5;
SG_MUL_VAL_ 200 V S 2-2;
"""

FLAWS = {
    # As public files have them: opendbc (issues 330, 1422), cantools (issues 150, 301, 504, 734).
    "identifier of 29 bits without its mark": (
        'BO_ 419358976 EEC1: 8 X\n SG_ A : 0|8@1+ (1,0) [0|1] "" X\n',
        set(),
    ),
    "identifier of 30 bits": (
        'BO_ 1075054137 BDB: 8 X\n SG_ A : 0|8@1+ (1,0) [0|1] "" X\n',
        {"BDB"},
    ),
    "extended identifier of 32 bits": ("BO_ 4294967295 WIDE: 8 X\n", {"WIDE"}),
    "name that begins with a digit": (
        'BO_ 1275 2017_5: 8 X\n SG_ A : 0|8@1+ (1,0) [0|1] "" X\n',
        {"2017_5"},
    ),
    "identifier in hexadecimals": ("BO_ 0x123 HEX: 8 X\n", {"HEX"}),
    "name with a blank": ("BO_ 1300 MY MSG: 8 X\n", {"MY MSG"}),
    "decimal comma": (
        'BO_ 1301 FOO: 8 X\n SG_ A : 0|8@1+ (0,1,0) [0|1] "" X\n SG_ B : 8|8@1+ (1,0) [0|1] "" X\n',
        {"FOO.A"},
    ),
    "name with a dash": (
        'BO_ 1302 FOO: 8 X\n SG_ a-b : 0|8@1+ (1,0) [0|1] "" X\n SG_ B : 8|8@1+ (1,0) [0|1] "" X\n',
        {"FOO.a-b"},
    ),
    "signal without a bit": (
        'BO_ 1303 FOO: 8 X\n SG_ A : 0|0@1+ (1,0) [0|1] "" X\n',
        {"FOO"},
    ),
    "signal of half a gigabit": (
        'BO_ 1311 FOO: 8 X\n SG_ A : 0|419358976@1+ (1,0) [0|1] "" X\n'
        ' SG_ B : 8|8@1+ (1,0) [0|1] "" X\n',
        {"FOO.A"},
    ),
    "signal of half a gigabit on its message's line": (
        'BO_ 1314 FOO: 8 X SG_ A : 0|419358976@1+ (1,0) [0|1] "" X\n',
        {"FOO"},
    ),
    "signal that begins far behind": (
        'BO_ 1312 FOO: 8 X\n SG_ A : 419358976|8@1+ (1,0) [0|1] "" X\n',
        {"FOO"},
    ),
    "message of half a gigabyte": (
        'BO_ 1313 FOO: 419358976 X\n SG_ A : 0|8@1+ (1,0) [0|1] "" X\n',
        {"FOO"},
    ),
    "selector in a small letter": (
        'BO_ 1310 FOO: 8 X\n SG_ S m : 6|2@1+ (1,0) [0|3] "" X\n'
        ' SG_ A m3 : 0|6@1+ (1,0) [0|1] "" X\n',
        {"FOO.A"},
    ),
    "multiplexer that cannot be read": (
        'BO_ 1304 FOO: 8 X\n SG_ S M : 0|8@1+ (1;0) [0|1] "" X\n'
        ' SG_ B m1 : 8|8@1+ (1,0) [0|1] "" X\n',
        {"FOO"},
    ),
    "type that cannot be read": (
        'BO_ 1305 FOO: 8 X\n SG_ A : 0|32@1- (1,0) [0|0] "" X\n'
        'SIG_VALTYPE_ 1305 A : 1\nCM_ "end";\n',
        {"FOO"},
    ),
    "comment without its signal": ('CM_ SG_ 304 "Seems to be platform-agnostic";\n', set()),
    "comment without an end": ('CM_ SG_ 304 A "never ends;\n', set()),
    "message inside a comment": (
        'BS_: 1 : 0,0\nCM_ "as in\nBO_ 1306 NONE: 8 X\n SG_ A : 0|8@1+ (1,0";\n',
        set(),
    ),
    "type cut off at the end": (
        'BO_ 1307 FOO: 8 X\n SG_ A : 0|32@1- (1,0) [0|0] "" X\nSIG_VALTYPE_ 1307 A : 1',
        {"FOO"},
    ),
    "signal cut off at the end": ("BO_ 1308 FOO: 8 X\n SG_ A : 0|32@1", {"FOO"}),
    "bit timing": ("BS_: 500000 : 0,0\n", set()),
    "values of no message": ('VAL_ 777 Foo 0 "a" 1 "b" ;\n', set()),
    "type of no signal": ("SIG_VALTYPE_ 777 Foo : 1;\n", set()),
    "attribute without definition": ('BA_ "GenSigStartValue" SG_ 777 Foo 3;\n', set()),
    "keyword without its dash": ('BA_DEF_DEF "X" 3;\n', set()),
    "keyword that nobody knows": ("HELLO_ 3;\n", set()),
    "bytes of another file": ("\x00\x01<html>\n", set()),
}


def told(dbc: Any) -> dict[str, Any]:
    """All of a file's messages that decoding depends on."""
    return {
        m.name: (
            m.frame_id,
            m.is_extended_frame,
            m.length,
            m.protocol,
            [
                (
                    s.name,
                    (s.start, s.length, s.byte_order, s.is_signed, s.is_float),
                    (s.scale, s.offset, s.minimum, s.maximum, s.unit),
                    (s.multiplexer_signal, s.multiplexer_ids, s.is_multiplexer),
                )
                for s in m.signals
            ],
        )
        for m in dbc.messages
    }


def content(name: str) -> str:
    return MULTIPLEXED if name == "multiplexed" else (SHIPPED / f"{name}.dbc").read_text("cp1252")


NAMES = ["multiplexed", *sorted(path.stem for path in SHIPPED.glob("*.dbc"))]


@pytest.mark.parametrize("flaw", FLAWS)
@pytest.mark.parametrize("name", ["multiplexed", "aceinna_openimu300ri", "racelogic_imu04"])
def test_what_is_sound_is_read_as_without_the_flaw(name: str, flaw: str, tmp_path: Path) -> None:
    """J1939, floats and two storeys of multiplexers among it."""
    whole = cantools.database.load_string(content(name), database_format="dbc", strict=False)
    text, left_out = FLAWS[flaw]
    path = tmp_path / "flawed.dbc"
    path.write_text(f"{content(name)}\n{text}", "cp1252")
    if not unselected(path.read_text("cp1252")):
        with pytest.raises(Exception):  # noqa: B017, PT011
            read_whole(path.read_text("cp1252"))
    found = load_dbc(str(path))
    expected = told(whole)
    assert {each: told(found)[each] for each in expected} == expected
    assert set(found.left_out) == left_out  # type: ignore[attr-defined]


def test_a_format_that_no_list_has_costs_no_message(tmp_path: Path) -> None:
    """An attribute, on which no frame depends."""
    path = tmp_path / "flawed.dbc"
    path.write_text(
        f"{MULTIPLEXED}BO_ 1315 FOO: 8 X\n"
        ' SG_ A : 0|8@1+ (2,0) [0|1] "" X\n'
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN";\n'
        'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";\nBA_ "VFrameFormat" BO_ 1315 14;\n'
    )
    found = load_dbc(str(path))
    assert set(told(found)) == {"FOO", *told(read_whole(MULTIPLEXED))}
    assert found.get_message_by_name("FOO").decode(bytes([3] + [0] * 7)) == {"A": 6}
    assert set(found.left_out) == {"an attribute of FOO"}  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", NAMES)
def test_a_sound_file_by_its_messages_alone(name: str) -> None:
    whole = cantools.database.load_string(content(name), database_format="dbc", strict=False)
    found = sound_part(content(name))
    assert told(found) == told(whole)
    assert found.left_out == {}


def test_who_asks_for_what_is_left_out_hears_why(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "flawed.dbc"
    texts = [FLAWS[f][0] for f in ("decimal comma", "identifier of 30 bits")]
    texts.append("BO_ 4294967295 IMU_600: 8 X\n")  # of the name of a sound one
    path.write_text("\n".join((content("racelogic_imu04"), *texts)))
    with caplog.at_level(logging.WARNING, "drivers.can.dbc"):
        dbc = load_dbc(str(path))
    assert [record.getMessage().split(": ")[1] for record in caplog.records] == [
        "FOO.A is left out",
        "BDB is left out",
        "IMU_600 is left out",
    ]
    find_signal(dbc, "FOO.B", "gyro")
    find_signal(dbc, "IMU_600.YAW_RATE", "gyro")
    with pytest.raises(PermanentDriverError, match=r"gyro: FOO.A cannot be read .* \(0,1>>!<<,0\)"):
        find_signal(dbc, "FOO.A", "gyro")
    with pytest.raises(PermanentDriverError, match=r"BDB cannot be read .* more than 11 bits"):
        find_signal(dbc, "BDB.A", "gyro")


def test_an_identifier_of_29_bits_needs_no_mark(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As opendbc, Vector's users and others write it: no standard frame can have it. Its types and
    attributes are found by the same number, and whoever has all messages so has a file."""
    marked = content("aceinna_openimu300ri")
    ids = {m.frame_id for m in load_dbc("aceinna_openimu300ri").messages if m.is_extended_frame}
    assert len(ids) >= 3
    bare = marked
    for can_id in ids:
        assert str(can_id | 1 << 31) in marked
        bare = bare.replace(str(can_id | 1 << 31), str(can_id))
    path = tmp_path / "bare.dbc"
    path.write_text(bare, "cp1252")
    with caplog.at_level(logging.WARNING, "drivers.can.dbc"):
        found = load_dbc(str(path))
    assert told(found) == told(load_dbc("aceinna_openimu300ri"))
    (record,) = caplog.records
    assert "identifiers of more than 11 bits are read as extended: " in record.getMessage()
    floats = (
        'BO_ 419358976 EEC1: 8 X\n SG_ A : 0|32@1- (1,0) [0|0] "" X\n'
        "SIG_VALTYPE_ 419358976 A : 1;\n"
    )
    (message,) = sound_part(f'VERSION ""\n{floats}').messages
    assert (message.frame_id, message.is_extended_frame) == (0x18FEE900, True)
    assert message.signals[0].is_float


def test_a_multiplexed_signal_without_a_selector_is_no_plain_one(tmp_path: Path) -> None:
    """As in a public file of the PQ platform: it would be read in frames that hold another one."""
    path = tmp_path / "pq.dbc"
    path.write_text(
        'VERSION ""\nBO_ 648 Motor_2: 8 X\n SG_ Torque m3 : 0|6@1+ (10,0) [0|630] "Nm" X\n'
        ' SG_ Speed : 24|8@1+ (1.28,0) [0|325.12] "km/h" X\n'
    )
    dbc = load_dbc(str(path))
    find_signal(dbc, "Motor_2.Speed", "wheels")
    with pytest.raises(PermanentDriverError, match="shares its bits with other signals"):
        find_signal(dbc, "Motor_2.Torque", "wheels")


@pytest.mark.parametrize("again", [("77", "8|8"), ("1", "8|8"), ("77", "0|8"), ("1", "0|8")])
def test_a_name_that_stands_twice_is_one_if_it_is_alike(
    again: tuple[str, str], tmp_path: Path
) -> None:
    """Files are glued together: the same message again is it, another of its name is a question."""
    path = tmp_path / "glued.dbc"
    body = 'BO_ {}: 8 X\n SG_ s : {}@1+ (1,0) [0|0] "" X\n SG_ {} : 16|8@1+ (1,0) [0|0] "" X\n\n'
    first = body.format("1 speed", "0|8", "t")
    path.write_text(first + body.format(f"{again[0]} speed", again[1], "u"))
    if again == ("1", "0|8"):
        assert find_signal(load_dbc(str(path)), "speed.s", "wheels")[1].start == 0
    else:
        with pytest.raises(PermanentDriverError, match="more than once"):
            find_signal(load_dbc(str(path)), "speed.s", "wheels")
    assert find_signal(load_dbc(str(path)), "speed.t", "wheels")[0].frame_id == 1


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_file_with_a_byte_order_mark(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "bom.dbc"
    path.write_text(content("racelogic_imu04"), encoding)
    assert told(load_dbc(str(path))) == told(load_dbc("racelogic_imu04"))


@pytest.mark.parametrize(
    ("length", "bits"),
    [
        ("8", "0|4294967296"),
        ("8", "-1|4294967296"),
        ("8", "9999999999 | 8"),
        ("4294967296", "0|8"),
        ("-4294967296", "0|8"),
    ],
)
@pytest.mark.parametrize("name", ["far", "x" * 400])
def test_no_room_is_made_for_what_no_frame_can_hold(length: str, bits: str, name: str) -> None:
    """cantools makes a list of as many bits as a file says: half a minute, and gigabytes."""
    sound = 'BO_ 1 sound: 8 A\n SG_ s : 0|8@1+ (1,0) [0|4294967296] "" B\n\n'
    flawed = f'BO_ 2 flawed: {length} A\n SG_ {name} : {bits}@0- (1,0) [0|0] "" B\n'
    found = sound_part(sound + flawed)
    assert [message.name for message in found.messages] == ["sound"]
    assert all("no frame is so long" in why for why in found.left_out.values())


@pytest.mark.parametrize("text", ["", "hello world", "BO_ 1 2: 8 X\n"])
def test_what_is_no_dbc_file_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "none.dbc"
    path.write_text(text)
    with pytest.raises(PermanentDriverError, match=r"none\.dbc: "):
        load_dbc(str(path))


def test_damage_anywhere_ends_in_messages_or_one_sentence() -> None:
    """What is kept of a damaged file has no other layout than the sound one's, but where the damage
    itself is a number of the layout."""
    draw = random.Random(40)
    texts = [content(name) for name in ("multiplexed", "racelogic_imu04", "css_canmod_gps")]
    for _ in range(300):
        text = draw.choice(texts)
        for _ in range(draw.randint(1, 3)):
            at, size = draw.randrange(len(text)), draw.choice([1, 1, 2, 9])
            new = draw.choice(["", '"', ";", "\n", ",", "BO_ ", " SG_ ", "\x00", "M", "9"])
            text = text[:at] + new + text[at + size :]
        try:
            found = sound_part(text)
        except UnreadableError:
            continue
        assert found.messages
        assert all(found.left_out.values())
