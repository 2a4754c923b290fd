"""docs/configuration.md names every key of every section with its default."""

from __future__ import annotations

import re
from typing import get_args

import pytest

from fusiond.configuration import aiding as config_aiding
from fusiond.configuration import estimator, outputs
from fusiond.configuration import schema as config
from fusiond.configuration.alignment import Alignment
from fusiond.configuration.constraints import NonHolonomic, ZeroVelocity
from fusiond.configuration.integrity import Integrity
from tests.places import REPOSITORY

PAGE = (REPOSITORY / "docs" / "configuration.md").read_text(encoding="utf-8")
SECTIONS = {
    "[imu]": config.Imu,
    "[imu.spare]": config.SpareImu,
    "[aiding.gnss]": config_aiding.GnssAiding,
    "[aiding.raw]": config_aiding.RawAiding,
    "[aiding.rdss]": config_aiding.RdssAiding,
    "[aiding.attitude]": config_aiding.AttitudeAiding,
    "[aiding.star_tracker]": config_aiding.StarTrackerAiding,
    "[aiding.sar]": config_aiding.SarAiding,
    "[aiding.heading]": config_aiding.HeadingAiding,
    "[aiding.compass]": config_aiding.CompassAiding,
    "[aiding.height]": config_aiding.HeightAiding,
    "[aiding.barometer]": config_aiding.BarometerAiding,
    "[aiding.wheel]": config_aiding.WheelAiding,
    "[constraints.zero_velocity]": ZeroVelocity,
    "[constraints.non_holonomic]": NonHolonomic,
    "[alignment]": Alignment,
    "[estimator]": estimator.Estimator,
    "[estimator.multiscale]": estimator.Multiscale,
    "[estimator.federated]": estimator.Federated,
    "[estimator.unscented]": estimator.Unscented,
    "[consistency]": config.ConsistencyTest,
    "[integrity]": Integrity,
    "[scheduler]": config.Scheduler,
    "[clock]": config.ClockOptions,
    "[mqtt]": config.Mqtt,
    "[position_reports]": config.PositionReports,
    "[recording]": config.Recording,
    "[outputs]": outputs.Outputs,
    "[outputs.gpsd]": outputs.Gpsd,
    "[outputs.nmea]": outputs.NmeaServed,
    "[outputs.prometheus]": outputs.Prometheus,
    "[outputs.home_assistant]": outputs.HomeAssistant,
    "[outputs.foxglove]": outputs.Foxglove,
    "[outputs.owntracks]": outputs.OwnTracks,
    "[outputs.chrony]": outputs.Chrony,
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
    def sections(model: type[config_aiding.Section]) -> set[type]:
        found = set()
        for field in model.model_fields.values():
            for kind in (field.annotation, *get_args(field.annotation)):
                if isinstance(kind, type) and issubclass(kind, config_aiding.Section):
                    found |= {kind} | sections(kind)
        return found

    listed = set(SECTIONS.values()) | {config.Constraints}
    assert sections(config.Config) <= listed
