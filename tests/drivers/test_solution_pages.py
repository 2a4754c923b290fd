"""The pages of ubx, bestpos and sbf say what the code does: options, counters, program."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from drivers.measurements import PositionFix
from drivers.solution_driver import SolutionOptions
from fusiond.configuration.schema import Config
from tests.drivers.bestpos.logs import bestpos
from tests.drivers.sbf.blocks import pvt as sbf_pvt
from tests.drivers.ubx.frames import pvt as ubx_pvt
from tests.places import REPOSITORY

EPOCHS = {"ubx": ubx_pvt(), "bestpos": bestpos(), "sbf": sbf_pvt()}
DRIVERS = REPOSITORY / "drivers"
SHARED = "".join(
    (DRIVERS / name).read_text() for name in ("solution.py", "epoch_ends.py", "nmea/time.py")
)
LINE = {"sentences", "ubx_frames", "rtcm_frames", "bytes_in"}
"""Of the splitter and the line: they are in the pages of NMEA and the network."""


def page(name: str) -> str:
    return (REPOSITORY / "docs" / f"gnss-{name}.md").read_text()


def block(name: str, language: str) -> str:
    (found,) = re.findall(rf"```{language}\n(.*?)```", page(name), re.DOTALL)
    return str(found)


@pytest.mark.parametrize("name", EPOCHS)
def test_configuration_is_accepted_with_every_option(name: str) -> None:
    text = block(name, "toml")
    source = Config.model_validate(tomllib.loads(text)).sources["gnss"]
    assert source.driver == name
    commented_in = re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE)
    options = Config.model_validate(tomllib.loads(commented_in)).sources["gnss"].options
    assert set(options) == set(SolutionOptions.model_fields)
    defaults = SolutionOptions(port=options["port"], ntrip=options["ntrip"])
    assert SolutionOptions.model_validate(options) == defaults


@pytest.mark.parametrize("name", EPOCHS)
def test_counters_are_those_of_the_code(name: str) -> None:
    code = "".join(path.read_text() for path in sorted((DRIVERS / name).glob("*.py")))
    section = page(name).partition("## What is refused")[2].partition("## When it does not")[0]
    documented = set(re.findall(r"`(\w+)`", section)) - {"health", "earliest_date"}
    for counter in documented:
        assert f'"{counter}"' in code + SHARED, f"{counter} is not counted"
    counted = set(re.findall(r'ounters\["(\w+)"\]', code))
    counted |= set(re.findall(r'_refuse\("(\w+)"', code))
    counted |= set(re.findall(r'"((?:\w+_)?(?:refused|no_fix|status_missing))"', code))
    counted |= set(re.findall(r'"((?:heading|baseline)_\w+)"', code)) - {"heading_offset_deg"}
    counted |= set(re.findall(r'return "(\w+)"', SHARED)) - {"duplicate"}
    assert counted - LINE <= documented


@pytest.mark.parametrize("name", EPOCHS)
def test_program_runs_on_a_log(name: str, tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_bytes(EPOCHS[name])
    names: dict[str, Any] = {"path": log}
    exec(compile(block(name, "python"), f"docs/gnss-{name}.md", "exec"), names)
    assert [type(m) for m in names["measurements"]][1:] == [PositionFix]
