"""`docs/gnss-raw.md` and `gnss-signals.md` say what the code does: keys, counters, program."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from drivers.raw.driver import GnssOptions
from drivers.raw.messages import RawGnssEpoch
from drivers.raw.ubx import SIGNALS, SYSTEM_BY_ID
from fusiond.configuration.aiding import RawAiding
from tests.drivers.raw.frames import measurement, rawx
from tests.places import REPOSITORY

PAGE = (REPOSITORY / "docs" / "gnss-raw.md").read_text()
SIGNALS_PAGE = (REPOSITORY / "docs" / "gnss-signals.md").read_text()
CODE = "".join(path.read_text() for path in sorted((REPOSITORY / "drivers" / "raw").glob("*.py")))
COMPOSED = {
    *(
        f"subframes_{message}"
        for message in ("lnav", "cnav", "d1", "d2", "bcnav1", "bcnav2", "inav")
    ),
    *(f"measured_{system}" for system in "GEC"),
    *(f"measured_{system}" for system in ("sbas", "qzss", "glonass", "navic")),
    *(f"{system}_not_used" for system in ("sbas", "qzss", "glonass", "navic", "unknown_system")),
}
FRAMING = {"ubx_damaged", "rtcm_damaged", "frame_cut", "garbage_bytes"}


def block(language: str, chapter: str = "") -> str:
    """The only block of a language in a chapter; without one: before the first."""
    title = f"\n## {chapter}\n" if chapter else ""
    text = PAGE.partition(title)[2] if title else PAGE
    (found,) = re.findall(rf"```{language}\n(.*?)```", text.partition("\n## ")[0], re.DOTALL)
    return str(found)


def test_configuration_is_accepted_with_every_option() -> None:
    text = block("toml", "In five minutes")
    section = tomllib.loads(text)["sources"]["gnss"]
    assert section.pop("driver") == "gnss"
    GnssOptions.model_validate(section)
    commented_in = re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE)
    options = tomllib.loads(commented_in)["sources"]["gnss"]
    del options["driver"]
    assert set(options) == set(GnssOptions.model_fields)
    defaults = GnssOptions(
        port=options["port"], baud=460_800, last_sentence="GST", ntrip=options["ntrip"]
    )
    assert GnssOptions.model_validate(options) == defaults


def test_aiding_is_accepted() -> None:
    RawAiding.model_validate(tomllib.loads(block("toml", "In the filter"))["aiding"]["gnss"])


def test_counters_are_those_of_the_code() -> None:
    title = "## Why a frame or measurement was refused"
    section = SIGNALS_PAGE.partition(title)[2].partition("## In the filter")[0]
    documented = set(re.findall(r"`(\w+)`", section)) - {"health"}
    for name in documented - COMPOSED - FRAMING:
        assert f'"{name}"' in CODE, f"{name} is not counted"
    counted = set(re.findall(r'ounters\["(\w+)"\]', CODE)) | COMPOSED
    counted |= set(re.findall(r'RefusedError\("(\w+)"\)', CODE))
    counted |= set(re.findall(r'"(\w+_not_used)"', CODE))
    counted |= set(re.findall(r'_refuse\("(\w+)"', CODE))
    known_of_nmea = {"epochs", "sentences"}
    assert counted - known_of_nmea <= documented


def test_signals_are_those_of_the_code() -> None:
    names = {"GPS": "G", "Galileo": "E", "BeiDou MEO, IGSO": "C"}
    section = SIGNALS_PAGE.partition("### Ionosphere models")[0]
    for name, system in names.items():
        (row,) = re.findall(rf"^\| {name} \| ([^|]*) \|", section, re.MULTILINE)
        code = {signal for (gnss, _), signal in SIGNALS.items() if SYSTEM_BY_ID[gnss] == system}
        assert set(row.split(", ")) == code


def test_program_runs_on_a_log(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_bytes(rawx(measurement()))
    names: dict[str, Any] = {"path": log}
    exec(compile(block("python", "Without a daemon"), "docs/gnss-raw.md", "exec"), names)
    (epoch,) = names["events"]
    assert isinstance(epoch, RawGnssEpoch)
