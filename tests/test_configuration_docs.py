"""docs/configuration.md names every key of every section with its default."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fusiond import config

PAGE = (Path(__file__).parents[1] / "docs" / "configuration.md").read_text(encoding="utf-8")
SECTIONS = {
    "[imu]": config.Imu,
    "[aiding.gnss]": config.GnssAiding,
    "[aiding.rdss]": config.RdssAiding,
    "[aiding.attitude]": config.AttitudeAiding,
    "[aiding.star_tracker]": config.StarTrackerAiding,
    "[aiding.sar]": config.SarAiding,
    "[aiding.heading]": config.HeadingAiding,
    "[aiding.height]": config.HeightAiding,
    "[aiding.wheel]": config.WheelAiding,
    "[constraints.zero_velocity]": config.ZeroVelocity,
    "[constraints.non_holonomic]": config.NonHolonomic,
    "[alignment]": config.Alignment,
    "[estimator]": config.Estimator,
    "[estimator.multiscale]": config.Multiscale,
    "[consistency]": config.ConsistencyTest,
    "[scheduler]": config.Scheduler,
    "[clock]": config.ClockOptions,
    "[mqtt]": config.Mqtt,
}


@pytest.mark.parametrize("title", SECTIONS)
def test_every_key_is_documented_with_its_default(title: str) -> None:
    section = PAGE.split(f"## `{title}`", 1)[1].split("\n## ", 1)[0]
    rows = dict(re.findall(r"^\| `(\w+)` \| (`[^`]*`|required) \|", section, flags=re.M))
    fields = SECTIONS[title].model_fields
    assert rows.keys() == fields.keys()
    for name, field in fields.items():
        value = field.get_default()
        if isinstance(value, float | int) and not isinstance(value, bool):
            assert float(rows[name].strip("`")) == value, name


def test_every_section_is_in_the_list() -> None:
    def sections(model: type[config.Section]) -> set[type]:
        found = set()
        for field in model.model_fields.values():
            if isinstance(field.annotation, type) and issubclass(field.annotation, config.Section):
                found |= {field.annotation} | sections(field.annotation)
        return found

    listed = set(SECTIONS.values()) | {config.Constraints}
    assert sections(config.Config) <= listed
