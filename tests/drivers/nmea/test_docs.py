"""`docs/gnss-nmea.md` says what the code does: its configuration, counters and program are run."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from drivers.measurements import PositionFix
from drivers.nmea.driver import NmeaOptions
from fusiond.configuration.schema import Config
from tests.places import REPOSITORY

PAGE = (REPOSITORY / "docs" / "gnss-nmea.md").read_text()
_DRIVERS = REPOSITORY / "drivers"
CODE = "".join(
    path.read_text()
    for path in (
        *sorted(set((_DRIVERS / "nmea").glob("*.py")) - {_DRIVERS / "nmea" / "compass.py"}),
        _DRIVERS / "receiver.py",
        _DRIVERS / "reconnecting_line.py",
    )
)


def block(language: str) -> str:
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    return str(found)


def test_configuration_is_accepted_with_every_option() -> None:
    text = block("toml")
    source = Config.model_validate(tomllib.loads(text)).sources["gnss"]
    assert source.driver == "nmea"
    NmeaOptions.model_validate(source.options)
    commented_in = re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE)
    options = Config.model_validate(tomllib.loads(commented_in)).sources["gnss"].options
    assert set(options) == set(NmeaOptions.model_fields)
    defaults = NmeaOptions(port=options["port"], last_sentence="GST", ntrip=options["ntrip"])
    assert NmeaOptions.model_validate(options) == defaults


def test_counters_are_those_of_the_code() -> None:
    section = PAGE.partition("## What is refused")[2].partition("## When it does not work")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    documented = set(re.findall(r"`(\w+)`", "".join(rows)))
    spelled_out = CODE.replace("{kind}", "ubx") + CODE.replace("{kind}", "rtcm")
    for name in documented:
        assert f'"{name}"' in spelled_out, f"{name} is not counted"
    write_only = {"bytes_out", "write_refused", "baud_refused"}
    for name in set(re.findall(r'counters\["(\w+)"\]', CODE)) - write_only:
        assert f"`{name}`" in section, f"{name} is not explained"


def test_program_runs_on_a_log(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_bytes(
        b"$GNGGA,021429.00,3958.12345,N,11619.54321,E,4,18,0.62,45.300,M,-9.100,M,1.0,0000*47\r\n"
    )
    names: dict[str, Any] = {"path": log}
    exec(compile(block("python"), "docs/gnss-nmea.md", "exec"), names)
    (fix,) = names["measurements"]
    assert isinstance(fix, PositionFix)
