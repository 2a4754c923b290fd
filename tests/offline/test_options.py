"""Each option of the configuration changes `process` as it changes the daemon.

One drive with every kind of measurement, from files, goes through `process` and, arrival by
arrival, through the door of the daemon's chain, tick by tick: the filter's state at the end is the
same to the bit. An option that is new must be put here, or among those that no recorded file knows.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from fusiond.configuration.aiding import AnyAiding
from fusiond.configuration.schema import Config
from fusiond.offline.measurement_files import source_of
from tests.offline.both_ways import Told, by_daemon, by_process
from tests.offline.options import CHANGED, NO_FILE_KNOWS
from tests.offline.options_drive import BASE, write_files


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_files(tmp_path_factory.mktemp("drive"))


def changed(options: dict[str, Any]) -> Config:
    """The configuration with options by dotted names; a new section of aiding comes in place of the
    compass, for which there is no room beside it."""
    settings = deepcopy(BASE)
    for key, value in options.items():
        *path, name = key.split(".")
        section = settings
        for part in path:
            if part in ("attitude", "star_tracker", "sar"):
                settings["aiding"].pop("compass", None)
            section = section.setdefault(part, {})
        section[name] = value
    return Config.model_validate(settings)


def leaves(model: type[BaseModel], before: str = "") -> Iterator[str]:
    """Dotted names of all options; of `aiding` by the kind of the section."""
    for name, field in model.model_fields.items():
        if f"{before}{name}" == "aiding":
            for kind in get_args(get_args(AnyAiding)[0]):
                yield from leaves(kind, f"aiding.{kind.model_fields['kind'].default}.")
            continue
        of = (field.annotation, *get_args(field.annotation))
        parts = [p for p in of if isinstance(p, type) and issubclass(p, BaseModel)]
        if parts and f"{before}{name}" != "sources":
            for part in parts:
                yield from leaves(part, f"{before}{name}.")
        elif name != "kind":
            yield f"{before}{name}"


def test_every_option_is_tried_or_known_to_no_file() -> None:
    tried = {key for options in CHANGED.values() for key in options}
    known = {name for name in leaves(Config) if not any(_under(name, n) for n in NO_FILE_KNOWS)}
    assert known - tried == set()
    assert tried - known == {"aiding"}


def _under(name: str, section: str) -> bool:
    return name == section or name.startswith(f"{section}.")


@pytest.mark.parametrize(
    ("kind", "section"),
    [
        *(("gnss", "gnss"), ("nmea", "gnss"), ("rdss", "rdss"), ("wheel", "wheel")),
        *(("barometer", "barometer"), ("attitude", "star_tracker"), ("bearing", "sar")),
    ],
)
def test_a_section_of_another_name_is_that_of_its_kind(kind: str, section: str) -> None:
    config = Config.model_validate({"aiding": {"rear": {"kind": section}}})
    assert source_of(kind, config) == "rear"
    both = Config.model_validate({"aiding": {"rear": {"kind": section}, section: {}}})
    named = "rear" if section == "star_tracker" else section  # its files have the kind `attitude`
    assert source_of(kind, both) == named


@pytest.fixture(scope="module")
def as_it_stands(files: Path) -> Told:
    return by_process(Config.model_validate(BASE), files)


def test_as_it_stands(files: Path, as_it_stands: Told) -> None:
    assert as_it_stands.same(by_daemon(Config.model_validate(BASE), files))
    ended = as_it_stands.words[0]
    for source in ("gnss", "gnss_velocity", "gnss_heading", "rdss", "wheel", "barometer"):
        assert ended[source]["fused"] > 5, source
    assert ended["compass"]["fused"] > 5


@pytest.mark.parametrize("name", CHANGED)
def test_options(name: str, files: Path, as_it_stands: Told) -> None:
    config = changed(CHANGED[name])
    found = by_process(config, files)
    assert found.same(by_daemon(config, files))
    assert not found.same(as_it_stands)
