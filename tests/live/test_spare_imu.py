"""A second inertial unit takes over: recorded on the way, and replayed to the same bits."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.measurements import ArrivalStamp, ImuSample
from fusiond.configuration.doubts import doubts
from fusiond.configuration.schema import Config, Imu, SpareImu
from fusiond.configuration.si_units import DEG, sensor_to_body
from fusiond.demo.demo import demo_setup
from fusiond.navigation.solution import Mode
from fusiond.navigator.imu_choice import ImuChoice
from fusiond.replay.replay_output import ReplayOptions, replay
from fusiond.simulation.can.imu import CanImu
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.studies.faults.runs import error_sample
from tests.live.daemon_bench import NO_MQTT, PARKED, REST, Bench, imu_section, running
from tests.patience import until
from tests.recording.driven import Drive

Array = NDArray[np.float64]
FAILS_S, LENGTH_S = 15.0, 18.0
SPARE = SpareImu(source="imu2", axes=("+y", "+x", "-z"))
RATE_BIAS_RAD_S = np.array([0.08, -0.05, 0.06]) * DEG
FORCE_BIAS_M_S2 = np.array([0.05, 0.03, -0.04])
"""Of the spare: a part of what its data sheet allows."""


def two_units(folder: Path) -> Config:
    """The demo's vehicle with a second unit on a bus of its own, turned by a quarter."""
    config = demo_setup().served(1, folder)
    first = config.sources["imu"]
    second = first.model_copy(update={"channel": "other"})
    return config.model_copy(
        update={
            "imu": config.imu.model_copy(update={"spare": SPARE}),
            "sources": {**config.sources, "imu2": second},
        }
    )


class Failing(Drive):
    """What the first unit says passes `says` from `FAILS_S` on; None is silence."""

    def __init__(self, folder: Path, says: Callable[[Array], Array | None]) -> None:
        config = two_units(folder)
        self._second = CanImu()
        own = Imu(axes=SPARE.axes)
        self._turn = sensor_to_body(own).T @ sensor_to_body(config.imu)
        self._next_second = 0
        super().__init__(folder, LENGTH_S + 4.0, config)
        self.chain.events.listen(lambda e: self.told.append(e.code))
        self.told: list[str] = []
        encode = self.vehicle.encoder.frames

        def frames(number: int, t_ns: int, gyro: list[float], accel: list[float]) -> list[object]:
            sample: Array | None = np.array([*gyro, *accel])
            if t_ns * 1e-9 > FAILS_S:
                sample = says(np.array([*gyro, *accel]))
            if sample is None:
                return []
            return list(encode(number, t_ns, sample[:3].tolist(), sample[3:].tolist()))

        self.vehicle.encoder.frames = frames  # type: ignore[method-assign, assignment]

    def serve(self, until_ns: int) -> None:
        vehicle, until_s = self.vehicle, (until_ns - self._start_ns) * 1e-9
        while vehicle.truth.t_s[self._next_second + 1] <= until_s:
            k = self._next_second
            self._next_second += 1
            t_ns = round(float(vehicle.truth.t_s[k + 1]) * 1e9)
            gyro = (self._turn @ vehicle.imu.gyro[k] + RATE_BIAS_RAD_S).tolist()
            accel = (self._turn @ vehicle.imu.accel[k] + FORCE_BIAS_M_S2).tolist()
            for m in self._second.frames(k + 1, t_ns, gyro, accel):
                self.frame("imu2", m.arbitration_id, m.is_extended_id, bytes(m.data))
        super().serve(until_ns)


def test_the_spare_goes_on_where_the_first_got_stuck(tmp_path: Path) -> None:
    kept: list[Array] = []

    def stuck(sample: Array) -> Array:
        kept.append(sample)
        return kept[0]

    drive = Failing(tmp_path, stuck)
    drive.run(FAILS_S)
    before = drive.solutions[-1]
    assert before.mode is Mode.NAVIGATING
    assert drive._warm.state(before, drive.chain.navigator) is not None
    drive.run(LENGTH_S)
    choice, navigator = drive.chain.sources.imu, drive.chain.navigator
    assert choice.used == "imu2"
    assert choice.counters["took_over"] == 1
    assert "imu_spare" in drive.told
    modes = {s.mode for s in drive.solutions if s.t_ns > before.t_ns}
    assert modes <= {Mode.NAVIGATING, Mode.INVALID, Mode.COASTING}
    after = drive.solutions[-1]
    assert after.mode is Mode.NAVIGATING
    assert not navigator.imu.counters["gap"]
    # Its own biases are being found: one sigma is the class's no more, and no lie.
    true = drive.vehicle.truth_at(after.t_ns)
    sample = error_sample(after, true)
    assert max(sample.ratios) < 4.0
    assert after.sd_rpy_rad[2] > before.sd_rpy_rad[2]
    assert min(after.sd_rpy_rad) > SPARE.mounting_sd_deg * DEG
    assert drive._warm.state(after, navigator) is None  # of a unit that does not come first
    summary = replay(drive.close(), ReplayOptions())
    assert summary["identical"], summary
    health = drive.chain.sources.health(drive.host.mono)
    assert health["imu2"].counters["took_over"] == 1


async def test_the_daemon_on_two_buses_loses_one_of_them(bench: Bench) -> None:
    """At rest, with the real drivers: the first unit is unplugged, and comes back."""
    other = bench.imu.model_copy(update={"channel": f"{bench.imu.channel}-2"})
    second = imu_section(other).replace("[sources.imu]", "[sources.imu2]")
    spare = '[imu.spare]\nsource = "imu2"\naxes = ["+x", "-y", "-z"]\n'
    daemon = bench.daemon(spare, second, NO_MQTT)
    vehicle = bench.vehicle(gnss_link=bench.folder / "gnss")
    spare_unit = SimulatedVehicle(REST, seed=5, duration_s=60.0, can_imu=other)
    async with running(daemon, vehicle, spare_unit):
        await bench.mode(PARKED)
        assert bench.made.sources.imu.used == "imu"
        vehicle.unplug("imu")
        await until(lambda: bool(bench.events("imu_spare")))
        vehicle.plug("imu")
        seen = len(bench.seen)
        received = bench.health["imu"].received
        await until(lambda: bench.health["imu"].received > received)
        await until(lambda: len(bench.seen) > seen + 50)
        assert {s.mode for s in bench.seen[seen:]} == {PARKED}
        assert bench.health["imu2"].counters["took_over"] == 1
        assert bench.health["imu2"].fused > 0
    assert len(bench.events("imu_spare")) == 1


def test_two_that_are_silent_do_not_take_turns_and_no_spare_comes_alone() -> None:
    told: list[str] = []
    choice = ImuChoice(Imu(spare=SPARE, gap_s=0.5), lambda source, code, text: told.append(code))
    second = 1_000_000_000

    def give(source: str, t_ns: int) -> None:
        choice.take(ImuSample(source, t_ns, ArrivalStamp(), (0.0,) * 3, (1.0, 2.0, 3.0)), t_ns)

    give("imu", second)
    give("imu2", second)
    assert not choice.changes(second + 1, second)
    found = choice.samples()
    assert found is not None
    assert len(found[0]) == 1
    for t_ns in (3 * second, 3 * second + 1):
        assert not choice.changes(t_ns, second)  # the spare is silent as well
    give("imu2", 3 * second)
    give("imu", 3 * second)  # the host stood still, not the unit
    assert not any(choice.changes(3 * second + k, second) for k in range(3))
    assert choice.samples() is not None
    give("imu2", 4 * second)
    assert not choice.changes(4 * second, 3 * second)
    assert choice.changes(4 * second + 1, 3 * second)
    found = choice.samples()
    assert found is not None
    assert found[0].tolist() == [4 * second]  # not those that the first has covered
    assert found[1][0, 3:].tolist() == pytest.approx([2.0, 1.0, -3.0])  # in the first one's axes
    give("imu", 5 * second)  # the first is back: it is not used
    assert not any(choice.changes(9 * second + k, 4 * second) for k in range(3))
    assert +choice.counters == {"took_over": 1, "second_imu": 1}
    assert told == ["imu_spare"]


def test_check_knows_a_spare_from_a_second_unit_that_is_ignored(tmp_path: Path) -> None:
    config = two_units(tmp_path)
    assert not [line for line in doubts(config) if "imu" in line]
    alone = config.model_copy(update={"imu": config.imu.model_copy(update={"spare": None})})
    assert any('[imu.spare] source = "imu2"' in line for line in doubts(alone))
    other = SPARE.model_copy(update={"source": "gnss"})
    wrong = config.model_copy(update={"imu": config.imu.model_copy(update={"spare": other})})
    assert any("sources need two IMUs" in line for line in doubts(wrong))
