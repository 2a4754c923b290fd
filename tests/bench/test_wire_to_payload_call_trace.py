"""What is counted of an ordinary fix in the daemon, from the wire to the payload."""

from __future__ import annotations

from functools import cache

from fusiond.bench.fix_call_trace import FixPath
from fusiond.bench.wire_to_payload_call_trace import wired_fix

FUNCTIONS, MODULES = 208, 43
"""Budget, which only falls: 237 and 67 before all that a fix does not need had left its way."""
WAY = (
    ("drivers.reconnecting_line", "SerialLine._read"),
    ("drivers.nmea.mixed_framing", "StreamSplitter._sentence"),
    ("drivers.nmea.epoch_to_measurement", "EpochConverter._fix"),
    ("fusiond.clock.stamp_mapping", "Clock.resolve"),
    ("fusiond.navigator.navigator", "Navigator.add"),
    ("fusiond.live.chain", "Chain.tick"),
    ("fusiond.estimators.base", "Estimator.run"),
    ("fusiond.outputs.messages.nav", "nav_message"),
    ("fusiond.outputs.mqtt", "_encoded"),
)


@cache
def way() -> FixPath:
    return wired_fix()


def test_way_goes_from_the_line_to_the_payload() -> None:
    """One fix is read, dated, folded in, and published."""
    calls = way().calls
    assert [name for name in WAY if name not in calls] == []
    assert calls["fusiond.navigator.navigator", "Navigator.add"] == 1
    assert not any(
        module.startswith(("fusiond.bench", "fusiond.simulation")) for module, _ in calls
    )


def test_samples_of_the_inertial_unit_are_left_out() -> None:
    assert not any(module.startswith("drivers.can") for module, _ in way().calls)


def test_way_does_not_grow() -> None:
    assert way().functions <= FUNCTIONS
    assert way().modules <= MODULES
