"""The RDSS request cycle: who answers, cadence, height, which fixes count, fraction of T."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from drivers.rdss.messages import (
    BeamPower,
    BeamPowerRequest,
    Family,
    Feedback,
    Fix,
    HeightMode,
    IdentityRequest,
    Outcome,
    PositionRequest,
    SelfTest,
)
from drivers.rdss.reply_time_fraction import FractionReader
from drivers.rdss.state_tables import SECOND, State, TerminalOptions
from tests.drivers.rdss.bench import FIX, OK, USER, Bench, say

# --------------------------------------------------------------------------- finding the terminal


@pytest.mark.parametrize("family", ["4.0", "2.1"])
@pytest.mark.parametrize("baud", [115200, 19200, 9600])
def test_family_and_baud_are_found(family: Family, baud: int) -> None:
    bench = Bench(TerminalOptions(), family=family, baud=baud)
    bench.run(15)
    assert bench.cycle.family == family
    assert bench.line_baud == baud
    assert bench.cycle.identity is not None
    assert "rdss_card" in bench.notices
    assert bench.requests
    first = [type(m) for _, m in bench.sent]
    assert first.index(PositionRequest) > first.index(BeamPowerRequest)


def test_nobody_answers_is_said_once_and_asked_for_ever() -> None:
    bench = Bench(TerminalOptions(), mute=True)
    bench.run(60)
    assert bench.notices == ["rdss_no_answer"]
    assert bench.cycle.unanswered_round
    assert bench.cycle.counters["probes"] == 21
    assert {type(m) for _, m in bench.sent} == {IdentityRequest}
    bench.mute = False
    bench.run(20)
    assert bench.fixes


def test_a_terminal_that_falls_silent_is_looked_for_again() -> None:
    bench = Bench()
    bench.run(30)
    bench.mute = True
    bench.run(60)
    assert "rdss_silent" in bench.notices
    assert bench.cycle.state is State.PROBING
    bench.mute = False
    before = len(bench.requests)
    bench.run(70)
    assert bench.cycle.answered
    assert len(bench.requests) > before


# --------------------------------------------------------------------------- the regular cycle


def test_regular_cycle_keeps_the_cards_spacing() -> None:
    bench = Bench()
    bench.run(400)
    times = [t for t, _ in bench.requests]
    assert len(times) == 7
    assert all(b - a >= 60.1 - 1e-6 for a, b in itertools.pairwise(times))
    assert max(b - a for a, b in itertools.pairwise(times)) < 60.4
    assert bench.cycle.counters["fixes"] == 7
    for (asked, _), (_, ready) in zip(bench.requests, bench.fixes, strict=False):
        assert ready.requested_ns == round(asked * SECOND)
        assert ready.time_of_day_s == pytest.approx(31776.5)
        assert ready.uncertainty_s == 0.005
    request = bench.requests[0][1]
    assert (request.user, request.period_s, request.emergency) == (USER, 0, False)


def test_wanted_interval_never_undercuts_the_card_and_an_operator_may_ask_earlier() -> None:
    bench = Bench(TerminalOptions(bauds=(115200,), families=("4.0",), request_interval_s=300))
    bench.run(100)
    assert len(bench.requests) == 1
    bench.cycle.request_now(bench.t_ns)
    bench.run(20)
    assert len(bench.requests) == 2
    assert bench.cycle.request_now(bench.t_ns).text.startswith("request in 4")
    bench.run(60)
    assert len(bench.requests) == 3
    assert bench.requests[2][0] - bench.requests[1][0] >= 60.1 - 1e-6
    fast = Bench(TerminalOptions(bauds=(115200,), families=("4.0",), request_interval_s=1))
    fast.run(100)
    assert len(fast.requests) == 2


def test_read_only_never_asks_for_a_fix_and_goes_on_reading() -> None:
    bench = Bench(TerminalOptions(bauds=(115200,), families=("4.0",), transmit=False))
    bench.run(400)
    assert bench.requests == []
    assert bench.cycle.state is State.READY
    assert (
        bench.cycle.detail
        == "card 0242286, 60 s: read only, no fix is requested; strongest level 4"
    )
    reads = [t for t, m in bench.sent if isinstance(m, BeamPowerRequest)]
    assert reads[-1] > 380
    assert len(bench.sent) < 50
    assert "read only" in bench.cycle.request_now(bench.t_ns).text
    bench.run(100)
    assert bench.requests == []


def test_spacing_survives_a_replug() -> None:
    bench = Bench()
    bench.run(5)
    for _ in range(5):
        bench.do(bench.cycle.closed(bench.t_ns))
        bench.run(1)
        bench.do(bench.cycle.opened(bench.t_ns))
        bench.run(5)
    assert len(bench.requests) == 1
    bench.run(60)
    assert len(bench.requests) == 2


# --------------------------------------------------------------------------- height


def test_height_given_from_solution_config_or_terrain() -> None:
    bench = Bench(
        TerminalOptions(bauds=(115200,), families=("4.0",), antenna_height_m=2.5), service_s=9
    )
    bench.run(5)
    assert bench.requests[-1][1].height_mode is HeightMode.NONE
    assert bench.requests[-1][1].antenna_height_m == 2.5
    for height, sd, mode in [
        (438.4, 3.0, HeightMode.GIVEN),
        (438.4, 10.0, HeightMode.NONE),
        (float("nan"), 1.0, HeightMode.NONE),
        (438.4, float("nan"), HeightMode.NONE),
        (90000.0, 1.0, HeightMode.NONE),
    ]:
        count = len(bench.requests)
        while len(bench.requests) == count:
            bench.cycle.height.hint(height, sd, bench.t_ns)
            bench.run(1)
        assert bench.requests[-1][1].height_mode is mode
    bench.cycle.height.hint(438.4, 3.0, bench.t_ns)
    bench.run(9)
    bench.run(9)
    assert bench.requests[-1][1].height_mode is HeightMode.NONE, "a stale hint was used"

    ship = Bench(TerminalOptions(bauds=(115200,), families=("4.0",), height_m=17.0))
    ship.run(5)
    assert ship.requests[0][1] == PositionRequest(USER, HeightMode.GIVEN, height_m=17.0)
    assert [ready.height_given for _, ready in ship.fixes] == [True]
    own = TerminalOptions(bauds=(115200,), families=("4.0",), use_solution_height=False)
    terrain = Bench(own)
    terrain.cycle.height.hint(438.0, 1.0, terrain.t_ns)
    terrain.run(5)
    assert terrain.requests[0][1].height_mode is HeightMode.NONE
    assert [ready.height_given for _, ready in terrain.fixes] == [False]


def test_a_height_goes_out_where_it_is_better_than_the_centres_and_its_sigma_with_the_fix() -> None:
    for sd, centre, given in [(8.0, 4.0, None), (20.0, 30.0, 20.0), (3.0, 4.0, 3.0)]:
        bench = Bench()
        bench.cycle.height.hint(438.4, sd, bench.t_ns, centre)
        bench.run(5)
        assert [ready.height_sd_m for _, ready in bench.fixes] == [given]
        mode = HeightMode.NONE if given is None else HeightMode.GIVEN
        assert bench.requests[0][1].height_mode is mode


@pytest.mark.parametrize(("unit_pa", "printed"), [(1.0, 95_000.0), (0.1, 950_000.0)])
def test_a_pressure_goes_out_where_there_is_no_height(unit_pa: float, printed: float) -> None:
    options = TerminalOptions(
        bauds=(115200,),
        families=("4.0",),
        antenna_height_m=2.5,
        use_barometer=True,
        pressure_unit_pa=unit_pa,
    )
    bench = Bench(options)
    bench.cycle.height.pressure(95_000.0, bench.t_ns)
    bench.run(5)
    request = bench.requests[0][1]
    assert request.height_mode is HeightMode.ALTIMETER_1
    assert (request.pressure_pa, request.antenna_height_m) == (printed, 2.5)
    assert request.temperature_c == pytest.approx(11.5, abs=0.1)  # 540 m in the atmosphere
    assert [(r.height_given, r.height_sd_m) for _, r in bench.fixes] == [(True, None)]
    bench.cycle.height.pressure(200_000.0, bench.t_ns)
    bench.run(62)
    assert bench.requests[1][1].height_mode is HeightMode.NONE, "no pressure of any shore"


def test_beams_say_which_one_serves() -> None:
    bench = Bench(levels=(0, 3, 4, 0, 2, 0))
    bench.run(5)
    assert bench.cycle.beams is not None
    assert bench.cycle.beams.serving == 3
    named = BeamPower((0, 3, 4), response_beam=2, time_difference_beam=3)
    assert named.serving == 2
    assert BeamPower((0, 0)).serving is None
    bench.say(SelfTest(80.0, levels=(4, 0, 0, 0, 0, 2)))
    bench.run(1)
    assert bench.cycle.beams.serving == 1


# --------------------------------------------------------------------------- which fixes


def test_late_fix_of_a_known_request_is_used_and_a_second_one_is_unsolicited() -> None:
    bench = Bench(answer=say((0.2, OK), (15.0, FIX), (16.0, FIX)))
    bench.run(30)
    ((_, ready),) = bench.fixes
    assert ready.requested_ns == round(bench.requests[0][0] * SECOND)
    counters = bench.cycle.counters
    assert (counters["timeout_fix"], counters["late_fix"], counters["unsolicited"]) == (1, 1, 1)
    assert counters["slow_fix"] == 1


def test_a_fix_of_a_refused_request_is_unsolicited() -> None:
    bench = Bench(answer=say((0.2, Feedback(Outcome.FAILED, "DWSQ")), (1.0, FIX)))
    bench.run(20)
    assert bench.fixes == []
    assert bench.cycle.counters["unsolicited"] == 1


def test_a_height_that_nobody_is_at_is_refused_by_name() -> None:
    high = replace(FIX, height_m=2e5, high_altitude=True)
    bench = Bench(answer=say((0.2, OK), (1.0, high), (1.5, FIX)))
    bench.run(20)
    assert len(bench.fixes) == 1
    assert bench.cycle.counters["height_implausible"] == 1


@pytest.mark.parametrize(
    "foreign",
    [
        replace(FIX, kind="query", queried=5),
        replace(FIX, kind="report"),
        replace(FIX, user=USER + 1),
    ],
)
def test_foreign_fix_is_refused_by_name(foreign: Fix) -> None:
    bench = Bench(answer=say((0.2, OK), (1.0, foreign), (1.5, FIX)))
    bench.run(20)
    assert bench.cycle.counters["foreign_fix"] == 1
    assert [ready.fix for _, ready in bench.fixes] == [FIX]


def test_multi_value_fix_is_handed_on_marked() -> None:
    bench = Bench(answer=say((0.2, OK), (1.0, replace(FIX, multi_value=True))))
    bench.run(20)
    assert [ready.fix.multi_value for _, ready in bench.fixes] == [True]
    assert bench.cycle.counters["multi_value"] == 1


def test_anothers_message_uses_up_the_spacing() -> None:
    bench = Bench()
    bench.run(30)
    bench.say(Feedback(Outcome.OK, "TXSQ"))
    bench.run(120)
    assert bench.requests[1][0] - 35 >= 61 - 1e-6


def test_an_echo_of_our_own_bytes_is_no_answer() -> None:
    bench = Bench(mute=True)
    bench.say(IdentityRequest(), 1.0)
    bench.say(PositionRequest(), 1.0)
    bench.run(10)
    assert bench.cycle.counters["echo"] == 2
    assert not bench.cycle.answered


# --------------------------------------------------------------------------- fraction of T


def test_fraction_of_t() -> None:
    auto = FractionReader("auto")
    low, bound = auto.read(8)
    assert low - bound == pytest.approx(0.08)
    assert low + bound == pytest.approx(0.8)
    assert auto.read(71) == pytest.approx((0.71, 0.005))
    assert auto.read(8) == pytest.approx((0.08, 0.005))
    assert FractionReader("0.1").read(8) == pytest.approx((0.8, 0.05))
    assert FractionReader("0.01").read(8) == pytest.approx((0.08, 0.005))
    for unit, value in (("0.1", 71), ("auto", 200), ("0.01", 100)):
        assert FractionReader(unit).read(value) == (0.5, 0.5)  # type: ignore[arg-type]
