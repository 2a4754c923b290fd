"""Configuration files: what is wrong is named with file, key, value and what would do."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond.configuration.aiding import GnssAiding, RdssAiding
from fusiond.configuration.load import ConfigError, config_digest, driver_entry_points, load_config
from tests.places import REPOSITORY

EXAMPLES = sorted((REPOSITORY / "config").glob("*.toml"))
EXAMPLES_BY_NAME = {path.name: path for path in EXAMPLES}


def write(folder: Path, text: str) -> Path:
    path = folder / "vehicle.toml"
    path.write_text(text, encoding="utf-8")
    return path


def mistakes(folder: Path, text: str) -> list[str]:
    path = write(folder, text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    lines = str(caught.value).splitlines()
    assert all(line.startswith(f"{path}: ") for line in lines)
    return [line.removeprefix(f"{path}: ") for line in lines]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_work_unchanged(path: Path) -> None:
    assert load_config(path).vehicle == path.stem


def test_examples_carry_the_data_sheets_figures() -> None:
    imu = {path.stem: load_config(path).imu for path in EXAMPLES}
    mems, tactical = imu["vehicle"], imu["tactical"]
    assert (mems.gyro_noise_deg_sqrt_h, mems.accel_noise_m_s_sqrt_h) == (0.3, 0.1)
    assert (mems.gyro_bias_instability_deg_h, mems.accel_bias_instability_mg) == (10.0, 0.1)
    assert (tactical.gyro_noise_deg_sqrt_h, tactical.accel_noise_m_s_sqrt_h) == (0.05, 0.02)
    assert tactical.gyro_bias_instability_deg_h == 1.0
    assert tactical.accel_bias_instability_mg == 0.05
    assert imu["drive_0708"].axes == ("-x", "+y", "-z")
    assert imu["drive_0708"].sensor_class == "mems"
    assert imu["drive_0708"].gyro_bias_initial_deg_h == 1800.0


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[imu]\nrate_hz = -1", "imu.rate_hz = -1: expected a number above 0"),
        ('[imu]\nrate_hz = "100"', 'imu.rate_hz = "100": expected a number above 0'),
        ("[imu]\nrate_hz = true", "imu.rate_hz = true: expected a number above 0"),
        ("[imu]\nrate_hz = 2020-01-01", 'imu.rate_hz = "2020-01-01": expected a number above 0'),
        (
            "[imu]\nmounting_deg = [0, nan, 0]",
            "imu.mounting_deg[1] = nan: expected a finite number",
        ),
        ("[imu]\nmounting_deg = [0, 1]", "imu.mounting_deg[2]: missing; expected a number"),
        (
            "[imu]\nmounting_deg = [0, 1, 2, 3]",
            "imu.mounting_deg = [0, 1, 2, 3]: expected a list of 3, each a number",
        ),
        (
            '[imu]\naxes = ["x", "y", "-z"]',
            'imu.axes = ["x", "y", "-z"]: these axes are left-handed: change one sign',
        ),
        (
            "[scheduler]\nrate_hz = 2000",
            "scheduler.rate_hz = 2000: expected a number at least 1 and at most 1000",
        ),
        ("[mqtt]\nport = 1.5", "mqtt.port = 1.5: expected an integer at least 1 and at most 65535"),
        ("[mqtt]\ntls = 1", "mqtt.tls = 1: expected true or false"),
        ("[mqtt]\nhost = 3", "mqtt.host = 3: expected text in quotes"),
        (
            '[mqtt]\nhost = "mqtt://10.0.0.1:1883"',
            'mqtt.host = "mqtt://10.0.0.1:1883": give a name or an address only,'
            " without scheme, port or path",
        ),
        (
            '[outputs.gpsd]\nhost = "127.0.0.1:2947"',
            'outputs.gpsd.host = "127.0.0.1:2947": give a name or an address only,'
            " without scheme, port or path",
        ),
        ("state_file = 3", "state_file = 3: expected a path in quotes"),
        ("imu = 3", "imu = 3: expected a section"),
        (
            '[estimator]\nmodel = "ins12"',
            "estimator.model = \"ins12\": did you mean 'ins23'?"
            " allowed: ins15, ins17, ins20, ins21, ins23, planar10, planar15",
        ),
        (
            '[mqtt]\ncommands = ["reset"]',
            "mqtt.commands[0] = \"reset\": did you mean 'reset_filter'? "
            "allowed: inject, request_fix, reset_filter, send_message, set_position,"
            " start_recording, stop_recording",
        ),
        (
            "[aiding.gnss]\ngate_probability = 1",
            "aiding.gnss.gate_probability = 1: expected a number above 0 and below 1",
        ),
        (
            '[aiding.roof]\nkind = "gns"',
            "aiding.roof.kind = \"gns\": did you mean 'gnss'? "
            "allowed: attitude, barometer, compass, gnss, heading, height, raw, rdss, sar, "
            "star_tracker, wheel",
        ),
        (
            "[aiding.roof]",
            "aiding.roof: lacks the key kind; "
            "allowed: gnss, raw, rdss, attitude, star_tracker, sar, heading, compass, height, "
            "barometer, wheel",
        ),
        ("[sources.rx]", "sources.rx.driver: missing; expected text in quotes"),
        (
            '[sources.rx]\ndriver = "nema"',
            "sources.rx.driver = \"nema\": no such driver; did you mean 'nmea'? "
            f"allowed: {', '.join(sorted(driver_entry_points()))}",
        ),
        ('[sources.rx]\ndriver = "nmea"', "sources.rx.port: missing; expected text in quotes"),
        (
            '[sources.rx]\ndriver = "rdss"\nport = "a"\nfamily = "4"',
            "sources.rx.family = \"4\": did you mean '4.0'? allowed: 2.1, 4.0, auto",
        ),
        (
            '[sources.rx]\ndriver = "rdss"\nport = "a"\nbaud = "9600"',
            'sources.rx.baud = "9600": '
            'expected "auto" or an integer at least 1200 and at most 4000000',
        ),
        (
            '[alignment]\nheading = ["config"]',
            "alignment: heading lists 'config': set heading_deg too",
        ),
        (
            "[imu\n",
            "not valid TOML: Expected ']' at the end of a table declaration (at line 1, column 5)",
        ),
    ],
)
def test_one_mistake(tmp_path: Path, text: str, line: str) -> None:
    assert mistakes(tmp_path, text) == [line]


@pytest.mark.parametrize(
    ("text", "start"),
    [
        (
            "estimater = 1",
            "estimater = 1: no such key; did you mean 'estimator'? allowed: aiding, ",
        ),
        ("[imu]\nrate_hs = 1", "imu.rate_hs = 1: no such key; did you mean 'rate_hz'? allowed: "),
        (
            "[outputs.gpsd]\nrate = 1",
            "outputs.gpsd.rate = 1: no such key; did you mean 'rate_hz'? allowed: ",
        ),
        ("[aiding.gnss]\nfoo = 1", "aiding.gnss.foo = 1: no such key; allowed: bias_corr"),
        (
            '[sources.rx]\ndriver = "nmea"\nport = "a"\nbauds = 1',
            "sources.rx.bauds = 1: no such key; did you mean 'baud'? allowed: ",
        ),
    ],
)
def test_unknown_key(tmp_path: Path, text: str, start: str) -> None:
    (line,) = mistakes(tmp_path, text)
    assert line.startswith(start)


def test_every_mistake_is_listed(tmp_path: Path) -> None:
    text = """
        vehicle = "a b"
        [imu]
        rate_hz = "1"
        gap_s = 0
        [aiding.gnss]
        lever_arm_m = [0, "a", 1]
        [sources.a]
        driver = "none"
        [sources.b]
        driver = "nmea"
    """
    keys = [line.split(":")[0].split(" ")[0] for line in mistakes(tmp_path, text)]
    assert sorted(keys) == [
        "aiding.gnss.lever_arm_m[1]",
        "imu.gap_s",
        "imu.rate_hz",
        "sources.a.driver",
        "sources.b.port",
        "vehicle",
    ]


def test_a_signal_that_the_dbc_lacks(tmp_path: Path) -> None:
    text = EXAMPLES_BY_NAME["vehicle.toml"].read_text(encoding="utf-8")
    assert "RATE_OF_TURN.GYRO_X" in text
    (line,) = mistakes(tmp_path, text.replace("RATE_OF_TURN.GYRO_X", "RATE_OF_TURN.GYRO_W"))
    assert line.startswith("sources.imu: ")
    assert "GYRO_W" in line


def test_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.toml: No such file or directory"):
        load_config(tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match="Is a directory"):
        load_config(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'\nvehicle = "K\xf6ln"\n')
    with pytest.raises(ConfigError, match="line 2: not UTF-8"):
        load_config(tmp_path / "latin.toml")


def test_sources_of_fixes_get_the_aiding_of_their_driver(tmp_path: Path) -> None:
    text = """
        [sources.roof]
        driver = "nmea"
        port = "/dev/a"
        [sources.rear]
        driver = "nmea"
        port = "/dev/b"
        [sources.beidou]
        driver = "rdss"
        port = "/dev/c"
        [aiding.rear]
        kind = "gnss"
        lever_arm_m = [1, 2, 3]
    """
    config = load_config(write(tmp_path, text))
    assert config.aiding == {
        "roof": GnssAiding(),
        "rear": GnssAiding(lever_arm_m=(1.0, 2.0, 3.0)),
        "beidou": RdssAiding(),
    }


def test_relative_paths_count_from_the_file(tmp_path: Path) -> None:
    text = 'state_file = "state.json"\n[mqtt]\npassword_file = "secret"\nca_file = "/etc/ca.pem"\n'
    config = load_config(write(tmp_path, text))
    assert config.state_file == tmp_path / "state.json"
    assert config.mqtt.password_file == tmp_path / "secret"
    assert config.mqtt.ca_file == Path("/etc/ca.pem")


def test_digest_follows_the_values_not_the_text(tmp_path: Path) -> None:
    plain = config_digest(load_config(write(tmp_path, "[imu]\nrate_hz = 100\n")))
    commented = config_digest(load_config(write(tmp_path, "# a\n[imu]\nrate_hz = 100.0\n")))
    other = config_digest(load_config(write(tmp_path, "[imu]\nrate_hz = 101\n")))
    option = '[sources.rx]\ndriver = "nmea"\nport = "{}"\n'
    first = config_digest(load_config(write(tmp_path, option.format("a"))))
    second = config_digest(load_config(write(tmp_path, option.format("b"))))
    assert plain == commented
    assert len({plain, other, first, second}) == 4
    assert len(plain) == 12
