"""A simulated RDSS terminal without I/O: what it says is read by the driver's own decoders."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.messages import (
    BeamPower,
    BeamPowerRequest,
    DeviceClock,
    Family,
    Feedback,
    Fix,
    HeightMode,
    Identity,
    IdentityRequest,
    Message,
    Outcome,
    OutputRequest,
    PositionRequest,
    SelfTest,
    SelfTestRequest,
    StopRequest,
    Subordinates,
    TimeRequest,
    Unknown,
    VersionRequest,
)
from drivers.rdss.request_state_machine import Terminal
from drivers.rdss.state_tables import FixReady, Send, TerminalOptions
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.rdss.centre import RdssOptions
from fusiond.simulation.rdss.terminal import RdssTerminal
from tests.simulation.utc_start import UTC_START_NS

FAMILIES: tuple[Family, ...] = ("4.0", "2.1")


class Host:
    """A host on the terminal's line; nothing sleeps."""

    def __init__(self, truth: Truth, family: Family, **options: Any) -> None:
        self.options = RdssOptions(family=family, **options)
        self.terminal = RdssTerminal(truth, self.options, np.random.default_rng(4), UTC_START_NS)
        binary = family == "4.0"
        self._encode = binary_4_0.encode if binary else text_2_1.encode
        self._decoder = binary_4_0.Decoder() if binary else text_2_1.Decoder()

    def ask(self, message: Message, t_s: float) -> None:
        self.terminal.receive(self._encode(message), t_s)

    def listen(self, until_s: float) -> list[tuple[float, Message]]:
        """Everything the terminal says until then, each with its instant."""
        heard: list[tuple[float, Message]] = []
        while (due := self.terminal.next_s) <= until_s:
            heard += [(due, m) for m in self._decoder.feed(self.terminal.read(due))]
        return heard


def _messages(heard: list[tuple[float, Message]]) -> list[Message]:
    return [message for _, message in heard]


@pytest.mark.parametrize("family", FAMILIES)
def test_terminal_answers_reads(truth: Truth, family: Family) -> None:
    host = Host(truth, family)
    host.ask(IdentityRequest(), 1.0)
    host.ask(BeamPowerRequest(), 2.0)
    host.ask(SelfTestRequest(), 3.0)
    host.ask(TimeRequest(), 30.0)
    identity, beams, test, clock = _messages(host.listen(60.0))
    assert isinstance(identity, Identity)
    assert (identity.user, identity.service_frequency_s) == (242286, 10)
    assert isinstance(beams, BeamPower)
    assert max(beams.levels) == 4
    assert isinstance(test, SelfTest)
    assert test.battery_percent == 100.0
    assert isinstance(clock, DeviceClock)
    assert (clock.day, clock.month, clock.year) == (21, 11, 2026)  # midnight has passed
    assert clock.time_of_day_s == pytest.approx(0.17, abs=0.2)
    assert host.terminal.next_s == math.inf


@pytest.mark.parametrize(("family", "hour"), [("4.0", 8), ("2.1", 0)])
def test_clock_of_a_terminal_in_beijing_time(truth: Truth, family: Family, hour: int) -> None:
    """SJXX prints the zone of the fixes, BDZDA always UTC as NMEA 0183 ZDA does."""
    host = Host(truth, family, zone_h=8)
    host.ask(TimeRequest(), 30.0)
    (clock,) = _messages(host.listen(60.0))
    assert isinstance(clock, DeviceClock)
    assert (clock.day, int(clock.time_of_day_s // 3600)) == (21, hour)
    assert clock.zone_h == (None if family == "4.0" else -8)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("zone_h", [0, 8])
def test_fix_is_the_position_at_the_burst(truth: Truth, family: Family, zone_h: int) -> None:
    host = Host(truth, family, error_sd_m=0.0, height_sd_m=0.0, zone_h=zone_h)
    host.ask(PositionRequest(), 80.0)
    (when, feedback), (arrival, fix) = host.listen(100.0)
    assert isinstance(feedback, Feedback)
    assert (feedback.outcome, feedback.command) == (
        Outcome.OK,
        "DWSQ" if family == "4.0" else "DWA",
    )
    assert when == pytest.approx(80.05)
    assert isinstance(fix, Fix)
    assert 0.6 <= arrival - 80.05 <= 5.0
    state = truth.at(np.array([80.05]))
    assert np.linalg.norm(state.v_ned) > 5.0  # moving: another instant is another place
    lat, lon = np.degrees(state.position[0, :2])
    tolerance = 0.051 / 3600 if family == "4.0" else 0.000051 / 60
    assert fix.lat_deg == pytest.approx(lat, abs=tolerance)
    assert fix.lon_deg == pytest.approx(lon, abs=tolerance)
    assert fix.height_m == pytest.approx(state.position[0, 2], abs=0.51)
    start_s = (23 * 3600 + 59 * 60 + 30.123 + zone_h * 3600) % 86400
    printed = fix.time_of_day_s + (fix.fraction or 0) * 0.01
    assert printed == pytest.approx((start_s + 80.05) % 86400, abs=0.011)
    assert (fix.precision_class_m, fix.multi_value, fix.kind) == (20, False, "own")


@pytest.mark.parametrize("family", FAMILIES)
def test_service_frequency_is_kept(truth: Truth, family: Family) -> None:
    host = Host(truth, family, service_frequency_s=60)
    host.ask(PositionRequest(), 10.0)
    host.ask(PositionRequest(), 33.5)
    host.ask(PositionRequest(), 70.0)
    messages = _messages(host.listen(100.0))
    feedback = [m for m in messages if isinstance(m, Feedback)]
    assert [f.outcome for f in feedback] == [Outcome.OK, Outcome.FREQUENCY, Outcome.OK]
    assert feedback[1].wait_s == 37.0
    assert sum(isinstance(m, Fix) for m in messages) == 2
    assert host.terminal.counters["refused_frequency"] == 1


@pytest.mark.parametrize("family", FAMILIES)
def test_refused_by_chance(truth: Truth, family: Family) -> None:
    """Whoever waits as he is told to is not refused for it twice, nor counted as too early."""
    host = Host(truth, family, service_frequency_s=4, refuse_probability=0.4)
    t, feedback = 1.0, []
    while t < 280.0:
        host.ask(PositionRequest(), t)
        last = [m for m in _messages(host.listen(t + 0.1)) if isinstance(m, Feedback)][-1]
        feedback.append(last)
        t += last.wait_s or 4.0
    no_beam = Outcome.NOT_LOCKED if family == "4.0" else Outcome.NOT_SENT
    refused = {o: sum(f.outcome is o for f in feedback) for o in (Outcome.FREQUENCY, no_beam)}
    share = np.array(list(refused.values())) / len(feedback)
    assert share == pytest.approx(0.2, abs=3.0 * math.sqrt(0.2 * 0.8 / len(feedback)))
    assert {f.wait_s for f in feedback} == {None, 1.0, 2.0, 3.0, 4.0}
    counters = host.terminal.counters
    assert counters["too_early"] == 0
    assert counters["fixes"] == len(feedback) - sum(refused.values())
    host.ask(PositionRequest(), t + 0.5)
    host.ask(PositionRequest(), t + 0.6)
    assert counters["too_early"] >= 1


@pytest.mark.parametrize("family", FAMILIES)
def test_the_end_of_a_suppression_is_said(truth: Truth, family: Family) -> None:
    host = Host(truth, family)
    host.terminal.suppressed = True
    host.terminal.lift(20.0)
    ((when, notice),) = host.listen(100.0)
    assert when == pytest.approx(20.05)
    assert isinstance(notice, Feedback)
    if family == "4.0":
        assert notice.outcome is Outcome.SILENCE_OR_LIFTED
    else:
        assert (notice.outcome, notice.inhibited) == (Outcome.OK, False)
    host.ask(PositionRequest(), 21.0)
    assert any(isinstance(m, Fix) for m in _messages(host.listen(100.0)))


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    ("state", "binary", "text"),
    [
        ({"silent": True}, Outcome.SILENCE_OR_LIFTED, Outcome.SILENCE),
        ({"suppressed": True}, Outcome.SUPPRESSED, Outcome.SUPPRESSED),
        ({"battery_percent": 5.0}, Outcome.LOW_BATTERY, Outcome.LOW_BATTERY),
        ({"beam_levels": (0, 1, 0, 1, 0, 0)}, Outcome.NOT_LOCKED, Outcome.NOT_SENT),
    ],
)
def test_refusals(
    truth: Truth, family: Family, state: dict[str, Any], binary: Outcome, text: Outcome
) -> None:
    host = Host(truth, family)
    for name, value in state.items():
        setattr(host.terminal, name, value)
    host.ask(PositionRequest(), 10.0)
    (feedback,) = _messages(host.listen(100.0))
    assert isinstance(feedback, Feedback)
    assert feedback.outcome is (binary if family == "4.0" else text)
    # A refused request does not count against the service frequency.
    for name, value in (("silent", False), ("suppressed", False), ("battery_percent", 90.0)):
        setattr(host.terminal, name, value)
    host.terminal.beam_levels = (4, 4, 0, 0, 0, 0)
    host.ask(PositionRequest(), 12.0)
    assert any(isinstance(m, Fix) for m in _messages(host.listen(100.0)))


def test_bds3_form_of_the_feedback(truth: Truth) -> None:
    host = Host(truth, "2.1", bds3_feedback=True)
    host.terminal.suppressed = True
    host.ask(PositionRequest(), 10.0)
    (feedback,) = _messages(host.listen(20.0))
    assert isinstance(feedback, Feedback)
    assert feedback.outcome is Outcome.SUPPRESSED
    assert feedback.time_of_day_s == 23 * 3600 + 59 * 60 + 40


@pytest.mark.parametrize("family", FAMILIES)
def test_dropped_multi_value_and_foreign(truth: Truth, family: Family) -> None:
    dropped = Host(truth, family, drop_probability=1.0)
    dropped.ask(PositionRequest(), 10.0)
    assert [type(m) for m in _messages(dropped.listen(100.0))] == [Feedback]
    host = Host(truth, family, multi_value_probability=1.0, foreign_probability=1.0)
    host.ask(PositionRequest(), 10.0)
    fixes = [m for m in _messages(host.listen(100.0)) if isinstance(m, Fix)]
    assert [fix.kind for fix in fixes] == ["query", "own"]
    assert [fix.multi_value for fix in fixes] == [False, True]
    true_lat = math.degrees(truth.at(np.array([10.05])).position[0, 0])
    assert abs(fixes[1].lat_deg - true_lat) > 0.02


@pytest.mark.parametrize("family", FAMILIES)
def test_periodic_requests_until_stopped(truth: Truth, family: Family) -> None:
    host = Host(truth, family, service_frequency_s=1)
    host.ask(PositionRequest(period_s=20), 10.0)
    host.ask(BeamPowerRequest(period_s=5), 10.0)
    heard = _messages(host.listen(69.9))
    assert sum(isinstance(m, Fix) for m in heard) == 3
    assert sum(isinstance(m, BeamPower) for m in heard) == 12
    if family == "4.0":
        host.ask(StopRequest(command="DWSQ"), 70.0)
        host.ask(StopRequest(command="GLJC"), 70.0)
    else:
        host.ask(OutputRequest("DWR", 1, 0), 70.0)
        host.ask(OutputRequest("", 3), 70.0)
    host.listen(80.0)
    assert host.terminal.next_s == math.inf


def test_family_4_0_reads_that_2_1_does_not_have(truth: Truth) -> None:
    host = Host(truth, "4.0")
    host.ask(VersionRequest(), 1.0)
    host.ask(IdentityRequest(index=1), 2.0)
    version, subordinates = _messages(host.listen(5.0))
    assert isinstance(version, Unknown)
    assert version.name == "BBXX"
    assert isinstance(subordinates, Subordinates)


@pytest.mark.parametrize("correlation_s", [0.0, 600.0])
def test_errors_have_the_class_and_the_correlation(truth: Truth, correlation_s: float) -> None:
    host = Host(
        truth, "2.1", precision_class_m=100, error_correlation_s=correlation_s,
        service_frequency_s=1, delay_s=(0.6, 0.9),
    )  # fmt: skip
    times = np.arange(1.0, 299.0)
    for t in times:
        host.ask(PositionRequest(height_mode=HeightMode.GIVEN, height_m=123.0), float(t))
    fixes = [m for m in _messages(host.listen(400.0)) if isinstance(m, Fix)]
    assert len(fixes) == len(times)
    assert {(f.precision_class_m, f.height_m) for f in fixes} == {(100, 123.0)}
    lat = np.radians([f.lat_deg for f in fixes])
    north = (lat - truth.at(times + 0.05).position[:, 0]) * 6.353e6
    steps = np.diff(north).std()
    if correlation_s:
        assert steps == pytest.approx(100.0 * math.sqrt(2.0 / 600.0), rel=0.2)
    else:
        assert north.std() == pytest.approx(100.0, rel=0.15)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_request_cycle_of_the_driver_is_satisfied(truth: Truth, family: Family) -> None:
    """The driver's state machine against the terminal for 280 s, on a clock of our own."""
    host = Host(truth, family, service_frequency_s=9, drop_probability=0.1)
    cycle = Terminal(TerminalOptions(families=(family,), suppression_hold_s=40.0))
    decoder = binary_4_0.Decoder() if family == "4.0" else text_2_1.Decoder()
    actions = list(cycle.opened(0))
    fixes: list[FixReady] = []
    now_ns = 0
    while now_ns < 280_000_000_000:
        for action in actions:
            if isinstance(action, Send):
                host.terminal.receive(action.data, now_ns * 1e-9)
            elif isinstance(action, FixReady):
                fixes.append(action)
        deadline = cycle.next_deadline_ns
        assert deadline is not None
        said_ns = min(host.terminal.next_s * 1e9, 1e12)
        now_ns = max(now_ns, round(min(deadline, said_ns)) + 1)
        actions = []
        for message in decoder.feed(host.terminal.read(now_ns * 1e-9)):
            actions += cycle.received(message, now_ns, family)
        actions += cycle.tick(now_ns)
        host.terminal.suppressed = 100e9 < now_ns < 130e9
    counters = host.terminal.counters
    assert counters["dropped"] > 0
    assert counters["refused_frequency"] == 0
    assert counters["refused_suppressed"] == 1
    assert len(fixes) == counters["fixes"] >= 15
    for fix in fixes:
        # The fix is for the burst, 50 ms after the request was written.
        start_s = 23 * 3600 + 59 * 60 + 30.123
        age = (fix.time_of_day_s - start_s - fix.requested_ns * 1e-9) % 86400
        assert abs(age - 0.05) <= 0.012 + fix.uncertainty_s


def test_delays_fill_the_configured_range(truth: Truth) -> None:
    host = Host(truth, "4.0", service_frequency_s=1)
    for k in range(280):
        host.ask(PositionRequest(), 1.0 + k)
    bursts: dict[int, float] = {}
    for due, message in host.listen(400.0):
        if isinstance(message, Fix):
            tod = message.time_of_day_s + (message.fraction or 0) * 0.01
            bursts[len(bursts)] = (due + 30.123 + 23 * 3600 + 59 * 60 - tod) % 86400
    delays = np.array(list(bursts.values()))
    assert len(delays) == 280
    assert 0.58 <= delays.min() < 0.65
    assert 2.5 < delays.max() <= 5.02
    assert delays.mean() == pytest.approx(1.5, rel=0.15)


def test_garbage_on_the_line_is_survived(truth: Truth) -> None:
    host = Host(truth, "4.0")
    host.terminal.receive(b"\x00$DWSQ\xff\xff$$$CCDWA,garbage*00\r\n" * 20, 5.0)
    host.ask(IdentityRequest(), 6.0)
    assert any(isinstance(m, Identity) for m in _messages(host.listen(10.0)))


def test_the_same_seed_gives_the_same_terminal(truth: Truth) -> None:
    said = []
    for _ in range(2):
        options = replace(RdssOptions(), foreign_probability=0.5, multi_value_probability=0.5)
        terminal = RdssTerminal(truth, options, np.random.default_rng(9), UTC_START_NS)
        for k in range(10):
            terminal.receive(binary_4_0.encode(PositionRequest()), 11.0 * k)
        said.append(terminal.read(300.0))
    assert said[0] == said[1]
    assert len(said[0]) > 10 * 47
