"""Heights and pressures by any DBC: frames packed by hand, and the driver on a real bus."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.base import PermanentDriverError
from drivers.can.height import CanHeightDecoder, CanHeightDriver, CanHeightOptions
from drivers.measurements import Height
from drivers.standard_atmosphere import metres_a_pascal, pressure_height_m, standard_pressure_pa
from tests.drivers.can.served import Served, fed, sent
from tests.patience import until

NEAREST = 1.0 / math.sqrt(12.0)
DBC = """VERSION ""
NS_ :
BS_:
BU_: AIR HOST
BO_ 256 AMBIENT: 3 AIR
 SG_ PRESSURE : 0|16@1+ (0.1,0) [0|1200] "hPa" HOST
 SG_ OK : 16|1@1+ (1,0) [0|1] "" HOST
BO_ 257 ALTITUDE: 4 AIR
 SG_ LEVEL : 0|16@1- (1,0) [0|0] "ft" HOST
 SG_ SIGMA : 16|8@1+ (0.5,0) [0|0] "m" HOST
"""


@pytest.fixture
def dbc(tmp_path: Path) -> str:
    path = tmp_path / "air.dbc"
    path.write_text(DBC)
    return str(path)


def decoder(dbc: str, **options: Any) -> CanHeightDecoder:
    return CanHeightDecoder("baro", CanHeightOptions(dbc=dbc, **options))


@pytest.mark.parametrize(
    ("height_m", "pressure_pa"),
    # Doc 7488, table 1 (geopotential height).
    [(-1000.0, 113_929.0), (0.0, 101_325.0), (1000.0, 89_874.6), (5000.0, 54_019.9)],
)
def test_the_standard_atmosphere(height_m: float, pressure_pa: float) -> None:
    assert pressure_height_m(pressure_pa) == pytest.approx(height_m, abs=0.3)
    slope = pressure_height_m(pressure_pa) - pressure_height_m(pressure_pa + 1.0)
    assert metres_a_pascal(pressure_pa) == pytest.approx(slope, rel=1e-4)
    assert standard_pressure_pa(pressure_height_m(pressure_pa)) == pytest.approx(pressure_pa)


def test_a_pressure_is_a_height_that_is_off_by_the_weather(dbc: str) -> None:
    d = decoder(dbc, pressure="AMBIENT.PRESSURE", valid="AMBIENT.OK")
    (m,) = fed(d, [(256, struct.pack("<HB", 8987, 1))], 4)
    assert isinstance(m, Height)
    assert (m.source, m.t_seen_ns, m.sd_m, m.barometric) == ("baro", 4, None, True)
    assert m.height_m == pytest.approx(pressure_height_m(89_870.0))
    assert m.rounding_sd_m == pytest.approx(10.0 * metres_a_pascal(89_870.0) * NEAREST)
    assert fed(d, [(256, struct.pack("<HB", 8988, 0))]) == []
    assert fed(d, [(256, struct.pack("<HB", 500, 1))]) == []  # 50 hPa: nobody's air
    assert (d.counters["not_valid"], d.counters["out_of_range"]) == (1, 1)


@pytest.mark.parametrize("barometric", [False, True])
def test_a_height_in_feet_with_its_sigma(dbc: str, barometric: bool) -> None:
    d = decoder(dbc, height="ALTITUDE.LEVEL", accuracy="ALTITUDE.SIGMA", barometric=barometric)
    stated, unstated = fed(
        d, [(257, struct.pack("<hBx", -100, 7)), (257, struct.pack("<hBx", 101, 0))]
    )
    assert isinstance(stated, Height)
    assert isinstance(unstated, Height)
    assert stated.height_m == pytest.approx(-30.48)
    assert (stated.sd_m, unstated.sd_m) == (pytest.approx(3.5), None)
    assert stated.barometric is barometric
    assert stated.rounding_sd_m == pytest.approx(0.3048 * NEAREST)


@pytest.mark.parametrize(
    "options", [{}, {"height": "ALTITUDE.LEVEL", "pressure": "AMBIENT.PRESSURE"}]
)
def test_one_of_height_and_pressure(dbc: str, options: dict[str, str]) -> None:
    with pytest.raises(ValidationError, match="height or pressure: one of the two"):
        CanHeightOptions(dbc=dbc, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"height": "AMBIENT.PRESSURE"}, "height: the unit of PRESSURE is 'hPa'; known are m"),
        ({"pressure": "ALTITUDE.LEVEL"}, "pressure: the unit of LEVEL is 'ft'; known are Pa"),
        ({"pressure": "AIR.PRESSURE"}, "'AIR.PRESSURE' is no Message.Signal of the DBC file"),
    ],
)
def test_mappings_that_do_not_fit(dbc: str, options: dict[str, str], words: str) -> None:
    with pytest.raises(PermanentDriverError, match=words):
        decoder(dbc, **options)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(frames=st.lists(st.tuples(st.sampled_from((256, 257)), st.binary(max_size=9)), max_size=20))
def test_garbage_never_raises_and_heights_are_of_this_air(
    dbc: str, frames: list[tuple[int, bytes]]
) -> None:
    d = decoder(dbc, pressure="AMBIENT.PRESSURE", valid="AMBIENT.OK", accuracy="ALTITUDE.SIGMA")
    for m in fed(d, frames):
        assert isinstance(m, Height)
        assert -1500.0 < m.height_m < 11_001.0


async def test_on_a_bus(dbc: str) -> None:
    baro = Served(CanHeightDriver, "baro", {"dbc": dbc, "pressure": "AMBIENT.PRESSURE"})
    async with baro.run() as bus:
        sent(bus, [(256, struct.pack("<HB", 10133, 1))])
        await until(lambda: len(baro.measurements) == 1)
        assert baro.driver.status.state == "running"
