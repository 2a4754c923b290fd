"""A compass on a real pseudo terminal: HDG, HDM, HDT, and what is wrong with it."""

from __future__ import annotations

import math
import re
from collections import Counter
from pathlib import Path

import pytest

from drivers.measurements import ArrivalStamp, Heading, MagneticHeading
from drivers.nmea import compass
from drivers.nmea.compass import CompassDecoder, CompassDecoding, CompassDriver, CompassOptions
from drivers.quantization import NEAREST_SD
from tests.drivers.at_work import at_work
from tests.drivers.nmea.sentences import made, wire
from tests.patience import until
from tests.pty_device import Device


def decoded(*lines: str, **options: float) -> tuple[list[Heading | MagneticHeading], Counter[str]]:
    counters: Counter[str] = Counter()
    decoder = CompassDecoder("compass", CompassDecoding(**options), counters)
    stream = wire(*map(made, lines))
    whole = decoder.feed(stream, 5)
    again = CompassDecoder("compass", CompassDecoding(**options), Counter())
    assert [m for k in range(len(stream)) for m in again.feed(stream[k : k + 1], 5)] == whole
    return whole, counters


@pytest.mark.parametrize(
    ("line", "yaw_deg"),
    [
        ("HCHDM,98.3,M", 98.3),
        ("HCHDG,98.3,,,12.6,W", 98.3),  # what the compass thinks of the declination is not used
        ("HCHDG,98.3,1.3,W,,", 97.0),
        ("HCHDG,358.3,2.0,E,,", 0.3),
        ("HCHDM,271.0,M", -89.0),
    ],
)
def test_magnetic_headings(line: str, yaw_deg: float) -> None:
    ((m,), _) = decoded(line)
    assert isinstance(m, MagneticHeading)
    assert math.degrees(m.yaw_rad) == pytest.approx(yaw_deg)
    assert m.rounding_sd_rad == pytest.approx(math.radians(0.1) * NEAREST_SD)


def test_a_true_heading_with_the_offset_of_its_mounting() -> None:
    ((m,), _) = decoded("HEHDT,100.25,T", heading_offset_deg=-90.0, latency_s=0.3)
    assert isinstance(m, Heading)
    assert math.degrees(m.yaw_rad) == pytest.approx(10.25)
    assert m.stamp == ArrivalStamp(0.3)


def test_one_reading_in_three_sentences_counts_once() -> None:
    reading = ("HCHDG,98.3,,,12.6,W", "HCHDM,98.3,M", "HCHDT,85.7,T")
    found, counters = decoded(*reading, *reading)
    assert len(found) == 2
    assert counters["other_sentence"] == 4


@pytest.mark.parametrize(
    ("line", "counter"),
    [
        ("HCHDM,,M", "no_heading"),
        ("HCHDM,361.0,M", "bad_field"),
        ("HCHDM,-3.0,M", "bad_field"),
        ("HCHDM,nan,M", "bad_field"),
        ("HCHDG,98.3,1.3,,,", "bad_field"),
        ("HCHDG,98.3,190.0,E,,", "bad_field"),
        ("HCXDR,A,1.0,D,PITCH", "unused_sentence"),
    ],
)
def test_what_is_refused_has_a_name(line: str, counter: str) -> None:
    found, counters = decoded(line)
    assert not found
    assert counters[counter] == 1


async def test_from_a_line_to_headings(tmp_path: Path) -> None:
    device = Device(tmp_path / "compass")
    device.plug()
    emitted: list[object] = []
    options = CompassOptions(port=str(device.link), timeout_s=0.5)
    driver = CompassDriver("compass", options, emitted.append)

    def headings() -> int:
        return sum(isinstance(m, MagneticHeading) for m in emitted)

    async with at_work(driver.run()):
        await until(lambda: driver.counters["opened"] == 1)
        line = wire(made("HCHDM,98.3,M"))
        device.send(line[:7])
        device.send(line[7:])
        await until(lambda: headings() == 1)
        assert driver.status.state == "running"
        await until(lambda: driver.status.state == "silent")
        device.send(wire(made("HCHDM,99.3,M")))
        await until(lambda: headings() == 2)
        device.unplug()
        await until(lambda: driver.status.state == "absent")


def test_what_the_decoder_refuses_is_on_its_page() -> None:
    page = (Path(__file__).parents[3] / "docs" / "compass.md").read_text()
    code = Path(compass.__file__).read_text()
    refused = set(re.findall(r'counters\["(\w+)"\]', code)) - {"headings"}
    assert len(refused) == 4
    assert all(f"`{name}`" in page for name in refused)
