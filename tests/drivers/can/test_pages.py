"""Every driver on CAN is an entry point, and the blocks of its page are sources as they stand."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from drivers.can.attitude_bearing import CanAttitudeDriver, CanBearingDriver
from drivers.can.base_driver import CanDriver
from drivers.can.gnss import CanGnssDriver
from drivers.can.height import CanHeightDriver
from drivers.can.imu import CanImuDriver
from drivers.can.obd import ObdSpeedDriver
from drivers.can.wheel import CanWheelDriver
from fusiond.configuration.load import load_config
from tests.places import REPOSITORY

DRIVERS: dict[str, type] = {
    "can_attitude": CanAttitudeDriver,
    "can_bearing": CanBearingDriver,
    "can_gnss": CanGnssDriver,
    "can_height": CanHeightDriver,
    "can_imu": CanImuDriver,
    "can_wheel": CanWheelDriver,
    "obd_speed": ObdSpeedDriver,
}
CAR = """VERSION ""
NS_ :
BS_:
BU_: CAR HOST
BO_ 170 WHEEL_SPEEDS: 4 CAR
 SG_ REAR_LEFT : 0|16@1+ (0.01,0) [0|0] "km/h" HOST
 SG_ REAR_RIGHT : 16|16@1+ (0.01,0) [0|0] "km/h" HOST
BO_ 171 TRANSMISSION: 1 CAR
 SG_ GEAR : 0|4@1+ (1,0) [0|15] "" HOST
BO_ 172 AMBIENT: 2 CAR
 SG_ PRESSURE : 0|16@1+ (0.1,0) [0|0] "hPa" HOST
"""
"""A DBC file with the names of the pages' examples."""


@pytest.mark.parametrize("name", DRIVERS)
def test_the_driver_is_an_entry_point(name: str) -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    points = project["project"]["entry-points"]["fusiond.drivers"]
    made = DRIVERS[name]
    assert issubclass(made, CanDriver)
    assert points[name] == f"{made.__module__}:{made.__name__}"


def loads(folder: Path, text: str) -> set[str]:
    """The drivers of a configuration that is read as `run` reads it."""
    (folder / "car.dbc").write_text(CAR)
    path = folder / "vehicle.toml"
    path.write_text(text.replace("/etc/fusiond/car.dbc", str(folder / "car.dbc")))
    return {source.driver for source in load_config(path).sources.values()}


@pytest.mark.parametrize(
    ("page", "drivers"),
    [
        ("can-wheel.md", {"can_wheel"}),
        ("obd-speed.md", {"obd_speed"}),
        ("can-gnss.md", {"can_gnss", "can_imu"}),
        ("can-height.md", {"can_height"}),
    ],
)
def test_the_blocks_of_a_page(tmp_path: Path, page: str, drivers: set[str]) -> None:
    text = (REPOSITORY / "docs" / page).read_text(encoding="utf-8")
    blocks = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    assert loads(tmp_path, "\n".join(blocks)) == drivers


def test_the_keys_of_a_page_are_those_of_its_driver() -> None:
    """What all drivers on a bus have is named in a row of its own."""
    pages = {"can_wheel": "can-wheel", "obd_speed": "obd-speed"}
    pages |= {"can_gnss": "can-gnss", "can_height": "can-height"}
    for driver, page in pages.items():
        text = (REPOSITORY / "docs" / f"{page}.md").read_text(encoding="utf-8")
        table = text.split("| key |", 1)[1].split("\n\n", 1)[0]
        named = set(re.findall(r"`(\w+)`", table))
        fields = set(getattr(DRIVERS[driver], "Options").model_fields)  # noqa: B009
        missing = fields - named - ({"forward", "backward"} if driver == "can_wheel" else set())
        assert not missing, f"{page}: {missing}"


def test_the_wheels_of_the_shipped_vehicle(tmp_path: Path) -> None:
    """The marks taken off the section that vehicle.toml has for them."""
    text = (REPOSITORY / "config" / "vehicle.toml").read_text(encoding="utf-8")
    begin = text.index("# [sources.wheel]")
    section = text[begin : text.index("\n\n", begin)]
    assert loads(tmp_path, re.sub(r"(?m)^# ?", "", section)) == {"can_wheel"}
